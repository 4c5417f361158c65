"""What the compiled scene holds: its track and nails as meshes, geom by geom."""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Track:
    """The track as the compiled scene holds it, tunnel frame.

    Attributes:
        sleeper: Middle of the top of each sleeper, in the order of the file, m, `(s, 3)`.
        sleeper_mesh: All sleepers.
        rail: By side (`left`, `right`), the rail head's inner face at its top, along the rail, m, `(k, 3)`.
        rail_mesh: All rails.
        fastening_mesh: Pads, clips and shoulders.
        gauge: Of the track's configuration, m; `None` without a track.
    """

    sleeper: Float[np.ndarray, "s 3"]
    sleeper_mesh: trimesh.Trimesh
    rail: dict[str, Float[np.ndarray, "k 3"]]
    rail_mesh: trimesh.Trimesh
    fastening_mesh: trimesh.Trimesh
    gauge: float | None


def track_of(model: mujoco.MjModel, manifest: dict[str, Any]) -> Track:
    """The track from the compiled scene: its geoms by name."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    parts: dict[str, list[trimesh.Trimesh]] = {"sleeper": [], "rail": [], "fastening": []}
    rail: dict[str, list[np.ndarray]] = {"left": [], "right": []}
    top = []
    for geom in range(model.ngeom):
        name = model.geom(geom).name
        kind = name.split("_")[0].removesuffix("s")
        if kind not in parts:
            continue
        mesh = geom_mesh(model, data, geom)
        parts[kind].append(mesh)
        if kind == "sleeper":
            top.append([*mesh.bounds.mean(axis=0)[:2], mesh.bounds[1, 2]])
        elif name.endswith("_head"):
            side = name.split("_")[1]
            frame, half = data.geom_xmat[geom].reshape(3, 3), model.geom_size[geom]
            inward = -1.0 if side == "left" else 1.0
            for end in (-half[0], half[0]):
                rail[side].append(data.geom_xpos[geom] + frame @ [end, inward * half[1], half[2]])
    joined = {kind: concatenated(meshes) for kind, meshes in parts.items()}
    gauge = manifest.get("track", {}).get("gauge") if top else None
    return Track(
        np.asarray(top).reshape(-1, 3),
        joined["sleeper"],
        {side: np.asarray(points).reshape(-1, 3) for side, points in rail.items()},
        joined["rail"],
        joined["fastening"],
        gauge,
    )


def nails_of(model: mujoco.MjModel) -> trimesh.Trimesh:
    """All nails of the compiled scene: its geoms by name."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    named = [geom for geom in range(model.ngeom) if model.geom(geom).name.startswith("nails_")]
    return concatenated([geom_mesh(model, data, geom) for geom in named])


def bed_of(model: mujoco.MjModel) -> trimesh.Trimesh:
    """The bed of the compiled scene where it is seen: a slab above the invert of a round bore, else nothing."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    seen = [g for g in range(model.ngeom) if model.geom(g).name.startswith("bed_") and model.geom_group[g] == 0]
    return concatenated([geom_mesh(model, data, geom) for geom in seen])


def concatenated(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Several meshes as one; none gives an empty one."""
    if not meshes:
        return trimesh.Trimesh()
    before = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return trimesh.Trimesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, before, strict=False)]),
        process=False,
    )


def geom_mesh(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> trimesh.Trimesh:
    """A box or mesh geom as triangles in the world frame, m.

    Raises:
        ValueError: Another kind of geom.
    """
    kind = model.geom_type[geom]
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        mesh = trimesh.creation.box(2.0 * model.geom_size[geom])
    elif kind == mujoco.mjtGeom.mjGEOM_MESH:
        k = model.geom_dataid[geom]
        vertices = model.mesh_vert[model.mesh_vertadr[k] : model.mesh_vertadr[k] + model.mesh_vertnum[k]]
        faces = model.mesh_face[model.mesh_faceadr[k] : model.mesh_faceadr[k] + model.mesh_facenum[k]]
        mesh = trimesh.Trimesh(vertices.astype(float), faces, process=False)
    else:
        raise ValueError(f"geom {model.geom(geom).name} is neither a box nor a mesh")
    placement = np.eye(4)
    placement[:3, :3] = Rotation.from_matrix(data.geom_xmat[geom].reshape(3, 3)).as_matrix()
    placement[:3, 3] = data.geom_xpos[geom]
    mesh.apply_transform(placement)
    return mesh
