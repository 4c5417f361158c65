"""Any input to a bore: the stages from recording, cloud file or ring survey, with what each of them found."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress

from scene import bore as bores
from scene import lining, rings
from scene.axis import Axis
from scene.bore import Bore
from scene.centreline import CentrelineConfig, fit_centreline
from scene.cloud import Cloud
from scene.cloudfile import SUFFIXES, read_cloud
from scene.errors import FitError, RecordingError
from scene.files import require_input
from scene.odometry import LIBRARY, estimate_trajectory
from scene.recording import Recording
from scene.registration import register
from scene.section import fit_sections
from scene.trajectory import Trajectory, load_tum


@dataclass(frozen=True)
class ReconstructConfig:
    """How an input becomes a bore.

    Attributes:
        voxel: Thinning of the cloud, m.
        topic: LiDAR topic of a bag; found by its type when not given.
        centreline: How the axis is found.
    """

    voxel: float = 0.04
    topic: str | None = None
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
    """

    bore: Bore
    origin: np.ndarray
    inputs: list[Path]
    facts: dict[str, Any]
    provenance: dict[str, str]
    odometry: Trajectory | None = None
    cloud: Cloud | None = None


def reconstruct(source: Path, trajectory: Path | None, config: ReconstructConfig, progress: Progress) -> Reconstruction:
    """Detects what the input is and builds its bore.

    Args:
        source: A `.bag`, a `.ply` or `.pcd` cloud, a ring survey's `.csv`, or a folder with one.
        trajectory: Poses in TUM form, for a bag.
        config: See `ReconstructConfig`.
        progress: Where the stages show how far they are.

    Raises:
        RecordingError: Unreadable, or of no known kind.
        FitError: No tunnel in it.
    """
    require_input(source)
    suffix = source.suffix.lower()
    if trajectory is not None and suffix != ".bag":
        raise RecordingError(f"{trajectory}: a trajectory goes with a bag, but {source} is none")
    try:
        if source.is_dir() or suffix == ".csv":
            return _from_rings(source if suffix == ".csv" else rings.find_survey(source))
        if suffix in SUFFIXES:
            return _from_cloud(read_cloud(source, config.voxel), [source], {"kind": "registered cloud"}, config, None)
        if suffix == ".bag":
            return _from_bag(source, trajectory, config, progress)
    except FitError as error:
        raise FitError(str(error) if str(source) in str(error) else f"{source}: {error}") from error
    raise RecordingError(
        f"{source}: of no known kind; a .bag, a .ply or .pcd cloud, or a folder with a ring survey's CSV is needed"
    )


def _from_bag(
    path: Path, trajectory_path: Path | None, config: ReconstructConfig, progress: Progress
) -> Reconstruction:
    given = load_tum(trajectory_path) if trajectory_path else None
    with Recording(path, config.topic) as recording:
        trajectory = given or _odometry(recording, progress)
        task = progress.add_task("registering scans", total=recording.scan_count)
        cloud, uncovered = register(recording, trajectory, config.voxel, lambda: progress.advance(task))
        facts = {
            "kind": "ROS1 bag",
            "topic": recording.topic,
            "scans": recording.scan_count,
            "scans_without_pose": uncovered,
            "poses": "given trajectory" if given else LIBRARY,
            "length_fixed_by": "given trajectory"
            if given
            else f"odometry ({LIBRARY}); nothing measured the axial scale",
        }
    return _from_cloud(cloud, [path, *([trajectory_path] if trajectory_path else [])], facts, config, trajectory)


def _odometry(recording: Recording, progress: Progress) -> Trajectory:
    task = progress.add_task("LiDAR odometry", total=recording.scan_count)
    return estimate_trajectory(recording, lambda: progress.advance(task))


def _from_cloud(
    cloud: Cloud, inputs: list[Path], facts: dict[str, Any], config: ReconstructConfig, trajectory: Trajectory | None
) -> Reconstruction:
    axis = fit_centreline(cloud.points, config.centreline)
    if trajectory is not None and _runs_against(axis, trajectory.positions - cloud.origin):
        axis = axis.reversed()
    sections = fit_sections(cloud, axis)
    smooth = bores.from_sections(axis, sections)
    bore, provenance = lining.add_features(smooth, sections)
    facts = {
        "length_fixed_by": "registered cloud as given",
        **facts,
        "returns": cloud.returns,
        "points": len(cloud.points),
        "flat_floor": sections.flat_floor,
        "residual_rms": float(np.sqrt(np.mean(bore.residual_rms**2))),
        "coverage": float(bore.coverage.mean()),
    }
    odometry = trajectory if trajectory is not None and trajectory.source == LIBRARY else None
    return Reconstruction(bore, cloud.origin, inputs, facts, provenance, odometry, cloud)


def _from_rings(path: Path) -> Reconstruction:
    survey = rings.read_survey(path)
    fit = rings.fit_rings(survey)
    origin = np.floor(np.median(fit.centre, axis=0))
    bore = rings.bore_from_rings(fit, origin)
    facts = {
        "kind": "ring survey",
        "rings": len(fit.names),
        "first_ring": fit.names[0],
        "last_ring": fit.names[-1],
        "length_fixed_by": "total-station survey",
        "radius_mean": float(fit.radius.mean()),
        "radius_sd": float(fit.radius.std()),
        "residual_rms": float(np.sqrt(np.mean(fit.rms**2))),
        "flat_floor": False,
    }
    return Reconstruction(bore, origin, [path], facts, {"rings": "measured", "pockets": "none"})


def _runs_against(axis: Axis, positions: np.ndarray) -> bool:
    """Whether the sensor moved mostly towards smaller stations."""
    return bool(axis.local(positions[[0, -1]])[0] @ [-1.0, 1.0] < 0)
