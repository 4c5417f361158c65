"""Any input to a bore: the stages from recording, cloud file or ring survey, with what each of them found."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from scene.axis import Axis
from scene.bore import Bore
from scene.cli import Stages
from scene.cloud import Cloud
from scene.errors import FitError, RecordingError
from scene.files import require_input
from scene.fitting import assemble, lining, rings
from scene.fitting.centreline import CentrelineConfig, fit_centreline
from scene.fitting.facts import facts as bore_facts
from scene.fitting.lining import LiningConfig
from scene.fitting.section import fit_sections
from scene.fitting.trackseen import SeenTrack, find_track
from scene.poses.calibration import UNCALIBRATED, Calibration
from scene.poses.control import load_control
from scene.poses.trajectory import Trajectory, load_tum
from scene.reading.config import ReadingConfig
from scene.reading.detect import CLOUDS, RECORDINGS, detect, sentence
from scene.reading.ringsurvey import read_survey
from scene.registered import Registered, from_cloud_file, from_recording, hashed
from scene.resume import Partial


@dataclass(frozen=True)
class ReconstructConfig:
    """How an input becomes a bore.

    Attributes:
        voxel: Thinning of the cloud, m.
        reading: What is said about the input instead of detected.
        centreline: How the axis is found.
        lining: What stands where the survey can show no lining.
    """

    voxel: float = 0.04
    reading: ReadingConfig = field(default_factory=ReadingConfig)
    centreline: CentrelineConfig = field(default_factory=CentrelineConfig)
    lining: LiningConfig = field(default_factory=LiningConfig)


@dataclass(frozen=True)
class Reconstruction:
    """A bore and what there is to say about it.

    Attributes:
        bore: In the tunnel frame.
        origin: Of the tunnel frame in the input's frame, whole metres, `(3,)`.
        inputs: Name, size and hash of each.
        facts: For the manifest.
        provenance: Of lining features, for the manifest.
        odometry: The estimated poses, where there was no trajectory to be given.
        cloud: The registered cloud, where there was one.
        seen: What of a track it shows.
    """

    bore: Bore
    origin: np.ndarray
    inputs: list[dict[str, Any]]
    facts: dict[str, Any]
    provenance: dict[str, str]
    odometry: Trajectory | None = None
    cloud: Cloud | None = None
    seen: SeenTrack = field(default_factory=lambda: SeenTrack(None, None))


def reconstruct(
    source: Path,
    trajectory: Path | None,
    config: ReconstructConfig,
    progress: Stages,
    control: Path | None = None,
    calibration: Calibration = UNCALIBRATED,
    partial: Partial | None = None,
) -> Reconstruction:
    """Detects what the input is and builds its bore.

    Args:
        source: A recording, a registered cloud or a ring survey, of any format that `scene.reading.detect` knows.
        trajectory: Poses in TUM form, for a recording.
        config: See `ReconstructConfig`.
        progress: Where the stages show how far they are.
        control: Positions in TUM form, for a recording without a trajectory.
        calibration: Where prism and IMU sit against the LiDAR.
        partial: What an earlier build got done, and where this one keeps what it does; nothing is kept without it.

    Raises:
        RecordingError: Unreadable, or of no known kind.
        FitError: No tunnel in it.
    """
    partial = partial or Partial(None)
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
            known = load_tum(trajectory) if trajectory else load_control(control) if control else None
            parts = (config.voxel, config.reading, progress, partial)
            return _from_cloud(from_recording(found.path, known, calibration, *parts), config, progress)
        if found.format in CLOUDS:
            cloud = from_cloud_file(found.path, config.voxel, config.reading, progress, partial)
            return _from_cloud(cloud, config, progress)
        return _from_rings(found.path, config, progress)
    except FitError as error:
        raise FitError(str(error) if str(source) in str(error) else f"{source}: {error}") from error


def _from_cloud(registered: Registered, config: ReconstructConfig, progress: Stages) -> Reconstruction:
    cloud, located = registered.cloud, registered.located
    stage = progress.start("fitting the bore", 4)
    axis = fit_centreline(cloud.points, config.centreline, cloud.origin)
    if located is not None and _runs_against(axis, located.trajectory.positions - cloud.origin):
        axis = axis.reversed()
    stage.advance()
    sections = fit_sections(cloud, axis)
    stage.advance()
    smooth = assemble.from_sections(axis, sections)
    bore, provenance = lining.add_features(smooth, sections, cloud, config.lining)
    stage.advance()
    seen = find_track(cloud, bore) if sections.flat_floor else SeenTrack(None, None)
    stage.advance()
    facts = {
        "length_fixed_by": "registered cloud as given",
        **registered.facts,
        "returns": cloud.returns,
        "points": len(cloud.points),
        "flat_floor": sections.flat_floor,
        "profile_spacing": sections.spacing or None,
        **bore_facts(bore),
    }
    odometry = located.trajectory if located is not None and located.estimated else None
    return Reconstruction(bore, cloud.origin, registered.record, facts, provenance, odometry, cloud, seen)


def _from_rings(path: Path, config: ReconstructConfig, progress: Stages) -> Reconstruction:
    survey = read_survey(path, config.reading.unit)
    print(f"detected: {sentence({'kind': 'ring survey', **survey.facts})}", flush=True)
    fit = rings.fit_rings(survey)
    origin = np.floor(np.median(fit.centre, axis=0))
    bore, provenance = lining.standard(rings.bore_from_rings(fit, origin), config.lining, flat_floor=False)
    facts = {
        "kind": "ring survey",
        **survey.facts,
        "rings": len(fit.names),
        "first_ring": fit.names[0],
        "last_ring": fit.names[-1],
        "length_fixed_by": "total-station survey",
        "radius_mean": float(fit.radius.mean()),
        "radius_sd": float(fit.radius.std()),
        **bore_facts(bore),
        "residual_rms": float(np.sqrt(np.mean(fit.rms**2))),
        "largest_target_offset": float(max(offset.max() for offset in survey.offsets)),
        "flat_floor": False,
        **({} if survey.design is None else rings.against_design(fit, survey.design)),
    }
    return Reconstruction(bore, origin, hashed([path], progress), facts, provenance)


def _runs_against(axis: Axis, positions: np.ndarray) -> bool:
    """Whether the sensor moved mostly towards smaller stations."""
    return bool(axis.local(positions[[0, -1]])[0] @ [-1.0, 1.0] < 0)
