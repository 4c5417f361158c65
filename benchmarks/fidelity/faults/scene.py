"""Faults of the compiled scene: a changed copy of the scene folder, with links to all that is unchanged."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import trimesh

from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.derive.curve import interpolate_rows
from benchmarks.fidelity.faults.kinds import Fault, Site, fault_kind
from benchmarks.fidelity.meshes import without_faces
from subterra_jax.host.tunnelfile import read_fields

PANELS = ("wall_", "bed_")
OUTWARD = ("wall_", "low_")


def copy_scene(candidate: Candidate, scratch: Path, changed: Callable[[Path], bool] = lambda file: False) -> Candidate:
    """Links a candidate's folder file by file into a scratch folder, less the files that are written anew."""
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


def edit_scene(candidate: Candidate, change: Callable[[mujoco.MjSpec], None]) -> Candidate:
    """Changes the model of a copied candidate's scene."""
    spec = mujoco.MjSpec.from_file(str(candidate.scene))
    change(spec)
    spec.compile()
    candidate.scene.write_text(spec.to_xml())
    return candidate


def scale_scene(candidate: Candidate, factor: float, scratch: Path) -> Candidate:
    """Scales everything that does not move about the middle of the axis, and the planar tunnel with it."""
    middle = candidate.bore.position.mean(axis=0)
    copy = copy_scene(candidate, scratch, lambda file: file.name == "tunnel.npz")

    def change(spec: mujoco.MjSpec) -> None:
        for mesh in spec.meshes:
            mesh.scale = np.asarray(mesh.scale) * factor
        for geom in spec.worldbody.geoms:
            geom.pos = middle + factor * (np.asarray(geom.pos) - middle)
            geom.size = np.asarray(geom.size) * factor
        for body in spec.worldbody.bodies:
            body.pos = middle + factor * (np.asarray(body.pos) - middle)

    edit_scene(copy, change)
    arrays: dict[str, Any] = read_fields(candidate.tunnel)
    for name, value in arrays.items():
        if name in ("station", "half_width") or "station_" in name:
            arrays[name] = value * factor
        elif name == "centre" or name.startswith(("left_", "right_")):
            arrays[name] = middle[:2] + factor * (value - middle[:2])
        elif name == "elevation":
            arrays[name] = middle[2] + factor * (value - middle[2])
        elif name == "lidar_height":
            arrays[name] = np.asarray(value * factor)
    np.savez(copy.tunnel, **arrays)
    return copy


def drop_scene_faces(candidate: Candidate, share: float, rng: np.random.Generator, scratch: Path) -> Candidate:
    copy = copy_scene(candidate, scratch, lambda file: file.name.startswith("lining_"))
    for file in sorted((candidate.folder / "meshes").glob("lining_*.obj")):
        mesh = trimesh.load_mesh(file, process=False)
        without_faces(mesh, rng.random(len(mesh.faces)) < share).export(copy.folder / "meshes" / file.name)
    return copy


@fault_kind("whole", "whole bore as one collidable mesh geom", signed=False)
def collide_whole_mesh(site: Site, fault: Fault) -> Candidate:
    """Makes the bore collide as meshes instead of panels: MuJoCo takes the convex hull of each."""
    copy = copy_scene(site.candidate, site.scratch)
    site.candidate.lining.export(copy.folder / "meshes" / "whole_bore.obj")

    def change(spec: mujoco.MjSpec) -> None:
        for geom in list(spec.worldbody.geoms):
            if geom.name.startswith(PANELS):
                spec.delete(geom)
        whole = spec.add_mesh(name="whole_bore", file="whole_bore.obj")
        whole.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        kind = mujoco.mjtGeom.mjGEOM_MESH
        spec.worldbody.add_geom(name="whole_bore", type=kind, meshname="whole_bore", contype=15, conaffinity=0, group=3)

    return edit_scene(copy, change)


@fault_kind("panels", "collision boxes of the walls outwards", "m")
def move_panels(site: Site, fault: Fault) -> Candidate:
    copy = copy_scene(site.candidate, site.scratch)
    axis = site.candidate.bore.position

    def change(spec: mujoco.MjSpec) -> None:
        for geom in spec.worldbody.geoms:
            if geom.name.startswith(OUTWARD):
                away = np.asarray(geom.pos) - axis[np.argmin(np.linalg.norm(axis - geom.pos, axis=1))]
                turn = np.zeros(9)
                mujoco.mju_quat2Mat(turn, np.asarray(geom.quat))
                sides = turn.reshape(3, 3)[:, 1:].T  # x runs along the tunnel
                normal = sides[np.argmax(np.abs(sides @ away))]
                geom.pos = np.asarray(geom.pos) + fault.size * np.sign(normal @ away) * normal

    return edit_scene(copy, change)


@fault_kind("plan", "the environment's walls apart from the mesh's", "m")
def widen_plan(site: Site, fault: Fault) -> Candidate:
    """Moves the walls of the environment's planar tunnel apart, so that it is not the mesh's."""
    wider = fault.size
    copy = copy_scene(site.candidate, site.scratch, lambda file: file.name == "tunnel.npz")
    arrays: dict[str, Any] = read_fields(site.candidate.tunnel)
    normal = np.column_stack([-arrays["tangent"][:, 1], arrays["tangent"][:, 0]])
    for side, sign in (("left", 0.5), ("right", -0.5)):
        for lining in arrays["lining"]:
            at = arrays[f"{side}_station_{lining}"]
            away = interpolate_rows(at, arrays["station"], normal)
            arrays[f"{side}_{lining}"] = arrays[f"{side}_{lining}"] + sign * wider * away
    arrays["half_width"] = arrays["half_width"] + 0.5 * wider
    np.savez(copy.tunnel, **arrays)
    return copy
