"""The first half of a build: a recording with what is known of its poses, or a cloud file, to one registered cloud."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scene.cli import Stages
from scene.cloud import Cloud
from scene.inputs import input_record, key_of, size_of
from scene.poses import controlled, locate
from scene.poses.calibration import Calibration
from scene.poses.control import Control
from scene.poses.located import Located
from scene.poses.registration import register
from scene.poses.trajectory import Trajectory
from scene.reading.cloudfile import read_cloud
from scene.reading.config import ReadingConfig
from scene.reading.detect import sentence
from scene.reading.recording import Recording
from scene.resume import Partial


@dataclass(frozen=True)
class Registered:
    """A cloud and where it comes from.

    Attributes:
        cloud: Thinned.
        record: Name, size and hash of each input.
        facts: For the manifest.
        located: Where the LiDAR was, for a recording.
    """

    cloud: Cloud
    record: list[dict[str, Any]]
    facts: dict[str, Any]
    located: Located | None = None


def hashed(paths: list[Path], progress: Stages) -> list[dict[str, Any]]:
    """Name, size and hash of each input, read once from end to end."""
    return input_record(paths, progress.start("hashing the input, bytes", size_of(paths)).advance)


def from_recording(
    path: Path,
    known: Trajectory | Control | None,
    calibration: Calibration,
    voxel: float,
    reading: ReadingConfig,
    progress: Stages,
    partial: Partial,
) -> Registered:
    """Finds the poses where they are not given, and places every return.

    Args:
        path: The recording.
        known: Of its poses.
        calibration: Where prism and IMU sit against the LiDAR.
        voxel: Thinning of the cloud, m.
        reading: What is said about the recording instead of detected.
        progress: Where the stages show how far they are.
        partial: What an earlier build got done, and where this one keeps what it does.

    Raises:
        RecordingError: Damaged, or the poses belong to another recording.
        FitError: The poses cannot be found, or nothing is left.
    """
    with Recording(path, reading.topic, reading.format) as recording:
        print(f"detected: {sentence(recording.peek())}", flush=True)
        record = hashed([path] if known is None else [path, known.path], progress)
        partial.open(key_of(record, voxel, reading, calibration, type(known).__name__))
        if isinstance(known, Trajectory):
            located = locate.given(known)
        elif isinstance(known, Control):
            located = controlled.by_control(recording, known, calibration, progress, partial)
        else:
            located = locate.by_odometry(recording, calibration, progress, partial)
        stage = progress.start("registering scans", recording.scan_count)
        cloud, uncovered = register(recording, located.trajectory, voxel, stage, located.most_uncovered, partial)
        facts = {
            **recording.facts,
            "scans": recording.scan_count,
            "scans_without_pose": uncovered,
            **located.facts,
        }
    return Registered(cloud, record, facts, located)


def from_cloud_file(path: Path, voxel: float, reading: ReadingConfig, progress: Stages, partial: Partial) -> Registered:
    """Reads and thins a cloud that is registered already; arguments as for `from_recording`.

    Raises:
        RecordingError: Damaged, empty, or of no usable unit.
    """
    record = hashed([path], progress)
    partial.open(key_of(record, voxel, reading))
    cloud, facts = read_cloud(path, voxel, reading, progress.start("reading points", None), partial)
    print(f"detected: {sentence(facts)}", flush=True)
    return Registered(cloud, record, facts)
