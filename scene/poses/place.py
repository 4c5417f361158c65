"""Every return of an input in one frame, thinned: the scans of a recording by their poses, or a cloud as it is."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from scene.cloud import Cloud
from scene.poses.calibration import Calibration
from scene.poses.clocks import settle_poses
from scene.poses.consistency import check_poses, reorder
from scene.poses.locate import Located, locate_by_control, locate_by_odometry, locate_given
from scene.poses.registration import register_scans
from scene.poses.trajectory import Trajectory, load_control, load_tum
from scene.progress import Stages
from scene.reading.cloudfile import read_cloud
from scene.reading.formats import ReadingConfig, describe, own_readers
from scene.reading.recording import Recording
from scene.resume import Partial, hash_inputs, resume_key


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
    partial: Partial,
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
        way = type(given if given is not None else prism).__name__
        partial.open(resume_key(record, voxel, reading, calibration, way, own_readers()))
        auto = reading.clock == "auto"
        if given is not None:
            located = _check_given(recording, given, reading)
        elif prism is not None:
            located = _check(recording, locate_by_control(recording, prism, calibration, progress, partial, auto))
        else:
            located = locate_by_odometry(recording, calibration, progress, partial, auto)
        stage = progress.start("registering scans", recording.scan_count)
        registered = register_scans(recording, located.trajectory, voxel, stage, located.most_uncovered, partial)
        facts = {
            **recording.facts,
            "scans": recording.scan_count,
            "scans_without_pose": registered.uncovered,
            **located.facts,
        }
    return Placed(registered.cloud, record, facts, located, registered.low)


def _check_given(recording: Recording, given: Trajectory, reading: ReadingConfig) -> Located:
    """Takes given poses after a look at what they make of some scans: their clock first, then their quaternions.

    What blurs the walls for another reason is looked for with the clock set right.
    """
    told, auto = reading.quaternion, reading.clock == "auto"
    poses = reorder(given) if told == "wxyz" else given
    clock, timed = settle_poses(recording, poses, auto)
    check = check_poses(recording, timed, told is None)
    order = "xyzw (by default)" if told is None else f"{told} (by flag)"
    if check is not None and check.wxyz:
        poses, order = reorder(given), "wxyz (detected: as xyzw they blur the walls)"
        print(f"quaternions of {given.source}: {order}", flush=True)
        clock, timed = settle_poses(recording, poses, auto)
        check = check_poses(recording, timed, False)
    located = locate_given(timed if clock.corrected else poses)
    facts = {**located.facts, "quaternions": order, **clock.facts, **({} if check is None else check.facts)}
    return replace(located, facts=facts)


def _check(recording: Recording, located: Located) -> Located:
    """Return poses with what they make of the walls among their facts: rails hide where they blur them."""
    check = check_poses(recording, located.trajectory)
    return located if check is None else replace(located, facts={**located.facts, **check.facts})


def place_cloud(path: Path, voxel: float, reading: ReadingConfig, progress: Stages, partial: Partial) -> Placed:
    """Reads and thins a cloud that is registered already; see `place_recording`.

    Raises `RecordingError` for a file that is damaged, empty, or of no usable unit.
    """
    record = hash_inputs([path], progress)
    partial.open(resume_key(record, voxel, reading, own_readers()))
    cloud, facts = read_cloud(path, voxel, reading, progress.start("reading points", None), partial)
    print(f"detected: {describe(facts)}", flush=True)
    return Placed(cloud, record, facts)
