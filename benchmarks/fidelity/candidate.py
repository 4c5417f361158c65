"""The reconstruction to be judged: the files of one scene folder in memory, and the geoms and track of its scene."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import mujoco
import numpy as np
import trimesh
from jaxtyping import Float, Shaped
from scipy.spatial.transform import Rotation

from benchmarks.fidelity.files import FidelityError, file_hash
from benchmarks.fidelity.meshes import concatenate_meshes
from scene.export import geom_triangles
from scene.inputs import read_manifest


def load_model(scene: Path) -> mujoco.MjModel:
    """Compiles an MJCF file and keeps nothing else of it.

    `MjModel.from_xml_path` gives the same model, but MuJoCo then keeps the parsed file, and the meshes that it read:
    0.45 GiB for a bore of 351 m.

    Raises:
        ValueError: MuJoCo refuses it.
    """
    mujoco.mj_setCacheCapacity(mujoco.mj_getCache(), 0)
    return mujoco.MjSpec.from_file(str(scene)).compile()


@dataclass(frozen=True)
class Geoms:
    """Geoms of a compiled scene at the model's first pose."""

    model: mujoco.MjModel  # The scene
    data: mujoco.MjData  # Its placed data
    names: tuple[str, ...]  # Name of each geom, by number

    @classmethod
    def of(cls, model: mujoco.MjModel) -> "Geoms":
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        return cls(model, data, tuple(model.geom(geom).name for geom in range(model.ngeom)))

    def named(self, *firsts: str) -> list[int]:
        """Return the numbers of the geoms whose name up to the first `_` is one of these."""
        return [geom for geom, name in enumerate(self.names) if name.split("_")[0] in firsts]

    def joined(self, prefix: str, group: int | None = None) -> trimesh.Trimesh:
        """Return the geoms whose name begins with a prefix, of one group or of all, as one mesh."""
        meshes = [self.mesh(geom) for geom, name in enumerate(self.names) if name.startswith(prefix)
                  and group in (None, self.model.geom_group[geom])]  # fmt: skip
        return concatenate_meshes(meshes)

    def mesh(self, geom: int) -> trimesh.Trimesh:
        """Return a geom as triangles in the world frame, m; raises `RecordingError` for a kind that has none."""
        mesh = trimesh.Trimesh(*geom_triangles(self.model, geom), process=False)
        placement = np.eye(4)
        placement[:3, :3] = Rotation.from_matrix(self.data.geom_xmat[geom].reshape(3, 3)).as_matrix()
        placement[:3, 3] = self.data.geom_xpos[geom]
        mesh.apply_transform(placement)
        return mesh


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
    manifest = read_manifest(folder)
    _check_files(folder, manifest)
    try:
        with np.load(folder / "bore.npz") as data:
            bore = Bore(**{name: data[name] for name in Bore.__dataclass_fields__})
        _require_whole(bore)
        files = (folder / "meshes" / f"{name}.ply" for name in ("lining", "solid"))
        lining, solid = (trimesh.load_mesh(file, process=False) for file in files)
        for mesh in (lining, solid):
            mesh.metadata.clear()  # the file's own arrays, as large as the mesh
        geoms = Geoms.of(load_model(scene))
        track, nails, bed = track_of(geoms), geoms.joined("nails_"), geoms.joined("bed_", group=0)
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise FidelityError(f"{folder}: cannot be read as a scene ({error})") from error
    plan = folder / "tunnel.npz"
    return Candidate(manifest["name"], folder, lining, solid, bore, track, manifest, scene, plan, nails=nails, bed=bed)


def _require_whole(bore: Bore) -> None:
    """Raises `ValueError` for arrays that make no bore."""
    rows = (bore.station, bore.position, bore.tangent, bore.lateral, bore.up, bore.width, bore.height, bore.radius)
    if len({len(row) for row in rows}) > 1 or len(bore.station) < 2 or bore.radius.shape[1:] != bore.angle.shape:
        raise ValueError("the arrays of bore.npz differ in length")
    if not all(np.isfinite(row).all() for row in rows) or (np.diff(bore.station) <= 0.0).any():
        raise ValueError("numbers in bore.npz are not finite, or its stations do not grow")


def _check_files(folder: Path, manifest: dict[str, Any]) -> None:
    """Refuses a scene folder of which a file is missing, or has changed since the build; raises `FidelityError`."""
    for name, expected in manifest.get("files", {}).items():
        file = folder / name
        if not file.is_file():
            raise FidelityError(f"{file}: is missing, though manifest.json names it")
        if file_hash(file) != expected:
            raise FidelityError(f"{file}: its SHA-256 is not that of manifest.json; it changed after the build")
