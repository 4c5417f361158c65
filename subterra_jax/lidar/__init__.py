"""The planar LiDAR: exact ranges to the walls, by XLA or by kernels, and the float64 it must agree with."""

from subterra_jax.lidar.planar import LidarParams, add_noise, beam_directions, bearings, nearest, scan, skips_unneeded

__all__ = ["LidarParams", "add_noise", "beam_directions", "bearings", "nearest", "scan", "skips_unneeded"]
