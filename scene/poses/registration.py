"""Scans and poses to one cloud: every return moved from the pose at its own time."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from scene.cloud import Cloud, VoxelMean
from scene.errors import FitError, RecordingError
from scene.poses.trajectory import Trajectory
from scene.progress import Stage
from scene.reading.recording import START, ReadPosition, Recording
from scene.reading.scans import Scan
from scene.resume import Partial

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


def register_scans(
    recording: Recording,
    trajectory: Trajectory,
    voxel: float,
    stage: Stage,
    most_uncovered: float = 0.05,
    partial: Partial | None = None,
) -> tuple[Cloud, int]:
    """Places every return; returns the cloud, thinned to `voxel`, m, and the number of scans without a pose.

    Scans that the trajectory does not cover are left out. Raises `RecordingError` where they are more than
    `most_uncovered`, a share, and `FitError` where no point is left.
    """
    partial = partial or Partial(None)
    state = _Registration(VoxelMean(voxel))
    if (known := partial.load("cloud")) is not None:
        state = _Registration.restored(known, voxel)
        stage.resume(state.position.messages)
    batch = []
    for scan in recording.scans(state.position):
        stage.advance()
        end = scan.stamp + float(scan.times.max(initial=0.0))
        state.span = (min(state.span[0], scan.stamp), max(state.span[1], end))
        if trajectory.covers(scan.stamp, end):
            batch.append(deskew(scan, trajectory))
        else:
            state.uncovered += 1
        if len(batch) == _BATCH:
            state.thinned.add(np.concatenate(batch))
            batch, state.position = [], recording.position
            if partial.due():
                partial.save("cloud", **state.arrays())
    if batch:
        state.thinned.add(np.concatenate(batch))
    state.position = recording.position
    _require_covered(state, recording, trajectory, most_uncovered)
    if partial.due():
        partial.save("cloud", **state.arrays())
    cloud = state.thinned.cloud()
    if not len(cloud.points):
        raise FitError(f"{recording.path}: no return is left after registration")
    return cloud, state.uncovered


@dataclass
class _Registration:
    """State of a registration between two batches."""

    thinned: VoxelMean
    position: ReadPosition = START
    uncovered: int = 0
    span: tuple[float, float] = (np.inf, -np.inf)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the state as arrays, for a partial result."""
        counts = {"place": self.position.as_array(), "uncovered": np.array(self.uncovered), "span": np.array(self.span)}
        return {**counts, **self.thinned.arrays()}

    @classmethod
    def restored(cls, arrays: dict[str, np.ndarray], voxel: float) -> "_Registration":
        """Return the state that `arrays` returned as arrays."""
        start, end = arrays["span"]
        return cls(
            VoxelMean.restored(voxel, arrays),
            ReadPosition.from_array(arrays["place"]),
            int(arrays["uncovered"]),
            (float(start), float(end)),
        )


def _require_covered(state: _Registration, recording: Recording, trajectory: Trajectory, most_uncovered: float) -> None:
    if state.uncovered > most_uncovered * max(recording.scan_count, 1):
        raise RecordingError(
            f"{trajectory.source}: covers {trajectory.times[0]:.2f} to {trajectory.times[-1]:.2f} s, but "
            f"{recording.path} runs from {state.span[0]:.2f} to {state.span[1]:.2f} s; {state.uncovered} of "
            f"{recording.scan_count} scans have no pose"
        )
