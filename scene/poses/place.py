"""Every return of an input in one frame, thinned: a cloud as it is, or the scans of a recording by their poses."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from scene.cloud import Cloud, VoxelMean
from scene.errors import FitError, RecordingError, Refusal
from scene.inputs import hash_inputs
from scene.poses.calibration import Calibration
from scene.poses.locate import Located, check_located, locate_by_control, locate_by_odometry, locate_given
from scene.poses.trajectory import Trajectory, deskew, load_control, load_tum
from scene.progress import Stage, Stages
from scene.reading.cloudfile import read_cloud
from scene.reading.formats import ReadingConfig, describe, left_out
from scene.reading.recording import Recording
from scene.reading.times import Scan

_BATCH = 20  # sweeps thinned together


@dataclass(frozen=True)
class Placed:
    """A registered cloud and its origin."""

    cloud: Cloud  # Thinned cloud
    record: list[dict[str, Any]]  # Name, size and hash of each input
    facts: dict[str, Any]  # Facts for the manifest
    located: Located | None = None  # Poses of the LiDAR, for a recording
    # Single returns below the LiDAR, in the frame of `cloud`, m
    low: Float[np.ndarray, "k 3"] = field(default_factory=lambda: np.empty((0, 3), np.float32))


def place_recording(
    path: Path,
    trajectory: Path | None,
    control: Path | None,
    calibration: Calibration,
    voxel: float,
    reading: ReadingConfig,
    progress: Stages,
    more: tuple[Path, ...] = (),
) -> Placed:
    """Finds the poses where they are not given, and places every return in a cloud thinned to `voxel`, m.

    `calibration` holds the mounts of prism and IMU against the LiDAR, and `more` is further bags of the recording.
    Raises `RecordingError` for a damaged recording, or poses of another one, and `FitError` where the poses cannot be
    found, or no return is left.
    """
    given = load_tum(trajectory) if trajectory else None
    prism = load_control(control) if control else None
    beside = [known.path for known in (given, prism) if known is not None]
    with Recording(path, reading.topic, reading.format, reading.times, more) as recording:
        print(f"detected: {describe(recording.peek())}", flush=True)
        record = hash_inputs([path, *more, *beside], progress)
        auto = reading.clock == "auto"
        if given is not None:
            located = locate_given(recording, given, reading)
        elif prism is not None:
            located = check_located(recording, locate_by_control(recording, prism, calibration, progress, auto))
        else:
            located = locate_by_odometry(recording, calibration, progress, auto)
        stage = progress.start("registering scans", recording.scan_count)
        registered = register_scans(recording, located.trajectory, voxel, stage, located.most_uncovered)
        facts = {
            **recording.facts,
            "scans": recording.scan_count,
            "scans_without_pose": registered.uncovered,
            **located.facts,
        }
        if dropped := left_out(facts):
            print(f"left out: {dropped}", flush=True)
    return Placed(registered.cloud, record, facts, located, registered.low)


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


def place_cloud(path: Path, voxel: float, reading: ReadingConfig, progress: Stages) -> Placed:
    """Reads and thins a cloud that is registered already; see `place_recording`.

    Raises `RecordingError` for a file that is damaged, empty, or of no usable unit.
    """
    record = hash_inputs([path], progress)
    cloud, facts = read_cloud(path, voxel, reading, progress.start("reading points", None))
    print(f"detected: {describe(facts)}", flush=True)
    return Placed(cloud, record, facts)
