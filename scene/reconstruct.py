"""From any input to a bore: recording, cloud file or ring survey."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from scene.bore import Axis, Bore
from scene.cleaning.clean import CleaningConfig, clean_cloud
from scene.cleaning.crop import ExtentConfig, crop_cloud, describe_chainage, keep_stations, turn_round
from scene.cleaning.removed import Removed
from scene.cloud import Cloud
from scene.errors import FitError, RecordingError, require_input
from scene.fitting.assemble import bore_from_sections, describe_bore, find_fold
from scene.fitting.centreline import CentrelineConfig, smooth_axis
from scene.fitting.gauge import look_again
from scene.fitting.lining import LiningConfig, add_lining, add_standard_lining
from scene.fitting.rings import bore_from_rings, compare_with_design, fit_rings
from scene.fitting.section import Sections, fit_sections
from scene.fitting.trackseen import SeenTrack, find_track
from scene.fitting.universal import joints_by_number
from scene.poses.calibration import UNCALIBRATED, Calibration
from scene.poses.consistency import check_poses, reorder
from scene.poses.locate import Located, locate_by_control, locate_by_odometry, locate_given
from scene.poses.registration import register_scans
from scene.poses.trajectory import Control, Trajectory, load_control, load_tum
from scene.progress import Stages
from scene.reading.cloudfile import read_cloud
from scene.reading.formats import ReadingConfig, describe, detect, own_readers
from scene.reading.recording import Recording
from scene.reading.ringsurvey import read_ring_survey
from scene.reading.tables import parse_columns
from scene.resume import Partial, input_record, resume_key, total_bytes


@dataclass(frozen=True)
class Registered:
    """A registered cloud and its origin."""

    cloud: Cloud  # Thinned cloud
    record: list[dict[str, Any]]  # Name, size and hash of each input
    facts: dict[str, Any]  # Facts for the manifest
    located: Located | None = None  # Poses of the LiDAR, for a recording


def hash_inputs(paths: list[Path], progress: Stages) -> list[dict[str, Any]]:
    """Return name, size and hash of each input, read once from end to end."""
    return input_record(paths, progress.start("hashing the input, bytes", total_bytes(paths)).advance)


def register_recording(
    path: Path,
    known: Trajectory | Control | None,
    calibration: Calibration,
    voxel: float,
    reading: ReadingConfig,
    progress: Stages,
    partial: Partial,
) -> Registered:
    """Finds the poses where they are not known, and places every return in a cloud thinned to `voxel`, m.

    `calibration` holds the mounts of prism and IMU against the LiDAR. Raises `RecordingError` for a damaged recording,
    or poses of another one, and `FitError` where the poses cannot be found, or no return is left.
    """
    with Recording(path, reading.topic, reading.format) as recording:
        print(f"detected: {describe(recording.peek())}", flush=True)
        record = hash_inputs([path] if known is None else [path, known.path], progress)
        partial.open(resume_key(record, voxel, reading, calibration, type(known).__name__, own_readers()))
        if isinstance(known, Trajectory):
            located = _locate_checked(recording, known, reading)
        elif isinstance(known, Control):
            located = _checked(recording, locate_by_control(recording, known, calibration, progress, partial))
        else:
            located = locate_by_odometry(recording, calibration, progress, partial)
        stage = progress.start("registering scans", recording.scan_count)
        cloud, uncovered = register_scans(recording, located.trajectory, voxel, stage, located.most_uncovered, partial)
        facts = {
            **recording.facts,
            "scans": recording.scan_count,
            "scans_without_pose": uncovered,
            **located.facts,
        }
    return Registered(cloud, record, facts, located)


def _locate_checked(recording: Recording, given: Trajectory, reading: ReadingConfig) -> Located:
    """Takes given poses after a look at what they make of some scans, with quaternions in the order that fits."""
    told = reading.quaternion
    poses = reorder(given) if told == "wxyz" else given
    check = check_poses(recording, poses)
    order = "xyzw (by default)" if told is None else f"{told} (by flag)"
    if check is not None and check.wxyz and told is None:
        poses, order = reorder(given), "wxyz (detected: as xyzw they blur the walls)"
        print(f"quaternions of {given.source}: {order}", flush=True)
        check = check_poses(recording, poses)
    located = locate_given(poses)
    facts = {**located.facts, "quaternions": order, **({} if check is None else check.facts)}
    return replace(located, facts=facts)


def _checked(recording: Recording, located: Located) -> Located:
    """Return poses with what they make of the walls among their facts: rails hide where they blur them."""
    check = check_poses(recording, located.trajectory)
    return located if check is None else replace(located, facts={**located.facts, **check.facts})


def load_cloud(path: Path, voxel: float, reading: ReadingConfig, progress: Stages, partial: Partial) -> Registered:
    """Reads and thins a cloud that is registered already; see `register_recording`.

    Raises `RecordingError` for a file that is damaged, empty, or of no usable unit.
    """
    record = hash_inputs([path], progress)
    partial.open(resume_key(record, voxel, reading, own_readers()))
    cloud, facts = read_cloud(path, voxel, reading, progress.start("reading points", None), partial)
    print(f"detected: {describe(facts)}", flush=True)
    return Registered(cloud, record, facts)


@dataclass(frozen=True)
class ReconstructConfig:
    """Settings of the steps from an input to a bore."""

    voxel: float = 0.04  # Thinning of the cloud, m.
    reading: ReadingConfig = field(default_factory=ReadingConfig)  # What the user says instead of having it detected.
    extent: ExtentConfig = field(default_factory=ExtentConfig)  # Part that is built, and how its stations count.
    cleaning: CleaningConfig = field(default_factory=CleaningConfig)  # Search for what is not the bore.
    centreline: CentrelineConfig = field(default_factory=CentrelineConfig)  # Search for the axis.
    lining: LiningConfig = field(default_factory=LiningConfig)  # Lining by standard, where the survey can show none.


@dataclass(frozen=True)
class Reconstruction:
    """A bore, and all that the manifest says about it."""

    bore: Bore  # Bore in the tunnel frame
    origin: np.ndarray  # Origin of the tunnel frame in the input's, whole metres
    inputs: list[dict[str, Any]]  # Name, size and hash of each
    facts: dict[str, Any]  # Facts for the manifest
    provenance: dict[str, str]  # Provenance of lining features, for the manifest
    odometry: Trajectory | None = None  # The estimated poses, where there was no trajectory to be given
    cloud: Cloud | None = None  # The bore's part of the registered cloud, where there was one
    everything: Cloud | None = None  # The registered cloud before cleaning
    removed: tuple[Removed, ...] = ()  # What cleaning cut away, by station of the bore, m
    cause: np.ndarray | None = None  # Index into `scene.cleaning.removed.CAUSES` of each point of `everything`, `(n,)`
    seen: SeenTrack = field(default_factory=SeenTrack)  # Tracks that the cloud shows


def reconstruct(
    source: Path,
    trajectory: Path | None,
    config: ReconstructConfig,
    progress: Stages,
    control: Path | None = None,
    calibration: Calibration = UNCALIBRATED,
    partial: Partial | None = None,
) -> Reconstruction:
    """Detects the kind of an input and builds its bore.

    Args:
        source: A recording, a registered cloud or a ring survey, of any format that `scene.reading.formats` knows.
        trajectory: Poses in TUM form, for a recording.
        config: Settings.
        progress: Shows the stages.
        control: Positions in TUM form, for a recording without a trajectory.
        calibration: Mounts of prism and IMU against the LiDAR.
        partial: Partial results of an earlier build, and place for those of this one; none are kept without it.

    Raises:
        RecordingError: Unreadable, or of no known kind.
        FitError: No tunnel in it.
    """
    partial = partial or Partial(None)
    require_input(source)
    detected = detect(source, config.reading.format)
    kind = detected.format.kind
    if trajectory is not None and kind != "recording":
        raise RecordingError(f"{trajectory}: a trajectory goes with a bag, but {source} is none")
    if control is not None and kind != "recording":
        raise RecordingError(f"{control}: control goes with a bag, but {source} is none")
    if control is not None and trajectory is not None:
        raise RecordingError(f"{control}: control is for a recording without a trajectory, but {trajectory} is given")
    try:
        if kind == "recording":
            known = load_tum(trajectory) if trajectory else load_control(control) if control else None
            parts = (config.voxel, config.reading, progress, partial)
            registered = register_recording(detected.path, known, calibration, *parts)
            built = _fit_recording(registered, config, progress)
            return replace(built, seen=_look_again(detected.path, registered, built, config.reading, progress))
        if kind == "cloud":
            cloud = load_cloud(detected.path, config.voxel, config.reading, progress, partial)
            return _fit_cloud(cloud, config, progress)
        return _fit_ring_survey(detected.path, config, progress)
    except FitError as error:
        raise FitError(str(error) if str(source) in str(error) else f"{source}: {error}") from error


def _fit_recording(registered: Registered, config: ReconstructConfig, progress: Stages) -> Reconstruction:
    """Fits a recording's cloud; where none can be fitted and the poses are in doubt, the error says so first."""
    try:
        return _fit_cloud(registered, config, progress)
    except FitError as error:
        doubt = registered.facts.get("pose_doubt")
        raise FitError(f"{doubt}; no bore can be fitted to them ({error})" if doubt else str(error)) from error


