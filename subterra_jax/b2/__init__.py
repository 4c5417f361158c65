"""The Unitree B2: model, track under its feet, an environment in which it learns to walk, and tasks on a learnt gait.

constants ─► model ─┐
track, window ──────┴► physics (MJX) or engine (MuJoCo) ─► walk (50 Hz) ─► hierarchy (5 Hz)
legs ─► gait ─► servos ─┘                                   ▲ policy
"""
