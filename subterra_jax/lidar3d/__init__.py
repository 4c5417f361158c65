"""LiDAR in three dimensions, against every triangle of a surface: for tilted and many-beam sensors."""

from subterra_jax.lidar3d.casting import meet, require_free
from subterra_jax.lidar3d.relief import Relief, stack_reliefs

__all__ = ["Relief", "meet", "require_free", "stack_reliefs"]
