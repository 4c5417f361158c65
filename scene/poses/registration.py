"""Scans and poses to one cloud: every return moved from the pose at its own time."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from scene.cloud import Cloud, VoxelMean
from scene.errors import FitError, RecordingError, Refusal
from scene.poses.trajectory import Trajectory
from scene.progress import Stage
from scene.reading.recording import Recording
from scene.reading.times import Scan

_KNOTS = 21  # poses interpolated per sweep; between two of them, 5 ms, a walker's motion is straight
_BATCH = 20  # sweeps thinned together


def deskew(scan: Scan, trajectory: Trajectory) -> Float[np.ndarray, "n 3"]:
    """Return the scan's points in the trajectory's frame, m."""
    span = float(scan.times.max(initial=0.0))
    knots = np.linspace(0.0, max(span, 1e-9), _KNOTS)
    positions, rotations = trajectory.at(scan.stamp + knots)
    at = scan.times / knots[-1] * (_KNOTS - 1)
    low = np.minimum(at.astype(np.intp), _KNOTS - 2)
    share = (at - low)[:, None]
    matrices = rotations.as_matrix()
    points = scan.points.astype(np.float64)

    def from_pose(knot: np.ndarray) -> np.ndarray:
        return np.einsum("nij,nj->ni", matrices[knot], points) + positions[knot]

    return (1 - share) * from_pose(low) + share * from_pose(low + 1)


@dataclass(frozen=True)
class Registered:
    """The scans of a recording in one frame."""

    cloud: Cloud  # Thinned
    uncovered: int  # Scans without a pose, which are left out
    low: Float[np.ndarray, "k 3"]  # Single returns below the LiDAR, in the frame of `cloud`, m


def register_scans(
    recording: Recording, trajectory: Trajectory, voxel: float, stage: Stage, most_uncovered: float = 0.05
) -> Registered:
    """Places every return in a cloud thinned to `voxel`, m, and keeps some of those below the LiDAR as they are.

    Scans that the trajectory does not cover are left out. Raises `RecordingError` where they are more than
    `most_uncovered`, a fraction, and `FitError` where no point is left.
    """
    thinned, low, batch = VoxelMean(voxel), [np.empty((0, 3))], list[np.ndarray]()
    placed, uncovered, every = 0, 0, 1
    begin, end = np.inf, -np.inf
    with ThreadPoolExecutor(1) as second:  # one batch is thinned while the next is read
        thinning = second.submit(lambda: None)
        for scan in recording.scans():
            stage.advance()
            begin, end = min(begin, scan.stamp), max(end, scan.end)
            if not trajectory.covers(scan.stamp, scan.end):
                uncovered += 1
                continue
            points = deskew(scan, trajectory)
            batch.append(np.column_stack([points, np.nan * scan.times if scan.intensity is None else scan.intensity]))
            placed += 1
            if placed % every == 0:
                low.append(_low_returns(scan, points, trajectory))
            if len(batch) == _BATCH:
                thinning.result()
                thinning = second.submit(thinned.add, np.concatenate(batch))
                if placed == _BATCH:
                    thinning.result()
                    every = _choose_every(thinned.returns / _BATCH * recording.scan_count, trajectory)
                batch = []
        thinning.result()
    if batch:
        thinned.add(np.concatenate(batch))
    if uncovered > most_uncovered * max(recording.scan_count, 1):
        raise RecordingError(
            f"{trajectory.source}: covers {trajectory.times[0]:.2f} to {trajectory.times[-1]:.2f} s, but "
            f"{recording.path} runs from {begin:.2f} to {end:.2f} s; {uncovered} of "
            f"{recording.scan_count} scans have no pose"
        )
    cloud = thinned.cloud()
    if not len(cloud.points):
        raise FitError(f"{recording.path}: no return is left after registration", Refusal.POSES)
    chosen = np.concatenate(low) - cloud.origin
    return Registered(cloud, uncovered, chosen[np.isfinite(chosen).all(axis=1)])


# m from the sensor: nearer, the noise of a range moves a return across the face of a rail; farther, poses do.
_LOW_RANGE = (4.0, 30.0)
_BELOW = 0.3  # m under the sensor
_A_METRE = 70_000  # returns for each metre of the way that are looked at: several thousand then lie on the faces


def _low_returns(scan: Scan, points: Float[np.ndarray, "n 3"], trajectory: Trajectory) -> Float[np.ndarray, "k 3"]:
    """Return those of a placed scan that may lie on rails."""
    reach = np.linalg.norm(scan.points, axis=1)
    height = trajectory.at(np.array([scan.stamp, scan.end]))[0][:, 2].mean() - _BELOW
    return points[(reach > _LOW_RANGE[0]) & (reach < _LOW_RANGE[1]) & (points[:, 2] < height)]


def _choose_every(returns: float, trajectory: Trajectory) -> int:
    """Return how many scans apart low returns are kept, of all returns along a trajectory."""
    seconds = np.arange(trajectory.times[0], trajectory.times[-1], 1.0)
    way = float(np.linalg.norm(np.diff(trajectory.at(seconds)[0], axis=0), axis=1).sum())
    return max(int(returns / max(way, 1.0) / _A_METRE), 1)
