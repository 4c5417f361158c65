"""The parts of an environment, one file each; `part.py` is their contract."""

from subterra_jax.parts.faults import FaultParams, Faults
from subterra_jax.parts.imu import Imu, ImuParams
from subterra_jax.parts.obstacles import Obstacles
from subterra_jax.parts.odometer import Odometer
from subterra_jax.parts.part import Drive, Motion, Moved, Noise, Part, SensingState, Step
from subterra_jax.parts.planar_lidar import PlanarLidar
from subterra_jax.parts.slip import Slip
from subterra_jax.parts.spatial_lidar import SpatialLidar, SpatialParams, make_sensor
from subterra_jax.parts.unicycle import Unicycle

__all__ = [
    "Drive",
    "FaultParams",
    "Faults",
    "Imu",
    "ImuParams",
    "Motion",
    "Moved",
    "Noise",
    "Obstacles",
    "Odometer",
    "Part",
    "PlanarLidar",
    "SensingState",
    "Slip",
    "SpatialLidar",
    "SpatialParams",
    "Step",
    "Unicycle",
    "make_sensor",
]
