"""The Unitree B2: its model, the track under its feet, a task in which it learns to walk, and missions on that gait.

constants ─► model ─┐
track ──────────────┴► physics (MJX) or engine (MuJoCo in C) ─► walk (50 Hz) ─► mission (5 Hz)
kinematics ─► gait ───────────────────────────────────────────────┘
"""

from subterra_jax.pictures.renderer import choose_gl

choose_gl()  # before anything here imports MuJoCo
