"""The scene folder: geometry, manifest, report, preview cloud and poses."""

import dataclasses
import hashlib
import io
import json
import xml.etree.ElementTree as ET
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import trimesh

from scene.bore import Bore
from scene.cleaning.sort import Removed
from scene.cloud import Cloud, thin_cloud
from scene.config import BuildConfig
from scene.errors import FitError, Refusal
from scene.fitting.trackseen import SeenTrack
from scene.inputs import MANIFEST_SCHEMA, library_versions
from scene.judging.judge import Judgement
from scene.judging.page import render_page
from scene.poses.trajectory import Trajectory, save_tum
from scene.writing.furnished import count_items, furnish_bore, planar_segments
from scene.writing.mesh import as_trimesh, build_solid, open_lining
from scene.writing.mjcf import SceneConfig, write_scene
from scene.writing.planar import Variant, cut_walls, save_tunnel, seams, shell_fields
from scene.writing.track import Track, describe_track, track_provenance
from subterra_jax.host.versions import VERSION


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
    cause: np.ndarray | None = None  # `scene.errors.Cause` of each point of `everything`, `(n,)`
    seen: SeenTrack = field(default_factory=SeenTrack)  # Tracks that the cloud shows


SCENES = ("scene.xml", "scene_furnished.xml")
_LIBRARIES = (
    "numpy", "scipy", "trimesh", "manifold3d", "mujoco", "rosbags", "small-gicp", "plyfile", "pypcd4", "laspy", "lazrs",
    "pye57", "openpyxl", "shapely",
)  # fmt: skip
_PREVIEW_VOXEL = 0.06  # m


def write_folder(
    folder: Path, name: str, result: Reconstruction, track: Track, judgement: Judgement, config: BuildConfig
) -> None:
    """Writes all parts of a scene folder and compiles both scenes; raises `FitError` where no scene can be made."""
    count, furnished = write_geometry(folder, name, config.provenance, result.bore, track, config.scene)
    content = _describe_scene(name, result, track, config.provenance, count, furnished)
    if crs := result.facts.get("crs"):
        state_crs(folder, str(crs))
    content |= {"judgement": judgement.facts, "removed": [part.facts for part in result.removed]}
    (folder / "build.html").write_text(render_page(name, result.bore, judgement, content), encoding="utf-8")
    write_manifest(folder / "manifest.json", content, config)
    if result.cloud is not None:
        thinned = thin_cloud(result.cloud, _PREVIEW_VOXEL)
        preview = trimesh.PointCloud(thinned.points)
        if thinned.intensity is not None:
            preview.vertex_attributes = {"intensity": thinned.intensity}  # type: ignore[attr-defined]  # its PLY has them
        preview.export(folder / "cloud.ply")
        if crs:
            _comment(folder / "cloud.ply", f"crs {crs}")
    if result.odometry is not None:
        save_tum(result.odometry, folder / "odometry.tum")
    for scene in SCENES:
        try:
            mujoco.MjModel.from_xml_path(str(folder / scene))
        except ValueError as error:
            raise FitError(f"{scene}: MuJoCo refuses the scene ({error})", Refusal.MUJOCO) from error


def state_crs(folder: Path, crs: str) -> None:
    """Writes the coordinate reference system of an input into every file of a scene that can hold one.

    As the MJCF text `crs` into scenes, as a comment into PLY files, and as the field `crs` into archives of NumPy.
    """
    text = ET.tostring(ET.Element("text", name="crs", data=crs), encoding="unicode")
    for scene in SCENES:
        content = (folder / scene).read_text()
        (folder / scene).write_text(content.replace("</mujoco>", f"  <custom>{text}</custom>\n</mujoco>"))
    for file in sorted(folder.rglob("*.ply")):
        _comment(file, f"crs {crs}")
    for file in sorted(folder.rglob("*.npz")):
        field = io.BytesIO()
        np.save(field, np.array(crs))
        with zipfile.ZipFile(file, "a") as archive:
            archive.writestr(zipfile.ZipInfo("crs.npy"), field.getvalue())


def _comment(file: Path, text: str) -> None:
    form, version, rest = file.read_bytes().partition(b" 1.0")
    file.write_bytes(form + version + b"\ncomment " + text.encode("ascii", "replace") + rest)