def _look_again(
    path: Path, registered: Registered, built: Reconstruction, reading: ReadingConfig, progress: Stages
) -> SeenTrack:
    """Return the tracks with the gauge that the recording's single returns show."""
    if registered.located is None or all(line.rails is None for line in built.seen.lines):
        return built.seen
    with Recording(path, reading.topic, reading.format) as recording:
        poses, returns = registered.located.trajectory, registered.cloud.returns
        return look_again(recording, poses, built.origin, returns, built.bore, built.seen, progress)


_ARBITRARY = "arbitrarily: a registered cloud tells no direction, and --reverse turns it"


def _fit_cloud(registered: Registered, config: ReconstructConfig, progress: Stages) -> Reconstruction:
    located = registered.located
    stage = progress.start("fitting the bore", 4)
    everything = crop_cloud(registered.cloud, config.extent.crop)
    cleaned = clean_cloud(everything, config.cleaning, config.centreline)
    backwards = False
    if located is not None:
        ends = cleaned.axis.local(located.trajectory.positions[[0, -1]] - everything.origin)[0]
        backwards = bool(ends[1] < ends[0])  # stations grow the way the sensor went
    if backwards != config.extent.reverse:
        cleaned = turn_round(cleaned)
    cleaned, everything, first = keep_stations(cleaned, everything, config.extent)
    cloud, axis, removed = cleaned.cloud, cleaned.axis, cleaned.removed
    stage.advance()
    axis, sections, smooth = _fit_unfolded(cloud, axis, config.centreline.cutoff)
    stage.advance()
    removed = tuple(part.shifted(-sections.grid.start) for part in removed)
    bore, provenance = add_lining(smooth, sections, cloud, config.lining)
    stage.advance()
    seen = find_track(cloud, bore, sections.flat_floor)
    stage.advance()
    facts = {
        "length_fixed_by": "registered cloud as given",
        **registered.facts,
        **describe_chainage(config.extent, first, _ARBITRARY if located is None else "with the trajectory"),
        "returns": cloud.returns,
        "points": len(cloud.points),
        "flat_floor": sections.flat_floor,
        "profile_spacing": sections.spacing or None,
        **describe_bore(bore),
    }
    odometry = located.trajectory if located is not None and located.estimated else None
    return Reconstruction(
        bore, cloud.origin, registered.record, facts, provenance, odometry, cloud,
        everything, removed, cleaned.cause, seen,
    )  # fmt: skip


