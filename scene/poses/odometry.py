"""LiDAR odometry: each sweep against a map of those before it, by small-gicp, blended with what was expected of it.

In a bore a sweep barely constrains its place along the axis, and plain registration then jumps about. Each result is
therefore blended with the expected pose by the information of both: where the walls say little, the expectation
stands. It comes from a guide (a gyro, or an earlier trajectory), else from going on as before.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from scene.cli import Stage
from scene.errors import FitError
from scene.poses.odometrylog import OdometryLog, Tracked
from scene.poses.tracker import LIBRARY, MIN_POINTS, Guide, Tracker
from scene.poses.trajectory import Trajectory
from scene.reading.recording import Recording


@dataclass(frozen=True)
class Odometry:
    """Poses of the LiDAR in the middle of each sweep, in the frame of the first of them.

    Attributes:
        trajectory: The poses.
        weakest: Unit direction in each sweep that its walls say least about: the bore's axis, `(n, 3)`.
    """

    trajectory: Trajectory
    weakest: Float[np.ndarray, "n 3"]


def estimate_odometry(recording: Recording, guide: Guide | None, stage: Stage, log: OdometryLog) -> Odometry:
    """One pose for each sweep of at least 100 returns.

    Args:
        recording: The recording; each scan is read once.
        guide: See `Guide`; without one, each sweep is expected to go on as the last did.
        stage: Counts the scans.
        log: What an earlier build tracked, and where this one keeps what it does.

    Raises:
        FitError: Fewer than two usable scans.
    """
    tracked = log.read()
    tracker = Tracker()
    if tracked.times:
        stage.resume(tracked.place.messages)
    if not tracked.done:
        for thinned, pose, middle in zip(tracked.thinned, tracked.poses, tracked.times, strict=True):
            tracker.follow(thinned, pose, middle)
        _track(recording, guide, stage, log, tracker, tracked)
    if len(tracked.times) < 2:
        count = len(tracked.times)
        raise FitError(f"{recording.path}: only {count} scans hold {MIN_POINTS} points; too few for odometry")
    stack = np.asarray(tracked.poses)
    poses = Trajectory(np.asarray(tracked.times), stack[:, :3, 3], Rotation.from_matrix(stack[:, :3, :3]), LIBRARY)
    return Odometry(poses, np.asarray(tracked.weakest))


def _track(
    recording: Recording, guide: Guide | None, stage: Stage, log: OdometryLog, tracker: Tracker, tracked: Tracked
) -> None:
    times = tracked.times
    for scan in recording.scans(tracked.place):
        stage.advance()
        span = float(scan.times.max(initial=0.0))
        middle = scan.stamp + 0.5 * span
        if (
            len(scan.points) < MIN_POINTS
            or (guide and not guide.trajectory.covers(scan.stamp, scan.stamp + span))
            or (times and middle <= times[-1])  # a message that was recorded twice
        ):
            continue
        weakest = tracker.register(scan, middle, guide)
        log.add(tracked, middle, tracker.poses[-1], weakest, tracker.thinned)
        if log.due():
            log.write(tracked, recording.place)
    log.write(tracked, recording.place, done=True)
