"""Controls of the compiled scene: a changed copy of the scene folder that everything unchanged is linked into."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import trimesh

from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.controls.parts import without_faces

PANELS = ("wall_", "bed_")


def copied(candidate: Candidate, scratch: Path, changed: Callable[[Path], bool] = lambda file: False) -> Candidate:
    """The candidate with its folder linked file by file into a scratch folder, less what is to be written anew."""
    folder = scratch / "scene"
    for file in sorted(path for path in candidate.folder.rglob("*") if path.is_file()):
        if file.name not in ("scene.xml", "cloud.ply") and not changed(file):
            link = folder / file.relative_to(candidate.folder)
            link.parent.mkdir(parents=True, exist_ok=True)
            if not link.exists():
                link.symlink_to(file.resolve())
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.xml").write_bytes(candidate.scene.read_bytes())
    return replace(candidate, folder=folder, scene=folder / "scene.xml", tunnel=folder / "tunnel.npz")


def edited(candidate: Candidate, change: Callable[[mujoco.MjSpec], None]) -> Candidate:
    """The scene of a copied candidate with its model changed."""
    spec = mujoco.MjSpec.from_file(str(candidate.scene))
    change(spec)
    spec.compile()
    candidate.scene.write_text(spec.to_xml())
    return candidate


def scaled_scene(candidate: Candidate, factor: float, scratch: Path) -> Candidate:
    """Everything that does not move larger about the middle of the axis, and the planar tunnel with it."""
    middle = candidate.bore.position.mean(axis=0)
    made = copied(candidate, scratch, lambda file: file.name == "tunnel.npz")

    def change(spec: mujoco.MjSpec) -> None:
        for mesh in spec.meshes:
            mesh.scale = np.asarray(mesh.scale) * factor
        for geom in spec.worldbody.geoms:
            geom.pos = middle + factor * (np.asarray(geom.pos) - middle)
            geom.size = np.asarray(geom.size) * factor
        for body in spec.worldbody.bodies:
            body.pos = middle + factor * (np.asarray(body.pos) - middle)

    edited(made, change)
    with np.load(candidate.tunnel) as data:
        arrays = {name: data[name] for name in data.files}
    for name, value in arrays.items():
        if name in ("station", "half_width") or "station_" in name:
            arrays[name] = value * factor
        elif name == "centre" or name.startswith(("left_", "right_")):
            arrays[name] = middle[:2] + factor * (value - middle[:2])
        elif name == "elevation":
            arrays[name] = middle[2] + factor * (value - middle[2])
        elif name == "lidar_height":
            arrays[name] = np.asarray(value * factor)
    np.savez(made.tunnel, **arrays)
    return made


def holed_scene(candidate: Candidate, share: float, rng: np.random.Generator, scratch: Path) -> Candidate:
    """Random faces of the drawn lining missing in the compiled scene."""
    made = copied(candidate, scratch, lambda file: file.name.startswith("lining_"))
    for file in sorted((candidate.folder / "meshes").glob("lining_*.obj")):
        mesh = trimesh.load_mesh(file, process=False)
        without_faces(mesh, rng.random(len(mesh.faces)) < share).export(made.folder / "meshes" / file.name)
    return made


def one_collidable_mesh(candidate: Candidate, scratch: Path) -> Candidate:
    """The bore as collidable meshes instead of panels: MuJoCo takes the convex hull of each."""
    made = copied(candidate, scratch)
    candidate.lining.export(made.folder / "meshes" / "whole_bore.obj")

    def change(spec: mujoco.MjSpec) -> None:
        for geom in list(spec.worldbody.geoms):
            if geom.name.startswith(PANELS):
                spec.delete(geom)
        whole = spec.add_mesh(name="whole_bore", file="whole_bore.obj")
        whole.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        spec.worldbody.add_geom(
            name="whole_bore",
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname="whole_bore",
            contype=1 | 2 | 4 | 8,
            conaffinity=0,
            group=3,
        )

    return edited(made, change)


def panels_off(candidate: Candidate, distance: float, scratch: Path) -> Candidate:
    """Collision panels of the walls farther out than the wall, m."""
    made = copied(candidate, scratch)
    axis = candidate.bore.position

    def change(spec: mujoco.MjSpec) -> None:
        for geom in spec.worldbody.geoms:
            if geom.name.startswith(("wall_", "low_")):
                away = np.asarray(geom.pos) - axis[np.argmin(np.linalg.norm(axis - geom.pos, axis=1))]
                turn = np.zeros(9)
                mujoco.mju_quat2Mat(turn, np.asarray(geom.quat))
                sides = turn.reshape(3, 3)[:, 1:].T  # x runs along the tunnel
                normal = sides[np.argmax(np.abs(sides @ away))]
                geom.pos = np.asarray(geom.pos) + distance * np.sign(normal @ away) * normal

    return edited(made, change)


def other_plan(candidate: Candidate, wider: float, scratch: Path) -> Candidate:
    """The environment's planar tunnel made from another geometry than the mesh: walls apart by some metres more."""
    made = copied(candidate, scratch, lambda file: file.name == "tunnel.npz")
    with np.load(candidate.tunnel) as data:
        arrays = {name: data[name] for name in data.files}
    normal = np.column_stack([-arrays["tangent"][:, 1], arrays["tangent"][:, 0]])
    for side, sign in (("left", 0.5), ("right", -0.5)):
        for lining in arrays["lining"]:
            at = arrays[f"{side}_station_{lining}"]
            away = np.stack([np.interp(at, arrays["station"], column) for column in normal.T], axis=1)
            arrays[f"{side}_{lining}"] = arrays[f"{side}_{lining}"] + sign * wider * away
    arrays["half_width"] = arrays["half_width"] + 0.5 * wider
    np.savez(made.tunnel, **arrays)
    return made
