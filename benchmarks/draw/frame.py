"""One frame of a recording: the returns of a short time, taken where the LiDAR looked along the bore."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.ndimage import minimum_filter1d

from benchmarks.command import BenchmarkError
from scene.poses.trajectory import Trajectory, load_tum
from scene.reading.recording import Recording
from scene.reading.times import Scan


@dataclass(frozen=True)
class Stretch:
    """A piece of the bore where a frame may be taken."""

    position: Float[np.ndarray, "3"]  # Its middle in the tunnel frame, m
    axis: Float[np.ndarray, "3"]  # Unit vector along the bore
    radius: float  # Largest distance of a frame from `position`, m


@dataclass(frozen=True)
class Frame:
    """Returns of a short time, in the tunnel frame."""

    position: Float[np.ndarray, "3"]  # LiDAR position in the middle of that time, m
    origin: Float[np.ndarray, "n 3"]  # LiDAR position at each return, m
    points: Float[np.ndarray, "n 3"]  # Returns, m
    single: slice  # Rows of the scan in the middle
    topic: str  # Topic of the recording
    duration: float  # Length of the frame, s


def load_frame(
    recording: Path, trajectory: Path, origin: Float[np.ndarray, "3"], stretch: Stretch, duration: float
) -> Frame:
    """Reads the frame that was taken in a stretch of the bore when the LiDAR looked along it.

    Args:
        recording: A recording that `scene` can read.
        trajectory: Poses of its LiDAR, TUM file.
        origin: Origin of the tunnel frame in the trajectory's frame, m.
        stretch: Piece of the bore.
        duration: Length of the frame, s.

    Raises:
        BenchmarkError: No scan lies within that time.
        RecordingError: The recording or the trajectory cannot be read.
    """
    poses = load_tum(trajectory)
    taken: list[Scan] = []
    with Recording(recording) as opened:
        middle = _best_time(poses, origin, stretch, next(opened.scans()), duration)
        for scan in opened.scans():
            if scan.stamp > middle + 0.5 * duration:
                break
            if scan.stamp >= middle - 0.5 * duration and len(scan.times):
                taken.append(scan)
        topic = opened.topic
    if not taken:
        raise BenchmarkError(
            f"{recording}: no scan within {duration:g} s of {middle:.3f} s, when {trajectory} is there"
        )
    sensor, points = [], []
    for scan in taken:
        position, rotation = poses.at(scan.stamp + scan.times)
        sensor.append(position - origin)
        points.append(position - origin + rotation.apply(scan.points))
    half = len(taken) // 2
    first = sum(len(scan.times) for scan in taken[:half])
    here = poses.at(np.array([middle]))[0][0] - origin
    single = slice(first, first + len(taken[half].times))
    return Frame(here, np.concatenate(sensor), np.concatenate(points), single, topic, duration)


def _best_time(
    poses: Trajectory, origin: Float[np.ndarray, "3"], stretch: Stretch, first: Scan, duration: float
) -> float:
    """Returns when the LiDAR, inside the stretch, looked most nearly along the axis, either way, s.

    The mean of its beams is its viewing direction. For a sensor that sees all round it is short, and any time will do.
    """
    gaze = (first.points / np.maximum(np.linalg.norm(first.points, axis=1), 1e-9)[:, None]).mean(axis=0)
    along = np.abs(poses.rotations.apply(gaze) @ stretch.axis)
    width = max(1, round(duration / float(np.median(np.diff(poses.times)))))
    held = minimum_filter1d(along, width, mode="constant")  # over the whole frame, not for a moment
    away = np.linalg.norm(poses.positions - origin - stretch.position, axis=1)
    near = np.flatnonzero(away <= max(stretch.radius, away.min()))
    return float(poses.times[near[np.argmax(held[near])]])
