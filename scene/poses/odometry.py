"""LiDAR odometry: each sweep against a map of those before it, by small-gicp, blended with the expected pose.

In a bore a sweep barely constrains its place along the axis, and plain registration then jumps about. Each result is
therefore blended with the expected pose by the information of both: where the walls say little, the expectation
stands. It comes from a guide (a gyro, or an earlier trajectory), else from going on as before.
"""

from dataclasses import dataclass

import numpy as np
import small_gicp
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from scene.errors import FitError, Refusal
from scene.poses.trajectory import Trajectory, deskew
from scene.progress import Stage
from scene.reading.recording import Recording
from scene.reading.times import Scan

LIBRARY = "small-gicp"
MIN_POINTS = 100  # points of a scan that can be matched
_RANGE = 60.0  # m
_THINNING, _VOXEL, _REACH = 0.25, 0.5, 1.0  # m: of a sweep, of the map, of a correspondence
_NEIGHBOURS = 10  # whose spread is a point's covariance
_HORIZON = 100  # sweeps that an unseen voxel of the map is kept for
_WARM_UP = 5  # sweeps before the expectation is worth anything without a guide
_KNOTS = 11  # poses that a sweep is unwound with
_LEAST_SPAN = 1e-3  # s, of a static sweep: stamps since 1970 have 2e-7 s


@dataclass(frozen=True)
class Guide:
    """Motion that is known before the LiDAR is asked."""

    trajectory: Trajectory  # Attitudes of the LiDAR, and its positions where `moves`, in any fixed frame
    moves: bool  # True where the positions mean anything
    turn_sigma: float  # Standard deviation of the turn from one sweep to the next, rad
    shift_sigma: float  # Standard deviation of the shift from one sweep to the next, m


