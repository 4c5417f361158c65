"""`python -m scene.build INPUT --out DIR`: a recording in; scene, bore, tunnel and manifest out."""

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import mujoco
import numpy as np
import trimesh
import tyro

from scene.cli import progress_bar, run
from scene.cloud import thinned
from scene.errors import FitError
from scene.files import replace_folder, require_output_folder
from scene.poses.calibration import find_calibration
from scene.poses.trajectory import save_tum
from scene.reconstruct import ReconstructConfig, Reconstruction, reconstruct
from scene.writing import manifest, mesh, mjcf, planar
from scene.writing.mjcf import SceneConfig
from scene.writing.track import Track, TrackConfig, lay

_PREVIEW_VOXEL = 0.06


@dataclass(frozen=True)
class BuildConfig:
    """Everything a build depends on beside its input.

    Attributes:
        name: Of the tunnel; the output folder's where not given.
        provenance: What kind of recording this is: say `simulated` for a simulated survey.
        reconstruct: How the input becomes a bore.
        track: How the track is laid.
        scene: How the scene is cut and dressed.
    """

    name: str = ""
    provenance: str = "measured"
    reconstruct: ReconstructConfig = field(default_factory=ReconstructConfig)
    track: TrackConfig = field(default_factory=TrackConfig)
    scene: SceneConfig = field(default_factory=SceneConfig)


def build(
    source: Path,
    out: Path,
    trajectory: Path | None = None,
    config: BuildConfig | None = None,
    control: Path | None = None,
    calibration: str | None = None,
) -> Reconstruction:
    """Reconstructs the tunnel in `source` and writes its scene folder whole, or not at all.

    Args:
        source: The input; see `scene.reconstruct`.
        out: Folder to write; a previous one is replaced once the new one is complete.
        trajectory: Poses for a bag, TUM.
        config: Defaults where not given.
        control: Positions for a bag, TUM.
        calibration: See `scene.calibration.find_calibration`.

    Raises:
        SubterraError: The input is at fault, or the output cannot be written.
    """
    config = config or BuildConfig()
    require_output_folder(out)
    mounts = find_calibration(calibration)
    started = time.monotonic()
    with progress_bar() as progress:
        result = reconstruct(source, trajectory, config.reconstruct, progress, control, mounts)
    _say(started, f"bore: {result.bore.length:.2f} m, {result.facts['kind']}")
    with replace_folder(out) as folder:
        write_scene_folder(folder, config.name or out.name, result, config)
        _say(started, f"scene: written and compiled by MuJoCo {mujoco.__version__}")
    print(f"{out / 'scene.xml'}")
    return result


def write_scene_folder(folder: Path, name: str, result: Reconstruction, config: BuildConfig) -> None:
    """Writes the six parts of a scene folder and compiles the scene once."""
    bore = result.bore
    laid = lay(bore, config.track, result.seen.sleepers)
    smooth, pocketed = mesh.build_solid(bore, pockets=False), mesh.build_solid(bore, pockets=True)
    height = config.scene.lidar_height
    walls = {
        "smooth": planar.cut_walls(smooth, bore, laid.elevation, height),
        "pockets": planar.cut_walls(pocketed, bore, laid.elevation, height),
    }
    walls["furnished"] = walls["pockets"]
    solid = mesh.as_trimesh(pocketed)
    lining = mesh.open_lining(solid, bore)
    count = mjcf.write_scene(folder, name, bore, lining, walls["smooth"], laid, config.scene)
    solid.export(folder / "meshes" / "solid.ply")
    lining.export(folder / "meshes" / "lining.ply")
    bore.save(folder / "bore.npz")
    planar.save(folder / "tunnel.npz", name, config.provenance, bore, laid.elevation, height, walls)
    content = {
        "name": name,
        "inputs": manifest.input_record(result.inputs),
        "input_provenance": config.provenance,
        "frame": {"origin": result.origin, "up": "z", "length_unit": "m"},
        "seeds": {},
        "detected": result.facts,
        "bore": {
            "length": bore.length,
            "width_mean": float(bore.width.mean()),
            "height_mean": float(bore.height.mean()),
            "filled_share": float(bore.filled.mean()),
        },
        "count": {
            **count,
            "stations": len(bore.station),
            "rings": len(bore.ring_station),
            "pockets": len(bore.pocket),
            "lining_faces": len(lining.faces),
        },
        "track": _track_facts(laid, result),
        "provenance": {
            "bore": config.provenance,
            **{
                asset: kind.replace("measured", config.provenance)
                for asset, kind in {**_track_provenance(laid, result), **result.provenance}.items()
            },
        },
    }
    manifest.write(folder / "manifest.json", content, config)
    if result.cloud is not None:
        trimesh.PointCloud(thinned(result.cloud, _PREVIEW_VOXEL)).export(folder / "cloud.ply")
    if result.odometry is not None:
        save_tum(result.odometry, folder / "odometry.tum")
    _compile(folder / "scene.xml")


def _track_facts(laid: Track, result: Reconstruction) -> dict[str, Any]:
    rails = result.seen.rails
    return {
        "least_clearance": float(laid.clearance.min()) if len(laid.clearance) else None,
        "slab": laid.raised,
        "sleepers_seen": int(laid.measured.sum()),
        "protrusion": laid.config.protrusion,
        "gauge": laid.config.gauge,
        "gauge_seen": rails.outer - 2 * laid.config.rail.head_width if rails else None,
        "rail_top_seen": rails.top if rails else None,
    }


def _track_provenance(laid: Track, result: Reconstruction) -> dict[str, str]:
    if not len(laid.sleeper_station):
        return {"track": "none: the bore is too low for it"}
    return {
        "sleepers": "measured" if laid.measured.any() else "by standard",
        "rails": "by standard" + (", seen in the survey" if result.seen.rails else ""),
        "fasteners": "by standard",
    }


def _compile(path: Path) -> None:
    try:
        mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise FitError(f"{path.name}: MuJoCo refuses the scene ({error})") from error


def _say(started: float, text: str) -> None:
    print(f"[{time.monotonic() - started:6.1f} s] {text}", flush=True)


def main(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="input", metavar="INPUT")],
    /,
    out: Path,
    trajectory: Path | None = None,
    control: Path | None = None,
    calibration: str | None = None,
    config: Annotated[BuildConfig, tyro.conf.arg(name="")] = BuildConfig(),
) -> None:
    """Builds a scene from a recording.

    Example: python -m scene.build survey.bag --trajectory groundtruth.tum --out build/tunnel

    Args:
        source: A recording (ROS1 or ROS2 bag, MCAP, folder of timed scans), a registered cloud (PLY, PCD, LAS, LAZ,
            E57, XYZ, CSV, Parquet), or an as-built ring survey (CSV, XLSX).
        out: Folder to write; replaced only once the new scene is complete.
        trajectory: Poses of the LiDAR in TUM form (t x y z qx qy qz qw), for a bag; without it, LiDAR odometry.
        control: Positions of a prism in TUM form (quaternion zero, any order) that fix odometry's length.
        calibration: Where prism and IMU sit: geode-gamma, geode-beta, …, a YAML file, or the prism's lever arm x,y,z
            in the LiDAR's axes, m.
        config: Settings.
    """
    np.seterr(all="ignore")
    build(source, out, trajectory, config, control, calibration)


if __name__ == "__main__":
    run(lambda: tyro.cli(main))
