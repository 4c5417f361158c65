"""What of an episode is to be seen at a moment: plain arrays, without any library for drawing."""

import dataclasses

import numpy as np
from jaxtyping import Float

from subterra_jax.viewer.course import Course, dead_reckoned
from subterra_jax.viewer.recording import Recording

_TRAIL_POINTS = 500  # of a whole trail
_ELLIPSE_POINTS = 48
SIGMAS = 2.0  # half axes of the ellipse, in standard deviations
_SLIM = 0.35  # m; half width of an ellipse whose agent does not say how far off the centreline it is
_ON_GROUND = 0.06  # m above the ground, of what is drawn on it


@dataclasses.dataclass(frozen=True)
class Frame:
    """A moment.

    Attributes:
        row: Row of the recording that is at or before it.
        position: Of the robot, on the ground, m.
        heading: Of the robot, rad.
        odometry: Where the odometer alone has it, on the ground, m.
        odometry_heading: Which way it faces there, rad.
        trunk: Of who walks, height of the trunk, tunnel frame, m.
        pose: Of who walks, orientation w, x, y, z and joints, rad; empty for who rolls.
    """

    row: int
    position: Float[np.ndarray, "3"]
    heading: float
    odometry: Float[np.ndarray, "3"]
    odometry_heading: float
    trunk: float
    pose: Float[np.ndarray, "k"]


class Film:
    """An episode in three dimensions; made once, asked for each moment.

    Args:
        recording: The episode.
        course: The tunnel it happened in.
        whole: Whether the episode is over, and nothing will be added to it.
    """

    def __init__(self, recording: Recording, course: Course, *, whole: bool = True):
        self.recording, self.course, self.whole = recording, course, whole
        start = recording.position[0].astype(np.float64)
        reckoned = dead_reckoned(start, float(recording.heading[0]), recording.odometry)
        self._truth = course.lifted(recording.position, recording.station, 0.0)
        self._reckoned = course.lifted(reckoned, recording.station, 0.0)
        self._heading = np.unwrap(recording.heading.astype(np.float64))
        self._reckoned_heading = recording.heading[0] + np.unwrap(recording.odometry[:, 1].astype(np.float64))

    def __len__(self) -> int:
        return len(self.recording)

    def frame(self, at: float) -> Frame:
        """The moment `at` rows after the start, between two rows too; clipped to the episode."""
        at = float(np.clip(at, 0.0, len(self) - 1))
        row = int(at)
        after, share = min(row + 1, len(self) - 1), at - row

        def between(values: np.ndarray) -> np.ndarray:
            return (1.0 - share) * values[row] + share * values[after]

        return Frame(
            row,
            between(self._truth),
            float(between(self._heading)),
            between(self._reckoned),
            float(between(self._reckoned_heading)),
            float(between(self.recording.trunk)),
            self._pose(row, after, share),
        )

    def _pose(self, row: int, after: int, share: float) -> Float[np.ndarray, "k"]:
        """The pose on the way from one row to the next."""
        poses = self.recording.pose[after]
        if not len(poses) or after == row:
            return poses[-1] if len(poses) else np.zeros(0)
        return poses[min(int(share * len(poses)), len(poses) - 1)]

    def beams(self, row: int) -> tuple[Float[np.ndarray, "n_beams 2 3"], np.ndarray]:
        """The scan of a row, from the LiDAR to where each beam ends, m, and which beams hit something."""
        recording = self.recording
        ranges = recording.ranges[row].astype(np.float64)
        angle = recording.heading[row] + np.arange(len(ranges)) * (2.0 * np.pi / len(ranges))
        lidar = self._truth[row] + np.array([0.0, 0.0, self.course.plan.lidar_height])
        reach = np.where(np.isfinite(ranges), ranges, 0.0)
        along = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
        tips = lidar + reach[:, None] * along
        return np.stack([np.broadcast_to(lidar, tips.shape), tips], axis=1), reach < 0.99 * recording.range_max

    def trails(self, frame: Frame) -> tuple[Float[np.ndarray, "n 2 3"], Float[np.ndarray, "n 2 3"]]:
        """The way so far, true and dead-reckoned, as segments, m."""
        stride = max(1, -(-len(self) // _TRAIL_POINTS))
        rows = np.arange(0, frame.row + 1, stride)
        # Where they lie on each other one is to be seen, not both by turns.
        truth, reckoned = (np.array([0.0, 0.0, share * _ON_GROUND]) for share in (1.0, 0.6))
        return _chain(np.vstack([self._truth[rows], frame.position]) + truth), _chain(
            np.vstack([self._reckoned[rows], frame.odometry]) + reckoned
        )

    def ellipse(self, row: int) -> Float[np.ndarray, "n 2 3"]:
        """Where the agent believes to be within two standard deviations, bent along the tunnel, as segments, m.

        Across it is the spread of the agent's particles, and `_SLIM` about the centreline for one who has none. Empty
        for one who makes no estimate.
        """
        station, sigma = self.recording.estimate[row].astype(np.float64)
        if not (np.isfinite(station) and np.isfinite(sigma)):
            return np.zeros((0, 2, 3))
        middle, across = self._across(row)
        turn = np.linspace(0.0, 2.0 * np.pi, _ELLIPSE_POINTS)
        # A straight stretch of an ellipse 100 m long would leave the tunnel in a bend.
        along = np.clip(station + SIGMAS * sigma * np.cos(turn), -5.0, self.course.plan.length + 5.0)
        points = self.course.place(along, middle + across * np.sin(turn))
        return _chain(points + np.array([0.0, 0.0, 1.5 * _ON_GROUND]))

    def particles(self, row: int) -> Float[np.ndarray, "k 3"]:
        """Some of the agent's particles, m."""
        cloud = self.recording.cloud[row].astype(np.float64)
        cloud = cloud[np.isfinite(cloud).all(axis=1)]
        points = self.course.place(cloud[:, 0], cloud[:, 1])
        return points + np.array([0.0, 0.0, 2.0 * _ON_GROUND])

    def goal(self) -> Float[np.ndarray, "n 2 3"]:
        """A gate across the tunnel at the goal, as segments, m; empty where there is none."""
        if not np.isfinite(self.recording.goal):
            return np.zeros((0, 2, 3))
        station = np.array([self.recording.goal])
        half = float(np.interp(station[0], self.course.plan.station, self.course.plan.half_width)) - 0.05
        left, right = (self.course.place(station, np.array([side * half]))[0] for side in (1.0, -1.0))
        up = np.array([0.0, 0.0, 2.2])
        low = np.array([0.0, 0.0, _ON_GROUND])
        return _chain(np.array([left + low, left + up, right + up, right + low, left + low]))

    def _across(self, row: int) -> tuple[float, float]:
        """Middle and half width of the ellipse across the tunnel, m."""
        cloud = self.recording.cloud[row]
        cloud = cloud[np.isfinite(cloud).all(axis=1)]
        if not len(cloud):
            return 0.0, _SLIM
        weight = cloud[:, 2] / max(float(cloud[:, 2].sum()), 1e-12)
        mean = float(np.sum(weight * cloud[:, 1]))
        return mean, max(SIGMAS * float(np.sqrt(np.sum(weight * (cloud[:, 1] - mean) ** 2))), 0.15)


def _chain(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 2 3"]:
    """Segments between neighbours."""
    return np.stack([points[:-1], points[1:]], axis=1)