class Tracker:
    """The map so far, and the pose of every sweep in it.

    Attributes:
        poses: Sweep to map, Pose of each, `(4, 4)`.
    """

    def __init__(self) -> None:
        self.poses: list[np.ndarray] = []
        self._map = small_gicp.GaussianVoxelMap(_VOXEL)
        self._map.set_lru(horizon=_HORIZON, clear_cycle=10)
        self._time = 0.0
        self._step = np.eye(4)
        self._pace = 0.1  # s that `_step` took

    def register(self, scan: Scan, middle: float, guide: Guide | None) -> np.ndarray:
        """Adds a sweep; returns the direction in it that its walls say least about."""
        last = self.poses[-1] if self.poses else np.eye(4)
        gap = middle - self._time if self.poses else self._pace
        step = self._expected(middle, gap, guide)
        points = self._unwound(scan, middle, guide, step, gap)
        near = points[np.linalg.norm(points, axis=1) < _RANGE]
        # One thread: sums in one order, so that the same recording gives the same bytes.
        if len(near):  # the library prints a warning of its own about none
            source, _ = small_gicp.preprocess_points(near, _THINNING, _NEIGHBOURS, num_threads=1)
        size = source.size() if len(near) else 0
        pose, weakest = last @ step, np.array([1.0, 0.0, 0.0])
        if self.poses and size >= MIN_POINTS:
            result = small_gicp.align(self._map, source, pose, max_correspondence_distance=_REACH, num_threads=1)
            if result.num_inliers >= MIN_POINTS and np.isfinite(result.T_target_source).all():
                weakest = _weakest_direction(result.H)
                pose = _blend_poses(result, pose, *self._sigmas(guide))
        if size >= MIN_POINTS or (size and not self.poses):
            self._map.insert(source, pose)
        if self.poses:
            self._step, self._pace = np.linalg.inv(last) @ pose, gap
        self._time = middle
        self.poses.append(pose)
        return weakest

    def trajectory(self, times: list[float], source: str) -> Trajectory:
        """Return the poses of all sweeps, of whose middles `times`, s, are."""
        stack = np.stack(self.poses)
        return Trajectory(np.array(times), stack[:, :3, 3], Rotation.from_matrix(stack[:, :3, :3]), source)

    def _sigmas(self, guide: Guide | None) -> tuple[float, float]:
        if guide is None:
            return (np.deg2rad(0.5), 0.02) if len(self.poses) > _WARM_UP else (np.inf, np.inf)
        moving = guide.moves or len(self.poses) > _WARM_UP
        return guide.turn_sigma, guide.shift_sigma if moving else np.inf

    def _expected(self, middle: float, gap: float, guide: Guide | None) -> np.ndarray:
        """Return the step from the last sweep's pose to this one's, by the guide or as the last step was."""
        fraction = gap / self._pace
        step = _pose_matrix(Rotation.from_matrix(self._step[:3, :3]) ** fraction, fraction * self._step[:3, 3])
        if guide is not None and self.poses:
            places, turns = guide.trajectory.at(np.array([self._time, middle]))
            step[:3, :3] = (turns[0].inv() * turns[1]).as_matrix()
            if guide.moves:
                step[:3, 3] = turns[0].inv().apply(places[1] - places[0])
        return step

    def _unwound(self, scan: Scan, middle: float, guide: Guide | None, step: np.ndarray, gap: float) -> np.ndarray:
        """Return the sweep's points as seen from where the sensor was in the middle of it, m."""
        times = np.linspace(scan.stamp, max(2 * middle - scan.stamp, scan.stamp + _LEAST_SPAN), _KNOTS)
        fraction = (times - middle) / gap
        shifts = fraction[:, None] * step[:3, 3]
        if guide is None:
            turns = Rotation.from_rotvec(fraction[:, None] * Rotation.from_matrix(step[:3, :3]).as_rotvec())
        else:
            places, turns = guide.trajectory.at(times)
            back = turns[_KNOTS // 2].inv()
            if guide.moves:
                shifts = back.apply(places - places[_KNOTS // 2])
            turns = back * turns
        return deskew(scan, Trajectory(times, shifts, turns, LIBRARY))


def _pose_matrix(turn: Rotation, shift: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.as_matrix(), shift
    return pose


def _weakest_direction(information: np.ndarray) -> np.ndarray:
    """Return the direction of least information on the shift, once the turn is free."""
    turn, cross, shift = information[:3, :3], information[:3, 3:], information[3:, 3:]
    return np.linalg.eigh(shift - cross.T @ np.linalg.solve(turn, cross))[1][:, 0]


def _blend_poses(
    result: small_gicp.RegistrationResult, expected: np.ndarray, turn_sigma: float, shift_sigma: float
) -> np.ndarray:
    """Return the registered pose, moved towards the expected one where that is the surer of the two.

    Source: the posterior of two Gaussians, in the tangent space of the registered pose.
    """
    pose = result.T_target_source
    gap = np.linalg.inv(pose) @ expected
    way = np.concatenate([Rotation.from_matrix(gap[:3, :3]).as_rotvec(), gap[:3, 3]])
    trust = np.diag(np.repeat([turn_sigma**-2.0, shift_sigma**-2.0], 3))
    part = np.linalg.solve(result.H + trust, trust @ way)
    return pose @ _pose_matrix(Rotation.from_rotvec(part[:3]), part[3:])


@dataclass(frozen=True)
class Odometry:
    """Poses of the LiDAR in the middle of each sweep, in the frame of the first of them."""

    trajectory: Trajectory  # The poses
    weakest: Float[np.ndarray, "n 3"]  # Unit direction in each sweep that its walls say least about: the bore's axis


def estimate_odometry(recording: Recording, guide: Guide | None, stage: Stage) -> Odometry:
    """Estimates one pose for each sweep of at least 100 returns; raises `FitError` for fewer than two.

    Without a guide, each sweep is expected to go on as the last did.
    """
    tracker, times, weakest = Tracker(), list[float](), list[np.ndarray]()
    for scan in recording.scans():
        stage.advance()
        span = float(scan.times.max(initial=0.0))
        middle = scan.stamp + 0.5 * span
        if (
            len(scan.points) < MIN_POINTS
            or (guide and not guide.trajectory.covers(scan.stamp, scan.stamp + span))
            or (times and middle <= times[-1])  # a message that was recorded twice
        ):
            continue
        weakest.append(tracker.register(scan, middle, guide))
        times.append(middle)
    if len(times) < 2:
        why = f"{recording.path}: only {len(times)} scans hold {MIN_POINTS} points; too few for odometry"
        raise FitError(why, Refusal.POSES)
    return Odometry(tracker.trajectory(times, LIBRARY), np.asarray(weakest))
