"""The gauge from single returns: in a thinned cloud the mean of a voxel mixes the side of a head with its top."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from scene.bore import Bore
from scene.fitting.rails import measure_again
from scene.fitting.trackseen import SeenLine, SeenTrack, above_floor
from scene.poses.registration import deskew
from scene.poses.trajectory import Trajectory
from scene.progress import Stages
from scene.reading.recording import Recording

# m from the sensor: nearer, the noise of a range moves a return across the face, and not along it; farther, poses do.
_RANGE = (4.0, 30.0)
_BELOW = 0.3  # m under the sensor
_TALLEST = 0.8  # m above the floor
_BESIDE = 0.10  # m to each side of the middle of a rail
_A_METRE = 70_000  # returns for each metre of the bore that are looked at: several thousand then lie on the faces
_BATCH = 40  # scans


def look_again(
    recording: Recording,
    trajectory: Trajectory,
    origin: Float[np.ndarray, "3"],
    returns: int,
    bore: Bore,
    seen: SeenTrack,
    progress: Stages,
) -> SeenTrack:
    """Measures the gauge of each track anew by the recording's own returns; what they do not show sharply stays.

    Args:
        recording: Recording that the bore was built from.
        trajectory: Poses of its LiDAR.
        origin: Origin of the tunnel frame in that of the poses, m.
        returns: Number of returns in the recording, about.
        bore: The bore, in the tunnel frame.
        seen: Tracks that the thinned cloud shows.
        progress: Shows how far the reading is.
    """
    if all(line.rails is None for line in seen.lines):
        return seen
    every = max(int(returns / bore.length / _A_METRE), 1)
    stage = progress.start("measuring the gauge", recording.scan_count)
    found: list[np.ndarray] = []
    batch: list[np.ndarray] = []
    for number, scan in enumerate(recording.scans()):
        stage.advance()
        end = scan.stamp + float(scan.times.max(initial=0.0))
        if number % every or not trajectory.covers(scan.stamp, end):
            continue
        reach = np.linalg.norm(scan.points, axis=1)
        points = deskew(scan, trajectory)
        low = trajectory.at(np.array([scan.stamp, end]))[0][:, 2].mean() - _BELOW
        batch.append(points[(reach > _RANGE[0]) & (reach < _RANGE[1]) & (points[:, 2] < low)] - origin)
        if len(batch) == _BATCH:
            found.append(_beside_rails(np.concatenate(batch), bore, seen.lines))
            batch = []
    if batch:
        found.append(_beside_rails(np.concatenate(batch), bore, seen.lines))
    near = np.concatenate([np.empty((0, 4)), *found])
    lines = (SeenLine(one.sleepers, measure_again(one.rails, *near.T), one.bed) if one.rails else one
             for one in seen.lines)  # fmt: skip
    return replace(seen, lines=tuple(lines))


def _beside_rails(
    points: Float[np.ndarray, "n 3"], bore: Bore, lines: tuple[SeenLine, ...]
) -> Float[np.ndarray, "k 4"]:
    """Return station, offset, height above the floor and above the axis of the points near any rail, m."""
    station, lateral, upward, height = above_floor(points[np.isfinite(points).all(axis=1)], bore)
    near = np.zeros(len(station), bool)
    for rails in (line.rails for line in lines if line.rails is not None):
        near |= np.abs(np.abs(lateral - rails.offset_at(station)) - rails.apart / 2) < _BESIDE
    near &= np.abs(height) < _TALLEST
    return np.column_stack([station, lateral, height, upward])[near]
