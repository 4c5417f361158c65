"""What IMUs and the total station report along the walk."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from scene.survey.carrier import Carried, Walk
from scene.survey.config import SensorErrors
from scene.survey.field import draw_field
from scene.survey.mount import Mount
from scene.survey.rack import PRISM

GRAVITY = 9.80665  # m/s²
PRISM_RATE = 3.0  # Hz
ACCEL_BIAS, GYRO_BIAS = 0.02, 0.003  # m/s², rad/s; standard deviation of the constant part in each axis
# GEODE's γ figures [geode.md], used for every IMU here. As standard deviations of one sample they agree with the
# MTi-30's data sheet (0.03 °/s/√Hz, 60 µg/√Hz at 100 Hz); as densities they would be ten times worse than it.
ACCEL_SIGMA, ACCEL_WALK = 5.574e-3, 1.208e-4  # m/s², m/s²/√s
GYRO_SIGMA, GYRO_WALK = 5.144e-3, 1.088e-4  # rad/s, rad/s/√s
_H = 1e-3  # s, half-step of the central differences


@dataclass(frozen=True)
class Inertial:
    """Samples of one IMU.

    Attributes:
        time: s since the start.
        accel: Specific force, m/s²; +9.8 upwards at rest.
        gyro: rad/s.
        quaternion: Orientation x, y, z, w, IMU to a level frame of unknown heading.
    """

    time: Float[np.ndarray, "n"]
    accel: Float[np.ndarray, "n 3"]
    gyro: Float[np.ndarray, "n 3"]
    quaternion: Float[np.ndarray, "n 4"]


def measure_inertial(
    rng: np.random.Generator, lidar: Carried, rate: float, mount: Mount, errors: SensorErrors
) -> Inertial:
    """Simulate an IMU.

    With `imu_noise`, roll and pitch of its orientation are off by 0.2° (1 σ), slowly changing; its heading is
    magnetic, so it has an offset of up to 15° and wanders by 1°.

    Args:
        rng: Source of randomness.
        lidar: The LiDAR's motion.
        rate: Samples per second, Hz.
        mount: Of the IMU against the LiDAR.
        errors: `imu_noise` and `imu_bias`.
    """
    time = np.arange(round(lidar.walk.duration * rate)) / rate
    turn = Rotation.from_matrix(mount.rotation.T)

    def state(at: np.ndarray) -> tuple[np.ndarray, Rotation]:
        poses = lidar.poses(at)
        attitude = Rotation.from_quat(poses.quaternion)
        return poses.position + attitude.apply(mount.origin), attitude * turn

    (before, r_before), (here, r_here), (after, r_after) = (state(time + k * _H) for k in (-1.0, 0.0, 1.0))
    force = (after - 2.0 * here + before) / _H**2 + (0.0, 0.0, GRAVITY)
    accel = r_here.inv().apply(force)
    gyro = (r_before.inv() * r_after).as_rotvec() / (2.0 * _H)

    n, noise, bias = len(time), float(errors.imu_noise), float(errors.imu_bias)
    walks = rng.standard_normal((2, n, 3)).cumsum(axis=1) / np.sqrt(rate)
    accel += noise * ACCEL_SIGMA * rng.standard_normal((n, 3))
    accel += bias * (ACCEL_WALK * walks[0] + rng.normal(0.0, ACCEL_BIAS, 3))
    gyro += noise * GYRO_SIGMA * rng.standard_normal((n, 3))
    gyro += bias * (GYRO_WALK * walks[1] + rng.normal(0.0, GYRO_BIAS, 3))
    degree = np.pi / 180.0
    tilt = np.stack([draw_field(rng, s * degree, 20.0).along(time) for s in (0.2, 0.2, 1.0)], axis=-1)
    tilt[:, 2] += rng.uniform(-15.0, 15.0) * degree
    return Inertial(time, accel, gyro, (Rotation.from_rotvec(noise * tilt) * r_here).as_quat())


def measure_prism(
    rng: np.random.Generator, walk: Walk, sigma: float
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Times, s, and positions, m, of the prism as a tracking total station reports them.

    About 3 Hz, not quite evenly, with noise of `sigma`, m, in each axis; one row in forty has changed places with the
    next.
    """
    n = int(walk.duration * PRISM_RATE)
    time = (np.arange(n) + rng.uniform(0.35, 0.65, n)) / PRISM_RATE
    poses = walk.poses(time)
    position = poses.position + Rotation.from_quat(poses.quaternion).apply(PRISM.origin)
    position += sigma * rng.standard_normal((n, 3))
    order = np.arange(n)
    for i in rng.choice(n - 1, max(2, n // 40), replace=False):
        order[[i, i + 1]] = order[[i + 1, i]]
    return time[order], position[order]
