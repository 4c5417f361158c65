"""Read the surfaces of a scene folder as triangles in the tunnel frame: lining, bed, sleepers, rails, furniture."""

import dataclasses
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from subterra_jax.host.errors import TunnelError
from subterra_jax.host.versions import BUILD_AGAIN, other_schema

if TYPE_CHECKING:
    import mujoco

_BORE_SCHEMA = "subterra.bore/1"
SCENES = {"smooth": "scene.xml", "pockets": "scene.xml", "furnished": "scene_furnished.xml"}
LINING_KINDS = ("lining", "recess", "floor")  # first parts of the geoms' names
# Bolts and clips of a few centimetres make up half of all triangles.
SMALL = ("fastening", "nails")
_LARGEST_SEEN_GROUP = 1
BOX_FACES = np.array([(0, 1, 3), (0, 3, 2), (4, 7, 5), (4, 6, 7), (0, 5, 1), (0, 4, 5), (2, 3, 7), (2, 7, 6),
                       (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)])  # fmt: skip
BOX_CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)


@dataclasses.dataclass(frozen=True)
class Axis:
    """The centreline of a bore.

    Attributes:
        station: Uniform stations from 0, m, `(n,)`.
        position: Positions, m, `(n, 3)`.
        tangent: Unit vectors of growing station, `(n, 3)`.
    """

    station: Float[np.ndarray, "n"]
    position: Float[np.ndarray, "n 3"]
    tangent: Float[np.ndarray, "n 3"]


@dataclasses.dataclass(frozen=True)
class Triangles:
    """A surface: `vertices (v, 3)` in the tunnel frame, m, and `faces (f, 3)`, rows of them."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]


class ScenePart(NamedTuple):
    """One geom of a scene.

    Attributes:
        kind: First part of its name.
        material: Name of its material; empty if it has none.
        colour: Red, green, blue, alpha of the material, 0 to 1; 0 if it has none.
        triangles: Its surface in the tunnel frame.
    """

    kind: str
    material: str
    colour: Float[np.ndarray, "4"]
    triangles: Triangles


def join_surfaces(parts: list[Triangles]) -> Triangles:
    """Join several surfaces into one."""
    before = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + offset for part, offset in zip(parts, before, strict=False)]
    return Triangles(
        np.concatenate([np.empty((0, 3)), *(part.vertices for part in parts)]),
        np.concatenate([np.empty((0, 3), np.int64), *faces]),
    )


def read_axis(path: Path) -> Axis:
    """Read the centreline of a `bore.npz`.

    Raises:
        TunnelError: The file cannot be read, has another schema, or lacks a field.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            if (found := str(data["schema"])) != _BORE_SCHEMA:
                raise TunnelError(f"{path}: {other_schema(found, _BORE_SCHEMA, BUILD_AGAIN)}")
            return Axis(*(np.asarray(data[name], np.float64) for name in ("station", "position", "tangent")))
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise TunnelError(f"{path}: not a bore file ({error})") from error


def read_mesh(path: Path) -> Triangles:
    """Read a mesh file.

    Raises:
        TunnelError: The file is missing, cannot be read, or holds no triangle.
    """
    import trimesh

    if not path.is_file():
        raise TunnelError(f"{path}: no such mesh; was the scene built by an older version?")
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except Exception as error:  # each of its readers raises its own
        raise TunnelError(f"{path}: not a readable mesh ({error})") from error
    if not len(getattr(mesh, "faces", ())):
        raise TunnelError(f"{path}: holds no triangle")
    return Triangles(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))


def read_scene(folder: Path, lining: str = "pockets", leave_out: tuple[str, ...] = SMALL) -> Triangles:
    """Read every visible surface of a scene.

    Args:
        folder: A scene folder.
        lining: `smooth`, `pockets`, or `furnished`, which brings the furniture along.
        leave_out: Kinds of geom to leave out, by the first part of their names.

    Raises:
        TunnelError: The lining is unknown, or a file of the folder is missing or damaged.
    """
    if lining not in SCENES:
        raise TunnelError(f"{folder}: there is no lining {lining!r}; a scene has {', '.join(SCENES)}")
    smooth = lining == "smooth"
    parts = scene_parts(folder / SCENES[lining], (*leave_out, *(LINING_KINDS if smooth else ())))
    meshes = [part.triangles for part in parts]
    return join_surfaces([*meshes, read_mesh(folder / "meshes" / "lining_smooth.ply")] if smooth else meshes)


def scene_parts(path: Path, leave_out: tuple[str, ...] = ()) -> list[ScenePart]:
    """Read the meshes and boxes of a MuJoCo scene that a camera sees.

    Raises:
        TunnelError: The file is missing, or MuJoCo refuses it.
    """
    import mujoco

    if not path.is_file():
        raise TunnelError(f"{path}: no such scene")
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise TunnelError(f"{path}: MuJoCo refuses the scene ({error})") from error
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    parts = []
    for geom in np.flatnonzero(model.geom_group <= _LARGEST_SEEN_GROUP):
        kind, material = model.geom(geom).name.split("_")[0], int(model.geom_matid[geom])
        if kind in leave_out or not len((triangles := _geom_triangles(model, data, int(geom))).faces):
            continue
        name, colour = ("", np.zeros(4)) if material < 0 else (model.mat(material).name, model.mat(material).rgba)
        parts.append(ScenePart(kind, name, colour.copy(), triangles))
    return parts


def _geom_triangles(model: "mujoco.MjModel", data: "mujoco.MjData", geom: int) -> Triangles:
    """Return the triangles of a mesh or box in the world frame; none for other shapes, which scenes do not have."""
    import mujoco

    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        vertices = model.mesh_vert[first : first + count].astype(np.float64)
        first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        faces = model.mesh_face[first : first + count].astype(np.int64)
    elif model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        vertices, faces = BOX_CORNERS * model.geom_size[geom], BOX_FACES
    else:
        vertices, faces = np.empty((0, 3)), np.empty((0, 3), np.int64)
    return Triangles(vertices @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom], faces)
