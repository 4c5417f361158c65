"""Where things were: the robot's true poses in three dimensions, and those that its odometer believes.

Frames as in REP 105: `map` is the tunnel frame, `base_link` stands on the track under the LiDARs, x ahead, y to the
left, z square to the track; `odom` is `base_link` at the start. Both LiDARs and the IMU sit at LiDAR height above it.
"""

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from subterra_jax.recorder.drive import Trace
from subterra_jax.tunnel.plan import TunnelPlan


@dataclasses.dataclass(frozen=True)
class Poses:
    """Poses over time.

    Attributes:
        time: Since the start, s, `(n,)`.
        position: m, `(n, 3)`.
        rotation: Body to fixed frame, `n` of them.
    """

    time: Float[np.ndarray, " n"]
    position: Float[np.ndarray, "n 3"]
    rotation: Rotation

    def __len__(self) -> int:
        return len(self.time)

    def lifted(self, height: float) -> "Poses":
        """Poses of a sensor above the body's origin, m."""
        return dataclasses.replace(self, position=self.position + self.rotation.apply([0.0, 0.0, height]))


def true_poses(trace: Trace, plan: TunnelPlan) -> Poses:
    """Poses of `base_link` in the tunnel frame: on the track, pitched by its grade, never rolled.

    Args:
        trace: The episode.
        plan: The tunnel it happened in.
    """
    state = trace.state
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
    """Poses of `base_link` in `odom`: the odometer's distance (m) along its heading (rad), level.

    Args:
        trace: The episode.
        reading: What the agent saw of the odometer, late where the task delays it.
    """
    distance, heading = np.asarray(reading, np.float64).T
    turned = np.unwrap(heading)
    middle, moved = 0.5 * (turned[1:] + turned[:-1]), np.diff(distance)
    steps = np.column_stack([moved * np.cos(middle), moved * np.sin(middle), np.zeros(len(moved))])
    position = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return Poses(trace.time, position, Rotation.from_rotvec(turned[:, None] * np.array([0.0, 0.0, 1.0])))


def axis_rows(plan: TunnelPlan) -> Float[np.ndarray, "n 4"]:
    """Station (m) and position (m) of the track's centre, for scoring along and across."""
    return np.column_stack([plan.station, plan.centre, plan.elevation])


def tum_rows(poses: Poses, epoch: float) -> Float[np.ndarray, "n 8"]:
    """Rows `t x y z qx qy qz qw`, t in s since 1970."""
    return np.column_stack([epoch + poses.time, poses.position, poses.rotation.as_quat(canonical=True)])
