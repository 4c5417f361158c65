"""LiDAR in three dimensions, against every triangle of a built scene: for tilted and many-beam sensors."""

from subterra_jax.lidar3d.casting import cast, rotate, scan
from subterra_jax.lidar3d.relief import Relief

__all__ = ["Relief", "cast", "rotate", "scan"]
