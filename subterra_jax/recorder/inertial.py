"""What an IMU beside the LiDAR would have measured."""

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from subterra_jax.recorder.poses import Poses

RATE = 100.0  # Hz
GRAVITY = 9.80665  # m/s²
# Standard deviations of one sample, random walks and constant biases of an MTi-30. Source: GEODE dataset, calibration
# of its γ rack (`acc_n`, `gyr_n`, `acc_w`, `gyr_w`); the biases are the data sheet's order of magnitude.
ACCEL_SIGMA, ACCEL_WALK, ACCEL_BIAS = 5.574e-3, 1.208e-4, 0.02  # m/s², m/s²/√s, m/s²
GYRO_SIGMA, GYRO_WALK, GYRO_BIAS = 5.144e-3, 1.088e-4, 0.003  # rad/s, rad/s/√s, rad/s
_HALF_STEP = 1e-3  # s, of the central difference of the attitude


@dataclasses.dataclass(frozen=True)
class Inertial:
    """Samples of the IMU, in its own frame, which is turned like `base_link`.

    Attributes:
        time: Since the start, s, `(n,)`.
        gyro: rad/s, `(n, 3)`.
        accel: Specific force, m/s², `(n, 3)`; +9.8 upwards at rest.
    """

    time: Float[np.ndarray, " n"]
    gyro: Float[np.ndarray, "n 3"]
    accel: Float[np.ndarray, "n 3"]


def measure(poses: Poses, seed: int, noise: float = 1.0) -> Inertial:
    """Samples along the smoothest motion through some poses.

    Commands change speed at once; cubic splines through the poses spread that over a control period or two.

    Args:
        poses: Of the IMU, at least two.
        seed: Of noise and biases.
        noise: Factor on all errors; 0 gives the truth.
    """
    n = int(np.floor(poses.time[-1] * RATE + 1e-6)) + 1
    time = np.arange(n) / RATE
    angles = np.unwrap(poses.rotation.as_euler("ZYX"), axis=0)
    place, turn = CubicSpline(poses.time, poses.position), CubicSpline(poses.time, angles)

    def attitude(at: Float[np.ndarray, " n"]) -> Rotation:
        return Rotation.from_euler("ZYX", turn(at))

    gyro = (attitude(time - _HALF_STEP).inv() * attitude(time + _HALF_STEP)).as_rotvec() / (2.0 * _HALF_STEP)
    accel = attitude(time).inv().apply(place(time, 2) + np.array([0.0, 0.0, GRAVITY]))
    rng = np.random.default_rng([seed, 0x1A1])
    walk = rng.standard_normal((2, n, 3)).cumsum(axis=1) / np.sqrt(RATE)
    white, bias = rng.standard_normal((2, n, 3)), rng.standard_normal((2, 1, 3))
    gyro = gyro + noise * (GYRO_SIGMA * white[0] + GYRO_WALK * walk[0] + GYRO_BIAS * bias[0])
    accel = accel + noise * (ACCEL_SIGMA * white[1] + ACCEL_WALK * walk[1] + ACCEL_BIAS * bias[1])
    return Inertial(time, gyro, accel)
