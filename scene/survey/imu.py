"""What the two IMUs and the total station report along the walk."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from scene.survey.carrier import Walk
from scene.survey.field import draw_field

GRAVITY = 9.80665  # m/s²
# GEODE, device γ, external MTi-30: p_imu = R p_lidar + t [geode.md]. Its printed digits are made orthonormal.
_R_MTI = np.array([[0.99962, 0.027463, 0.002445], [-0.027517, 0.999299, 0.025398], [-0.001746, -0.025456, 0.999674]])
_U, _, _VT = np.linalg.svd(_R_MTI)
MTI_LIDAR = (_U @ _VT, np.array([0.049258, -0.0125, 0.026946]))
# The Avia's own IMU sits in the housing, axes parallel; the offset is the one FAST-LIO ships for the Avia.
AVIA_LIDAR = (np.eye(3), np.array([0.04165, 0.02326, -0.0284]))
# GEODE, γ to Leica (t, q as x y z w) [geode.md]; the reference point is T⁻¹ applied to the LiDAR's pose.
PRISM_LIDAR = (
    Rotation.from_quat([-0.00492765, 0.00575961, 0.0117651, 0.999901]).as_matrix(),
    np.array([0.00947221, -0.308202, -0.365733]),
)
PRISM_RATE, PRISM_SIGMA = 3.0, 0.0025  # Hz, m in each axis
# GEODE's γ figures [geode.md]. As standard deviations of one sample they agree with the MTi-30's data sheet
# (0.03 °/s/√Hz, 60 µg/√Hz at 100 Hz); as densities they would be ten times worse than the instrument.
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
    rng: np.random.Generator, walk: Walk, rate: float, mount: tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]
) -> Inertial:
    """Simulate an IMU.

    Roll and pitch of its orientation are off by 0.2° (1 σ), slowly changing; its heading is magnetic, so it has an
    offset of up to 15° and wanders by 1°.

    Args:
        rng: Source of randomness.
        walk: The LiDAR's motion.
        rate: Samples per second, Hz.
        mount: R and t of p_imu = R p_lidar + t.
    """
    time = np.arange(round(walk.duration * rate)) / rate
    turn = Rotation.from_matrix(mount[0].T)
    lever = -mount[0].T @ mount[1]

    def state(at: np.ndarray) -> tuple[np.ndarray, Rotation]:
        poses = walk.poses(at)
        attitude = Rotation.from_quat(poses.quaternion)
        return poses.position + attitude.apply(lever), attitude * turn

    (before, r_before), (here, r_here), (after, r_after) = (state(time + k * _H) for k in (-1.0, 0.0, 1.0))
    force = (after - 2.0 * here + before) / _H**2 + (0.0, 0.0, GRAVITY)
    accel = r_here.inv().apply(force)
    gyro = (r_before.inv() * r_after).as_rotvec() / (2.0 * _H)

    n = len(time)
    walks = rng.standard_normal((2, n, 3)).cumsum(axis=1) / np.sqrt(rate)
    accel += ACCEL_SIGMA * rng.standard_normal((n, 3)) + ACCEL_WALK * walks[0] + rng.normal(0.0, 0.02, 3)
    gyro += GYRO_SIGMA * rng.standard_normal((n, 3)) + GYRO_WALK * walks[1] + rng.normal(0.0, 0.003, 3)
    degree = np.pi / 180.0
    tilt = np.stack([draw_field(rng, s * degree, 20.0).along(time) for s in (0.2, 0.2, 1.0)], axis=-1)
    tilt[:, 2] += rng.uniform(-15.0, 15.0) * degree
    return Inertial(time, accel, gyro, (Rotation.from_rotvec(tilt) * r_here).as_quat())


def measure_prism(rng: np.random.Generator, walk: Walk) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Times, s, and positions, m, of the prism as a tracking total station reports them.

    About 3 Hz, not quite evenly, with noise; one row in forty has changed places with the next.
    """
    n = int(walk.duration * PRISM_RATE)
    time = (np.arange(n) + rng.uniform(0.35, 0.65, n)) / PRISM_RATE
    poses = walk.poses(time)
    lever = -PRISM_LIDAR[0].T @ PRISM_LIDAR[1]
    position = poses.position + Rotation.from_quat(poses.quaternion).apply(lever)
    position += PRISM_SIGMA * rng.standard_normal((n, 3))
    order = np.arange(n)
    for i in rng.choice(n - 1, max(2, n // 40), replace=False):
        order[[i, i + 1]] = order[[i + 1, i]]
    return time[order], position[order]
