"""Scans and poses to one cloud: every return moved from the pose at its own time."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from scene.cloud import Cloud, VoxelMean
from scene.errors import FitError, RecordingError
from scene.poses.trajectory import Trajectory
from scene.reading.recording import Recording
from scene.reading.scan import Scan

_KNOTS = 21  # poses interpolated per sweep; between two of them, 5 ms, a walker's motion is straight
_BATCH = 20  # sweeps thinned together


def deskew(scan: Scan, trajectory: Trajectory) -> Float[np.ndarray, "n 3"]:
    """The scan's points in the trajectory's frame, m."""
    span = float(scan.times.max(initial=0.0))
    knots = np.linspace(0.0, max(span, 1e-9), _KNOTS)
    positions, rotations = trajectory.at(scan.stamp + knots)
    place = scan.times / knots[-1] * (_KNOTS - 1)
    low = np.minimum(place.astype(np.intp), _KNOTS - 2)
    share = (place - low)[:, None]
    matrices = rotations.as_matrix()
    points = scan.points.astype(np.float64)

    def moved(knot: np.ndarray) -> np.ndarray:
        return np.einsum("nij,nj->ni", matrices[knot], points) + positions[knot]

    return (1 - share) * moved(low) + share * moved(low + 1)


def register(
    recording: Recording,
    trajectory: Trajectory,
    voxel: float,
    advance: Callable[[], None] = lambda: None,
    most_uncovered: float = 0.05,
) -> tuple[Cloud, int]:
    """The registered cloud, and how many scans the trajectory did not cover.

    Args:
        recording: The scans.
        trajectory: Where the sensor was.
        voxel: Thinning, m.
        advance: Called after each scan.
        most_uncovered: Share of the scans that may lack a pose; those are left out.

    Raises:
        RecordingError: The trajectory misses a larger share of the scans.
        FitError: No point is left.
    """
    thinned, batch, uncovered, span = VoxelMean(voxel), [], 0, [np.inf, -np.inf]
    for scan in recording.scans():
        advance()
        end = scan.stamp + float(scan.times.max(initial=0.0))
        span = [min(span[0], scan.stamp), max(span[1], end)]
        if not trajectory.covers(scan.stamp, end):
            uncovered += 1
            continue
        batch.append(deskew(scan, trajectory))
        if len(batch) == _BATCH:
            thinned.add(np.concatenate(batch))
            batch = []
    if batch:
        thinned.add(np.concatenate(batch))
    if uncovered > most_uncovered * max(recording.scan_count, 1):
        raise RecordingError(
            f"{trajectory.source}: covers {trajectory.times[0]:.2f} to {trajectory.times[-1]:.2f} s, but "
            f"{recording.path} runs from {span[0]:.2f} to {span[1]:.2f} s; {uncovered} of {recording.scan_count} scans "
            "have no pose"
        )
    cloud = thinned.cloud()
    if not len(cloud.points):
        raise FitError(f"{recording.path}: no return is left after registration")
    return cloud, uncovered
