"""Scans and poses to one cloud: every return moved from the pose at its own time."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from scene.cloud import Cloud, VoxelMean
from scene.errors import FitError, RecordingError
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
    `most_uncovered`, a share, and `FitError` where no point is left.
    """
    state, batch = _Registration(VoxelMean(voxel)), []
    for scan in recording.scans():
        stage.advance()
        state.span = (min(state.span[0], scan.stamp), max(state.span[1], scan.end))
        if trajectory.covers(scan.stamp, scan.end):
            batch.append(deskew(scan, trajectory))
            state.keep_low(scan, batch[-1], trajectory)
        else:
            state.uncovered += 1
        if len(batch) == _BATCH:
            state.thinned.add(np.concatenate(batch))
            state.choose_every(recording.scan_count, trajectory)
            batch = []
    if batch:
        state.thinned.add(np.concatenate(batch))
    _require_covered(state, recording, trajectory, most_uncovered)
    cloud = state.thinned.cloud()
    if not len(cloud.points):
        raise FitError(f"{recording.path}: no return is left after registration")
    low = np.concatenate([np.empty((0, 3)), *state.low]) - cloud.origin
    return Registered(cloud, state.uncovered, low[np.isfinite(low).all(axis=1)])


# m from the sensor: nearer, the noise of a range moves a return across the face of a rail; farther, poses do.
_LOW_RANGE = (4.0, 30.0)
_BELOW = 0.3  # m under the sensor
_A_METRE = 70_000  # returns for each metre of the way that are looked at: several thousand then lie on the faces


@dataclass
class _Registration:
    """State of a registration between two batches."""

    thinned: VoxelMean
    uncovered: int = 0
    span: tuple[float, float] = (np.inf, -np.inf)
    low: list[np.ndarray] = field(default_factory=list)
    placed: int = 0  # scans
    every: int = 1  # scan of which the low returns are kept

    def keep_low(self, scan: Scan, points: Float[np.ndarray, "n 3"], trajectory: Trajectory) -> None:
        """Keeps returns of a placed scan that may lie on rails."""
        self.placed += 1
        if self.placed % self.every:
            return
        reach = np.linalg.norm(scan.points, axis=1)
        ends = np.array([scan.stamp, scan.end])
        height = trajectory.at(ends)[0][:, 2].mean() - _BELOW
        near = (reach > _LOW_RANGE[0]) & (reach < _LOW_RANGE[1]) & (points[:, 2] < height)
        self.low.append(points[near])

    def choose_every(self, scans: int, trajectory: Trajectory) -> None:
        """Chooses how many scans give low returns, once the first batch tells how many returns a scan has."""
        if self.placed != _BATCH:
            return
        seconds = np.arange(trajectory.times[0], trajectory.times[-1], 1.0)
        way = float(np.linalg.norm(np.diff(trajectory.at(seconds)[0], axis=0), axis=1).sum())
        self.every = max(int(self.thinned.returns / _BATCH * scans / max(way, 1.0) / _A_METRE), 1)


def _require_covered(state: _Registration, recording: Recording, trajectory: Trajectory, most_uncovered: float) -> None:
    if state.uncovered > most_uncovered * max(recording.scan_count, 1):
        raise RecordingError(
            f"{trajectory.source}: covers {trajectory.times[0]:.2f} to {trajectory.times[-1]:.2f} s, but "
            f"{recording.path} runs from {state.span[0]:.2f} to {state.span[1]:.2f} s; {state.uncovered} of "
            f"{recording.scan_count} scans have no pose"
        )
