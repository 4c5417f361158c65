"""Wheel odometry with the errors of real corridors: one scale error a robot, which wanders along the way.

Source of the sizes: +2.2 % in scale, standard deviation 0.6 % from one 20 m to the next, over 864 m of a real robot's
corridors, always of one sign.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from scene.survey.carrier import Poses

RATE = 50.0  # Hz
SCALE, SCALE_SIGMA, SCALE_PIECE = 0.022, 0.006, 20.0  # 1; 1; m
_TURN_SIGMA = 2e-4  # rad/√m, wander of the heading


def measure_wheels(
    rng: np.random.Generator, station: Float[np.ndarray, "n"], poses: Poses
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 4"]]:
    """Simulates the odometer of one robot.

    Args:
        rng: Draws the robot's sign, its scale errors and the wander of its heading.
        station: True station at each time, m, `(n,)`.
        poses: True poses of the LiDAR.

    Returns:
        Poses of the LiDAR in the odometer's frame, which is that of the first pose, levelled: positions, m, `(n, 3)`,
        and quaternions x, y, z, w, `(n, 4)`. Height, roll and pitch are 0: wheels do not see them.
    """
    sign = rng.choice([-1.0, 1.0])
    driven = np.abs(np.diff(station, prepend=station[0])).cumsum()
    scale = sign * rng.normal(SCALE, SCALE_SIGMA, int(driven[-1] // SCALE_PIECE) + 1)
    piece = (driven / SCALE_PIECE).astype(int).clip(0, len(scale) - 1)
    step = np.diff(station, prepend=station[0]) * (1.0 + scale[piece])
    yaw = Rotation.from_quat(poses.quaternion).as_euler("ZYX")[:, 0]
    drift = _TURN_SIGMA * np.sqrt(np.diff(driven, prepend=0.0)) * rng.standard_normal(len(driven))
    wander = drift.cumsum()
    # The wheels roll along a straight bore; where the LiDAR looks does not steer them.
    way = [(step * np.cos(wander)).cumsum(), (step * np.sin(wander)).cumsum(), np.zeros(len(step))]
    heading = np.unwrap(yaw) - yaw[0] + wander
    return np.column_stack(way), Rotation.from_euler("Z", heading[:, None]).as_quat()
