"""Messages that the recorder makes of an episode: poses in three dimensions, and further sensors along them.

Frames as in REP 105: `map` is the tunnel frame, `base_link` stands on the track under the LiDARs, x ahead, y to the
left, z square to the track; `odom` is `base_link` at the start. Both LiDARs and the IMU sit at LiDAR height above it.
"""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from subterra_jax.host import rover
from subterra_jax.recorder.trace import Trace, reckon
from subterra_jax.tunnel.plan import TunnelPlan


@dataclasses.dataclass(frozen=True)
class Poses:
    """Poses over time."""

    time: Float[np.ndarray, " n"]  # time since the start, s, `(n,)`
    position: Float[np.ndarray, "n 3"]  # positions, m, `(n, 3)`
    rotation: Rotation  # rotations from the body to the fixed frame, `n` of them

    def __len__(self) -> int:
        return len(self.time)

    def lift(self, height: float) -> "Poses":
        """Return the poses of a sensor `height` metres above the body's origin."""
        return dataclasses.replace(self, position=self.position + self.rotation.apply([0.0, 0.0, height]))


def true_poses(trace: Trace, plan: TunnelPlan, track: Any = None) -> Poses:
    """Return the poses of `base_link` in the tunnel frame: on the track, pitched by its grade, never rolled.

    Args:
        track: Ground of a robot by physics, on which it leans as it drives; None for one on the plan.
    """
    state = trace.state
    if track is not None:
        ride = state.parts["rover"]
        turn = Rotation.from_quat(np.asarray(ride.body.qpos, np.float64)[:, [4, 5, 6, 3]])
        middle = np.asarray(track.position, np.float64)[ride.anchor] + np.asarray(ride.body.qpos, np.float64)[:, :3]
        return Poses(trace.time, middle - rover.HEIGHT * turn.as_matrix()[:, :, 2], turn)
    station = np.asarray(state.station, np.float64)
    tangent = np.stack([np.interp(station, plan.station, plan.tangent[:, i]) for i in range(2)], axis=-1)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    grade = np.interp(station, plan.station, np.gradient(plan.elevation, plan.station))
    along = np.column_stack([tangent, grade]) / np.sqrt(1.0 + grade * grade)[:, None]
    left = np.column_stack([-tangent[:, 1], tangent[:, 0], np.zeros(len(station))])
    turn = np.asarray(state.heading, np.float64) - np.arctan2(tangent[:, 1], tangent[:, 0])
    ahead = np.cos(turn)[:, None] * along + np.sin(turn)[:, None] * left
    up = np.cross(along, left)
    axes = np.stack([ahead, np.cross(up, ahead), up], axis=-1)
    height = np.interp(station, plan.station, plan.elevation)
    position = np.column_stack([np.asarray(state.position, np.float64), height])
    return Poses(trace.time, position, Rotation.from_matrix(axes))


def reckoned_poses(trace: Trace, reading: Float[np.ndarray, "n 2"]) -> Poses:
    """Return the poses of `base_link` in `odom`: the odometer's distance (m) along its heading (rad), level.

    Args:
        reading: Odometer as observed by the agent, with the task's delay.
    """
    place, heading = reckon(reading)
    level, about_z = np.column_stack([place, np.zeros(len(place))]), np.array([0.0, 0.0, 1.0])
    return Poses(trace.time, level, Rotation.from_rotvec(heading[:, None] * about_z))


def axis_rows(plan: TunnelPlan) -> Float[np.ndarray, "n 4"]:
    """Return station (m) and position (m) of the track's centre, for scoring along and across."""
    return np.column_stack([plan.station, plan.centre, plan.elevation])


def tum_rows(poses: Poses, epoch: float) -> Float[np.ndarray, "n 8"]:
    """Return rows `t x y z qx qy qz qw`, t in s since 1970."""
    return np.column_stack([epoch + poses.time, poses.position, poses.rotation.as_quat(canonical=True)])


IMU_RATE = 100.0  # Hz
GRAVITY = 9.80665  # m/s²
# Standard deviations of a sample, random walks and constant biases of an MTi-30. Source: GEODE dataset, calibration
# of its γ rack (`acc_n`, `gyr_n`, `acc_w`, `gyr_w`); the biases are the data sheet's order of magnitude.
ACCEL_SIGMA, ACCEL_WALK, ACCEL_BIAS = 5.574e-3, 1.208e-4, 0.02  # m/s², m/s²/√s, m/s²
GYRO_SIGMA, GYRO_WALK, GYRO_BIAS = 5.144e-3, 1.088e-4, 0.003  # rad/s, rad/s/√s, rad/s
_HALF_STEP = 1e-3  # s, of the central difference of the attitude


@dataclasses.dataclass(frozen=True)
class Inertial:
    """Samples of the IMU in its own frame, which is oriented like `base_link`."""

    time: Float[np.ndarray, " n"]  # time since the start, s, `(n,)`
    gyro: Float[np.ndarray, "n 3"]  # rates, rad/s, `(n, 3)`
    accel: Float[np.ndarray, "n 3"]  # specific force, m/s², `(n, 3)`; +9.8 upwards at rest


def measure_imu(poses: Poses, seed: int, noise: float = 1.0) -> Inertial:
    """Simulate IMU samples along cubic splines through poses.

    Commands change the speed at once; the splines spread that over a control period or two.

    Args:
        poses: Poses of the IMU, at least two.
        seed: Seed of noise and biases.
        noise: Factor on all errors; 0 gives the truth.
    """
    n = int(np.floor(poses.time[-1] * IMU_RATE + 1e-6)) + 1
    time = np.arange(n) / IMU_RATE
    angles = np.unwrap(poses.rotation.as_euler("ZYX"), axis=0)
    place, turn = CubicSpline(poses.time, poses.position), CubicSpline(poses.time, angles)

    def attitude(at: Float[np.ndarray, " n"]) -> Rotation:
        return Rotation.from_euler("ZYX", turn(at))

    gyro = (attitude(time - _HALF_STEP).inv() * attitude(time + _HALF_STEP)).as_rotvec() / (2.0 * _HALF_STEP)
    accel = attitude(time).inv().apply(place(time, 2) + np.array([0.0, 0.0, GRAVITY]))
    rng = np.random.default_rng([seed, 0x1A1])
    walk = rng.standard_normal((2, n, 3)).cumsum(axis=1) / np.sqrt(IMU_RATE)
    white, bias = rng.standard_normal((2, n, 3)), rng.standard_normal((2, 1, 3))
    gyro = gyro + noise * (GYRO_SIGMA * white[0] + GYRO_WALK * walk[0] + GYRO_BIAS * bias[0])
    accel = accel + noise * (ACCEL_SIGMA * white[1] + ACCEL_WALK * walk[1] + ACCEL_BIAS * bias[1])
    return Inertial(time, gyro, accel)
