"""Any input to a bore: the stages from recording, cloud file or ring survey, with what each of them found."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress

from scene.axis import Axis
from scene.bore import Bore
from scene.cloud import Cloud
from scene.errors import FitError, RecordingError
from scene.files import require_input
from scene.fitting import assemble, lining, rings
from scene.fitting.centreline import CentrelineConfig, fit_centreline
from scene.fitting.section import fit_sections
from scene.fitting.trackseen import SeenTrack, find_track
from scene.poses import locate
from scene.poses.calibration import UNCALIBRATED, Calibration
from scene.poses.control import Control, load_control
from scene.poses.locate import Located
from scene.poses.registration import register
from scene.poses.trajectory import Trajectory, load_tum
from scene.reading.cloudfile import read_cloud
from scene.reading.config import ReadingConfig
from scene.reading.detect import CLOUDS, RECORDINGS, detect, sentence
from scene.reading.recording import Recording
from scene.reading.ringsurvey import read_survey


@dataclass(frozen=True)
class ReconstructConfig:
    """How an input becomes a bore.

    Attributes:
        voxel: Thinning of the cloud, m.
        reading: What is said about the input instead of detected.
        centreline: How the axis is found.
    """

    voxel: float = 0.04
    reading: ReadingConfig = field(default_factory=ReadingConfig)
    centreline: CentrelineConfig = field(default_factory=CentrelineConfig)


@dataclass(frozen=True)
class Reconstruction:
    """A bore and what there is to say about it.

    Attributes:
        bore: In the tunnel frame.
        origin: Of the tunnel frame in the input's frame, whole metres, `(3,)`.
        inputs: Files read.
        facts: For the manifest.
        provenance: Of lining features, for the manifest.
        odometry: The estimated poses, where there was no trajectory to be given.
        cloud: The registered cloud, where there was one.
        seen: What of a track it shows.
    """

    bore: Bore
    origin: np.ndarray
    inputs: list[Path]
    facts: dict[str, Any]
    provenance: dict[str, str]
    odometry: Trajectory | None = None
    cloud: Cloud | None = None
    seen: SeenTrack = field(default_factory=lambda: SeenTrack(None, None))


def reconstruct(
    source: Path,
    trajectory: Path | None,
    config: ReconstructConfig,
    progress: Progress,
    control: Path | None = None,
    calibration: Calibration = UNCALIBRATED,
) -> Reconstruction:
    """Detects what the input is and builds its bore.

    Args:
        source: A recording, a registered cloud or a ring survey, of any format that `scene.reading.detect` knows.
        trajectory: Poses in TUM form, for a recording.
        config: See `ReconstructConfig`.
        progress: Where the stages show how far they are.
        control: Positions in TUM form, for a recording without a trajectory.
        calibration: Where prism and IMU sit against the LiDAR.

    Raises:
        RecordingError: Unreadable, or of no known kind.
        FitError: No tunnel in it.
    """
    require_input(source)
    found = detect(source, config.reading.format)
    if trajectory is not None and found.format not in RECORDINGS:
        raise RecordingError(f"{trajectory}: a trajectory goes with a bag, but {source} is none")
    if control is not None and found.format not in RECORDINGS:
        raise RecordingError(f"{control}: control goes with a bag, but {source} is none")
    if control is not None and trajectory is not None:
        raise RecordingError(f"{control}: control is for a recording without a trajectory, but {trajectory} is given")
    try:
        if found.format in RECORDINGS:
            poses = load_tum(trajectory) if trajectory else None
            seen = load_control(control) if control else None
            return _from_bag(found.path, poses or seen, calibration, config, progress)
        if found.format in CLOUDS:
            cloud, facts = read_cloud(found.path, config.voxel, config.reading)
            print(f"detected: {sentence(facts)}", flush=True)
            return _from_cloud(cloud, [found.path], facts, config, None)
        return _from_rings(found.path, config)
    except FitError as error:
        raise FitError(str(error) if str(source) in str(error) else f"{source}: {error}") from error


def _from_bag(
    path: Path,
    known: Trajectory | Control | None,
    calibration: Calibration,
    config: ReconstructConfig,
    progress: Progress,
) -> Reconstruction:
    with Recording(path, config.reading.topic, config.reading.format) as recording:
        print(f"detected: {sentence(recording.peek())}", flush=True)
        if isinstance(known, Trajectory):
            located = locate.given(known)
        elif isinstance(known, Control):
            located = locate.by_control(recording, known, calibration, progress)
        else:
            located = locate.by_odometry(recording, calibration, progress)
        task = progress.add_task("registering scans", total=recording.scan_count)
        cloud, uncovered = register(
            recording, located.trajectory, config.voxel, lambda: progress.advance(task), located.most_uncovered
        )
        facts = {
            **recording.facts,
            "scans": recording.scan_count,
            "scans_without_pose": uncovered,
            **located.facts,
        }
    inputs = [path] if known is None else [path, known.path]
    return _from_cloud(cloud, inputs, facts, config, located)


def _from_cloud(
    cloud: Cloud, inputs: list[Path], facts: dict[str, Any], config: ReconstructConfig, located: Located | None
) -> Reconstruction:
    axis = fit_centreline(cloud.points, config.centreline)
    if located is not None and _runs_against(axis, located.trajectory.positions - cloud.origin):
        axis = axis.reversed()
    sections = fit_sections(cloud, axis)
    smooth = assemble.from_sections(axis, sections)
    bore, provenance = lining.add_features(smooth, sections)
    seen = find_track(cloud, bore) if sections.flat_floor else SeenTrack(None, None)
    facts = {
        "length_fixed_by": "registered cloud as given",
        **facts,
        "returns": cloud.returns,
        "points": len(cloud.points),
        "flat_floor": sections.flat_floor,
        "residual_rms": float(np.sqrt(np.mean(bore.residual_rms**2))),
        "coverage": float(bore.coverage.mean()),
    }
    odometry = located.trajectory if located is not None and located.estimated else None
    return Reconstruction(bore, cloud.origin, inputs, facts, provenance, odometry, cloud, seen)


def _from_rings(path: Path, config: ReconstructConfig) -> Reconstruction:
    survey = read_survey(path, config.reading.unit)
    print(f"detected: {sentence({'kind': 'ring survey', **survey.facts})}", flush=True)
    fit = rings.fit_rings(survey)
    origin = np.floor(np.median(fit.centre, axis=0))
    bore = rings.bore_from_rings(fit, origin)
    facts = {
        "kind": "ring survey",
        **survey.facts,
        "rings": len(fit.names),
        "first_ring": fit.names[0],
        "last_ring": fit.names[-1],
        "length_fixed_by": "total-station survey",
        "radius_mean": float(fit.radius.mean()),
        "radius_sd": float(fit.radius.std()),
        "residual_rms": float(np.sqrt(np.mean(fit.rms**2))),
        "largest_target_offset": float(max(offset.max() for offset in survey.offsets)),
        "flat_floor": False,
        **({} if survey.design is None else rings.against_design(fit, survey.design)),
    }
    return Reconstruction(bore, origin, [path], facts, {"rings": "measured", "pockets": "none"})


def _runs_against(axis: Axis, positions: np.ndarray) -> bool:
    """Whether the sensor moved mostly towards smaller stations."""
    return bool(axis.local(positions[[0, -1]])[0] @ [-1.0, 1.0] < 0)
