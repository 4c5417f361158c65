"""Robots by physics: one engine for those that roll and those that walk, in MJX and in MuJoCo's own C.

rotations ─► ground (measured track, bed and walls near a robot) ─► engine ─► riding (a motion, its LiDARs) ─► rover
                                                                       └────► subterra_jax.b2, on legs
"""

from subterra_jax.pictures.renderer import choose_gl

choose_gl()  # before anything here imports MuJoCo