_STRAIGHTER = 3  # times that an axis is smoothed over twice the length


def _fit_unfolded(cloud: Cloud, axis: Axis, cutoff: float) -> tuple[Axis, Sections, Bore]:
    """Fits sections to an axis, which is smoothed further where they fold: at a jump of the wall it may bend sharply.

    `cutoff` is the wavelength that the axis is smooth over, m.
    """
    sections = fit_sections(cloud, axis)
    bore = bore_from_sections(axis, sections)
    for power in range(1, _STRAIGHTER + 1):
        if find_fold(bore) is None:
            break
        axis = smooth_axis(axis.position, cutoff * 2**power)
        sections = fit_sections(cloud, axis)
        bore = bore_from_sections(axis, sections)
    return axis, sections, bore


def _fit_ring_survey(path: Path, config: ReconstructConfig, progress: Stages) -> Reconstruction:
    survey = read_ring_survey(path, config.reading.unit, _ring_columns(path, config.reading.columns))
    if config.extent.reverse:
        survey = survey.reversed()
    print(f"detected: {describe({'kind': 'ring survey', **survey.facts})}", flush=True)
    fit = fit_rings(survey)
    origin = np.floor(np.median(fit.centre, axis=0))
    smooth = bore_from_rings(fit, origin)
    joints = joints_by_number(fit.names, smooth.ring_station)
    bore, provenance = add_standard_lining(smooth, config.lining, flat_floor=False, joints=joints)
    facts = {
        "kind": "ring survey",
        **survey.facts,
        "rings": len(fit.names),
        "first_ring": fit.names[0],
        "last_ring": fit.names[-1],
        "length_fixed_by": "total-station survey",
        "radius_mean": float(fit.radius.mean()),
        "radius_sd": float(fit.radius.std()),
        **describe_bore(bore),
        "residual_rms": float(np.sqrt(np.mean(fit.rms**2))),
        **describe_chainage(config.extent, 0.0, "with the order of the rings in the file"),
        "largest_target_offset": float(max(offset.max() for offset in survey.offsets)),
        "flat_floor": False,
        **({} if survey.design is None else compare_with_design(fit, survey.design)),
    }
    return Reconstruction(bore, origin, hash_inputs([path], progress), facts, provenance)


def _ring_columns(path: Path, columns: str | None) -> dict[str, str] | None:
    """Return the columns that a user names; raises `RecordingError` where they are none."""
    try:
        return parse_columns(columns) or None
    except ValueError as error:
        raise RecordingError(f"{path}: {error}") from error
