"""A reconstruction to its scene folder: geometry, manifest, preview cloud and poses."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import trimesh

from scene.cloud import thinned
from scene.errors import FitError
from scene.poses.trajectory import save_tum
from scene.reconstruct import ReconstructConfig, Reconstruction
from scene.writing import manifest
from scene.writing.geometry import SCENES, write_geometry
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


def write_scene_folder(folder: Path, name: str, result: Reconstruction, config: BuildConfig) -> None:
    """Writes the six parts of a scene folder and compiles the scene once."""
    bore = result.bore
    laid = lay(bore, config.track, result.seen.sleepers)
    count, furnished = write_geometry(folder, name, config.provenance, bore, laid, config.scene)
    content = {
        "name": name,
        "inputs": result.inputs,
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
        },
        "track": _track_facts(laid, result),
        "provenance": {
            "bore": config.provenance,
            **furnished,
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
    for scene in SCENES:
        _compile(folder / scene)


def _track_facts(laid: Track, result: Reconstruction) -> dict[str, Any]:
    rails = result.seen.rails
    return {
        "least_clearance": float(laid.clearance.min()) if len(laid.clearance) else None,
        "slab": laid.raised,
        "sleepers_seen": int(laid.measured.sum()),
        "protrusion": laid.config.protrusion,
        "gauge": laid.config.gauge,
        "gauge_seen": rails.gauge if rails else None,
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