def write_geometry(
    folder: Path, name: str, provenance: str, bore: Bore, track: Track, config: SceneConfig
) -> tuple[dict[str, int], dict[str, str]]:
    """Writes `bore.npz`, `tunnel.npz`, both scenes and the whole meshes.

    Returns the number of each asset, and the provenance of the furniture. Raises `FitError` where the bore makes no
    solid, or has no walls at the LiDAR's height.
    """
    furnished = furnish_bore(bore, track, config.furniture)
    solids = {"smooth": build_solid(bore, pockets=False)}
    solids["pockets"] = build_solid(bore, pockets=True) if len(bore.pocket) else solids["smooth"]
    solids["furnished"] = build_solid(furnished.bore, pockets=True) if furnished.niches else solids["pockets"]
    height = config.lidar_height
    walls = {variant: cut_walls(solid, bore, track.elevation, height) for variant, solid in solids.items()}
    solid = as_trimesh(solids["pockets"])
    lining = open_lining(solid, bore)
    count = write_scene(folder, name, bore, lining, walls["smooth"], track, config)
    with_niches = open_lining(as_trimesh(solids["furnished"]), bore) if furnished.niches else lining
    write_scene(folder, name, bore, with_niches, walls["smooth"], track, config, furnished)
    solid.export(folder / "meshes" / "solid.ply")
    lining.export(folder / "meshes" / "lining.ply")
    smooth = open_lining(as_trimesh(solids["smooth"]), bore)
    smooth.export(folder / "meshes" / "lining_smooth.ply")
    bore.save(folder / "bore.npz")
    segments = {"furnished": planar_segments(furnished.items, bore, track.elevation, height)}
    bare, dressed = (folder / scene for scene in SCENES)
    variants = {
        "smooth": Variant(bore, False, bare),
        "pockets": Variant(bore, True, bare),
        "furnished": Variant(furnished.bore if furnished.niches else bore, True, dressed),
    }
    shell = shell_fields(bore, track.elevation, track.config, variants)
    plane = (bore, track.elevation, height, walls, segments)
    save_tunnel(folder / "tunnel.npz", name, provenance, *plane, shell, seams(variants))
    placed = {f"furniture_{kind}": number for kind, number in count_items(furnished.items).items()}
    count |= {**placed, "furniture_niche": len(furnished.niches), "lining_faces": len(lining.faces)}
    return count, {"furniture": "by standard, in the variant furnished alone"}


def write_manifest(path: Path, content: dict[str, Any], config: Any) -> None:
    """Writes the manifest with schema, config, library versions and the folder's hashes added; keys sorted."""
    whole = {
        "schema": MANIFEST_SCHEMA, "files": hash_files(path.parent), "builder": VERSION,
        "config": _json_value(dataclasses.asdict(config)), "versions": library_versions(_LIBRARIES),
        **_json_value(content),
    }  # fmt: skip
    path.write_text(json.dumps(whole, indent=2, sort_keys=True) + "\n")


def hash_files(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of each file of a folder by its name, so that a reader can check the scene."""
    hashes = {}
    for file in sorted(file for file in folder.rglob("*") if file.is_file()):
        with file.open("rb") as opened:
            hashes[file.relative_to(folder).as_posix()] = hashlib.file_digest(opened, "sha256").hexdigest()
    return hashes


def _json_value(value: Any) -> Any:
    """Return the value in JSON's types; floats to 9 digits."""
    if isinstance(value, dict):
        return {str(key): _json_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_json_value(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(f"{value:.9g}")
    if isinstance(value, np.integer):
        return int(value)
    return str(value) if isinstance(value, Path) else value


def _describe_scene(
    name: str, result: Reconstruction, track: Track, provenance: str, count: dict[str, int], furnished: dict[str, str]
) -> dict[str, Any]:
    """Return the entries of the manifest that say what the scene is and where each part comes from.

    `count` is the number of things of each kind that were written.
    """
    bore = result.bore
    assets = {**track_provenance(track, result.seen), **result.provenance}
    return {
        "name": name, "inputs": result.inputs, "input_provenance": provenance,
        "frame": {"origin": result.origin, "up": "z", "length_unit": "m", "crs": result.facts.get("crs")}, "seeds": {},
        "detected": result.facts,
        "bore": {
            "length": bore.length, "width_mean": float(bore.width.mean()), "height_mean": float(bore.height.mean()),
            "filled_share": float(bore.filled.mean()),
        },
        "count": {
            **count, "stations": len(bore.station), "rings": len(bore.ring_station), "pockets": len(bore.pocket),
        },
        "track": describe_track(track, result.seen),
        "provenance": {
            "bore": provenance,
            **furnished,
            **{asset: kind.replace("measured", provenance) for asset, kind in assets.items()},
        },
    }  # fmt: skip
