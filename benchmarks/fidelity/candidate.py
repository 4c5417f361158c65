"""The reconstruction to be judged: the files of one scene folder in memory, and the track of its compiled scene."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Shaped

from benchmarks.fidelity.files import FidelityError, file_hash
from benchmarks.fidelity.geoms import Geoms, load_model
from benchmarks.fidelity.meshes import concatenate_meshes


@dataclass(frozen=True)
class Track:
    """Track of the compiled scene, tunnel frame."""

    sleeper: Float[np.ndarray, "s 3"]  # Middle of the top of each sleeper, in the order of the file, m, `(s, 3)`
    sleeper_mesh: trimesh.Trimesh  # Mesh of all sleepers
    # Inner face of the rail head at its top, along the rail, by side (`left`, `right`), m, `(k, 3)`
    rail: dict[str, Float[np.ndarray, "k 3"]]
    rail_mesh: trimesh.Trimesh  # Mesh of all rails
    fastening_mesh: trimesh.Trimesh  # Mesh of pads, clips and shoulders


def track_of(geoms: Geoms) -> Track:
    """Return the track of a compiled scene; a second track is not judged."""
    parts: dict[str, list[trimesh.Trimesh]] = {"sleeper": [], "rail": [], "fastening": []}
    rail: dict[str, list[np.ndarray]] = {"left": [], "right": []}
    top = []
    for geom, name in enumerate(geoms.names):
        kind = name.split("_")[0].removesuffix("s")
        if kind not in parts or "_2_" in name:
            continue
        mesh = geoms.mesh(geom)
        parts[kind].append(mesh)
        if kind == "sleeper":
            top.append([*mesh.bounds.mean(axis=0)[:2], mesh.bounds[1, 2]])
        elif name.endswith("_head"):
            side = name.split("_")[1]
            frame, half = geoms.data.geom_xmat[geom].reshape(3, 3), geoms.model.geom_size[geom]
            inward = -1.0 if side == "left" else 1.0
            for end in (-half[0], half[0]):
                rail[side].append(geoms.data.geom_xpos[geom] + frame @ [end, inward * half[1], half[2]])
    joined = {kind: concatenate_meshes(meshes) for kind, meshes in parts.items()}
    inner = {side: np.asarray(points).reshape(-1, 3) for side, points in rail.items()}
    return Track(np.asarray(top).reshape(-1, 3), joined["sleeper"], inner, joined["rail"], joined["fastening"])


# The candidate: the files of one scene folder.

MANIFEST_SCHEMA = "subterra.manifest/1"


@dataclass(frozen=True)
class Bore:
    """Arrays of `bore.npz` that the suite reads; docs/formats.md explains each."""

    station: Float[np.ndarray, " n"]
    position: Float[np.ndarray, "n 3"]
    tangent: Float[np.ndarray, "n 3"]
    lateral: Float[np.ndarray, "n 3"]
    up: Float[np.ndarray, "n 3"]
    width: Float[np.ndarray, " n"]
    height: Float[np.ndarray, " n"]
    angle: Float[np.ndarray, " m"]
    radius: Float[np.ndarray, "n m"]
    ring_station: Float[np.ndarray, " r"]
    pocket: Shaped[np.ndarray, " p"]


@dataclass(frozen=True)
class Candidate:
    """Reconstruction to be judged."""

    name: str  # Name for people
    folder: Path  # Scene folder, which SCN and PAR read
    lining: trimesh.Trimesh  # Open bore with its pockets, tunnel frame, m
    solid: trimesh.Trimesh  # Watertight air volume
    bore: Bore  # Centreline and sections
    track: Track  # Sleepers and rails
    manifest: dict[str, Any]  # Manifest of the scene
    scene: Path  # The MJCF file, by default the folder's own
    tunnel: Path  # The planar tunnel of the environment, by default the folder's own
    # Further visible surfaces (debris, pillars): empty in what the builder made
    extra: trimesh.Trimesh = field(default_factory=trimesh.Trimesh)
    # Bolts that bridge pockets, as the compiled scene holds them
    nails: trimesh.Trimesh = field(default_factory=trimesh.Trimesh)
    # The slab under the track where the compiled scene shows one
    bed: trimesh.Trimesh = field(default_factory=trimesh.Trimesh)

    @property
    def origin(self) -> Float[np.ndarray, "3"]:
        """Origin of the tunnel frame in the input's frame, m."""
        return np.asarray(self.manifest["frame"]["origin"], float)

    @property
    def length(self) -> float:
        """Length of the centreline, m."""
        return float(self.bore.station[-1])


def load_candidate(folder: Path) -> Candidate:
    """Reads a scene folder.

    Raises:
        FidelityError: A file is missing or not what it should be.
    """
    scene = folder / "scene.xml"
    for needed in (scene, folder / "bore.npz", folder / "tunnel.npz", folder / "manifest.json"):
        if not needed.exists():
            raise FidelityError(f"{folder}: is no scene folder, {needed.name} is missing")
    manifest = _read_manifest(folder)
    try:
        with np.load(folder / "bore.npz") as data:
            bore = Bore(**{name: data[name] for name in Bore.__dataclass_fields__})
        lining, solid = (
            trimesh.load_mesh(folder / "meshes" / f"{name}.ply", process=False) for name in ("lining", "solid")
        )
        for mesh in (lining, solid):
            mesh.metadata.clear()  # the file's own arrays, as large as the mesh
        geoms = Geoms.of(load_model(scene))
        track, nails, bed = track_of(geoms), geoms.joined("nails_"), geoms.joined("bed_", group=0)
    except (OSError, ValueError, KeyError) as error:
        raise FidelityError(f"{folder}: cannot be read as a scene ({error})") from error
    plan = folder / "tunnel.npz"
    return Candidate(manifest["name"], folder, lining, solid, bore, track, manifest, scene, plan, nails=nails, bed=bed)


def _read_manifest(folder: Path) -> dict[str, Any]:
    """Reads the manifest of a scene folder and checks the files that it names.

    Raises:
        FidelityError: It cannot be read or has another schema; a file is missing or has changed since the build.
    """
    path = folder / "manifest.json"
    try:
        manifest: dict[str, Any] = json.loads(path.read_text())
        schema = manifest.get("schema")
    except (OSError, ValueError, AttributeError) as error:
        raise FidelityError(f"{path}: is no manifest ({error})") from error
    if schema != MANIFEST_SCHEMA:
        raise FidelityError(f"{path}: schema is {schema}, not {MANIFEST_SCHEMA}; build the scene anew")
    for name, expected in manifest.get("files", {}).items():
        if not (folder / name).is_file():
            raise FidelityError(f"{folder / name}: is missing, though {path.name} names it")
        if file_hash(folder / name) != expected:
            raise FidelityError(f"{folder / name}: its SHA-256 is not that of {path.name}; it changed after the build")
    return manifest
