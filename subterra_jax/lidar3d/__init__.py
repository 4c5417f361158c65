"""LiDAR in three dimensions, against every triangle of a surface: for tilted and many-beam sensors."""

from subterra_jax.lidar3d.casting import cast, require_free, rotate, scan
from subterra_jax.lidar3d.relief import Relief, stack_reliefs

__all__ = ["Relief", "cast", "require_free", "rotate", "scan", "stack_reliefs"]
