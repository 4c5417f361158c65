"""One frame of the recording that the builder read: a second of returns, placed by the trajectory."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.ndimage import minimum_filter1d

from benchmarks.paper.errors import PaperError
from scene.poses.trajectory import Trajectory, load_tum
from scene.reading.recording import Recording
from scene.reading.scans import Scan


@dataclass(frozen=True)
class Place:
    """A stretch of the bore.

    Attributes:
        at: Tunnel frame, m, `(3,)`.
        axis: Unit vector along the bore, `(3,)`.
        radius: How far from `at` a frame may be taken, m.
    """

    at: Float[np.ndarray, "3"]
    axis: Float[np.ndarray, "3"]
    radius: float


@dataclass(frozen=True)
class Frame:
    """Returns of a short while, tunnel frame.

    Attributes:
        at: Where the LiDAR was in the middle of it, m, `(3,)`.
        origin: Where it was at each return, m, `(n, 3)`.
        points: m, `(n, 3)`.
        single: Rows of the scan in the middle, one turn or pattern of the sensor.
        topic: Of the recording.
        duration: s.
    """

    at: Float[np.ndarray, "3"]
    origin: Float[np.ndarray, "n 3"]
    points: Float[np.ndarray, "n 3"]
    single: slice
    topic: str
    duration: float


def load_frame(
    recording: Path, trajectory: Path, origin: Float[np.ndarray, "3"], place: Place, duration: float
) -> Frame:
    """The frame taken near a place when the LiDAR looked along the bore.

    Args:
        recording: Any that `scene` reads.
        trajectory: Poses of its LiDAR, TUM.
        origin: Of the tunnel frame in the trajectory's frame, m.
        place: Where, and along which axis.
        duration: How long it lasts, s.

    Raises:
        PaperError: No scan lies within that time.
        RecordingError: Unreadable.
    """
    poses = load_tum(trajectory)
    taken: list[Scan] = []
    with Recording(recording) as opened:
        middle = _best_time(poses, origin, place, next(opened.scans()), duration)
        for scan in opened.scans():
            if scan.stamp > middle + 0.5 * duration:
                break
            if scan.stamp >= middle - 0.5 * duration and len(scan.times):
                taken.append(scan)
        topic = opened.topic
    if not taken:
        raise PaperError(f"{recording}: no scan within {duration:g} s of {middle:.3f} s, when {trajectory} is there")
    placed = [_placed(scan, poses, origin) for scan in taken]
    half = len(taken) // 2
    first = sum(len(scan.times) for scan in taken[:half])
    at = poses.at(np.array([middle]))[0][0] - origin
    return Frame(
        at,
        np.concatenate([one[0] for one in placed]),
        np.concatenate([one[1] for one in placed]),
        slice(first, first + len(taken[half].times)),
        topic,
        duration,
    )


def _best_time(poses: Trajectory, origin: Float[np.ndarray, "3"], place: Place, first: Scan, duration: float) -> float:
    """When the LiDAR, near the place, looked most nearly along its axis, either way, s.

    Where it looks is the mean of its beams; that of a sensor that sees all round is short, and any time will do.
    """
    gaze = (first.points / np.maximum(np.linalg.norm(first.points, axis=1), 1e-9)[:, None]).mean(axis=0)
    along = np.abs(poses.rotations.apply(gaze) @ place.axis)
    width = max(1, round(duration / float(np.median(np.diff(poses.times)))))
    held = minimum_filter1d(along, width, mode="constant")  # over the whole frame, not in passing
    away = np.linalg.norm(poses.positions - origin - place.at, axis=1)
    near = np.flatnonzero(away <= max(place.radius, away.min()))
    return float(poses.times[near[np.argmax(held[near])]])


def _placed(scan: Scan, poses: Trajectory, origin: Float[np.ndarray, "3"]) -> tuple[np.ndarray, np.ndarray]:
    """Where the sensor was, and the returns that are none of its silent beams."""
    position, rotation = poses.at(scan.stamp + scan.times)
    return position - origin, position - origin + rotation.apply(scan.points)
