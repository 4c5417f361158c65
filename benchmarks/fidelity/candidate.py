"""What is judged: the released files of one scene folder, in memory, so that controls can spoil a copy."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import trimesh
from jaxtyping import Float, Shaped

from benchmarks.fidelity.compiled import Track, bed_of, nails_of, track_of
from benchmarks.fidelity.errors import FidelityError
from benchmarks.fidelity.filehash import file_hash

MANIFEST_SCHEMA = "subterra.manifest/1"


@dataclass(frozen=True)
class Bore:
    """The arrays of `bore.npz` that the suite reads; docs/formats.md says what each is."""

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
    """A reconstruction to be judged.

    Attributes:
        name: For people.
        folder: The scene folder; what SCN and PAR read.
        lining: Open bore with its pockets, tunnel frame, m.
        solid: Watertight air volume.
        bore: Centreline and sections.
        track: Sleepers and rails.
        manifest: Of the scene.
        scene: The MJCF file, by default the folder's own.
        tunnel: The planar tunnel of the environment, by default the folder's own.
        extra: Further visible surfaces (debris, pillars): empty in what the builder made.
        nails: Bolts that bridge pockets, as the compiled scene holds them.
        bed: The slab under the track where the compiled scene shows one.
    """

    name: str
    folder: Path
    lining: trimesh.Trimesh
    solid: trimesh.Trimesh
    bore: Bore
    track: Track
    manifest: dict[str, Any]
    scene: Path
    tunnel: Path
    extra: trimesh.Trimesh = field(default_factory=trimesh.Trimesh)
    nails: trimesh.Trimesh = field(default_factory=trimesh.Trimesh)
    bed: trimesh.Trimesh = field(default_factory=trimesh.Trimesh)

    @property
    def origin(self) -> Float[np.ndarray, "3"]:
        """Of the tunnel frame in the input's frame, m."""
        return np.asarray(self.manifest["frame"]["origin"], float)

    @property
    def length(self) -> float:
        """Of the centreline, m."""
        return float(self.bore.station[-1])


def load(folder: Path) -> Candidate:
    """Reads a scene folder.

    Raises:
        FidelityError: A file is missing or not what it should be.
    """
    scene = folder / "scene.xml"
    for needed in (scene, folder / "bore.npz", folder / "tunnel.npz", folder / "manifest.json"):
        if not needed.exists():
            raise FidelityError(f"{folder}: is no scene folder, {needed.name} is missing")
    manifest = _manifest(folder)
    try:
        with np.load(folder / "bore.npz") as data:
            bore = Bore(**{name: data[name] for name in Bore.__dataclass_fields__})
        lining, solid = (
            trimesh.load_mesh(folder / "meshes" / f"{name}.ply", process=False) for name in ("lining", "solid")
        )
        model = mujoco.MjModel.from_xml_path(str(scene))
        track, nails, bed = track_of(model, manifest), nails_of(model), bed_of(model)
    except (OSError, ValueError, KeyError) as error:
        raise FidelityError(f"{folder}: cannot be read as a scene ({error})") from error
    plan = folder / "tunnel.npz"
    return Candidate(manifest["name"], folder, lining, solid, bore, track, manifest, scene, plan, nails=nails, bed=bed)


def _manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a scene folder whose files are those that it names.

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
    for name, wanted in manifest.get("files", {}).items():
        if not (folder / name).is_file():
            raise FidelityError(f"{folder / name}: is missing, though {path.name} names it")
        if file_hash(folder / name) != wanted:
            raise FidelityError(f"{folder / name}: its SHA-256 is not that of {path.name}; it changed after the build")
    return manifest
