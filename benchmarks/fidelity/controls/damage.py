"""Controls of meshes, of the compiled scene and of the references."""

from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import mujoco
import numpy as np
import pymeshlab
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from benchmarks.fidelity.candidate import Candidate, concatenate_meshes
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.controls.shape import move_references, without_faces
from benchmarks.fidelity.derive.surface import Caster, visible_mesh
from benchmarks.fidelity.files import FidelityError
from benchmarks.fidelity.references import Hold

_SAME = 1e-6  # m between a vertex of the lining and its twin in the solid
_FIN_HEIGHT = 0.6  # m that a fin stands into the bore
_SLIVER = 1e-4


def change_both(candidate: Candidate, change) -> Candidate:
    """Changes lining and solid alike."""
    return replace(candidate, lining=change(candidate.lining), solid=change(candidate.solid))


def drop_faces(candidate: Candidate, share: float, rng: np.random.Generator) -> Candidate:
    """Removes random faces."""
    return change_both(candidate, lambda mesh: without_faces(mesh, rng.random(len(mesh.faces)) < share))


def cut_hole(candidate: Candidate, area: float, rng: np.random.Generator) -> Candidate:
    """Cuts one round hole into a wall, m²."""
    bore = candidate.bore
    row = int(rng.integers(len(bore.station) // 4, 3 * len(bore.station) // 4))
    column = int(np.argmin(np.abs(bore.angle - 0.3)))
    aside = np.cos(bore.angle[column]) * bore.lateral[row] + np.sin(bore.angle[column]) * bore.up[row]
    middle = bore.position[row] + bore.radius[row, column] * aside

    def pierced(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        order = np.argsort(np.linalg.norm(mesh.triangles_center - middle, axis=1))
        gone = np.zeros(len(mesh.faces), bool)
        gone[order[: int(np.searchsorted(np.cumsum(mesh.area_faces[order]), area)) + 1]] = True
        return without_faces(mesh, gone)

    return change_both(candidate, pierced)


def flip_faces(candidate: Candidate, share: float, rng: np.random.Generator) -> Candidate:
    """Winds faces the wrong way; a share of 1 flips all."""

    def wrong(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        turned = rng.random(len(mesh.faces)) < share
        return trimesh.Trimesh(mesh.vertices, np.where(turned[:, None], mesh.faces[:, ::-1], mesh.faces), process=False)

    return change_both(candidate, wrong)


def double_faces(candidate: Candidate, share: float, rng: np.random.Generator) -> Candidate:
    """Repeats faces, and adds as many slivers along edges."""

    def worse(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        pick = rng.permutation(len(mesh.faces))[: max(int(share * len(mesh.faces)), 1)]
        corner = mesh.triangles[pick]
        thin = corner.copy()
        thin[:, 2] = corner[:, 0] + 0.5 * (corner[:, 1] - corner[:, 0]) + _SLIVER * (corner[:, 2] - corner[:, 0])
        slivers = trimesh.Trimesh(thin.reshape(-1, 3), np.arange(3 * len(pick)).reshape(-1, 3), process=False)
        return concatenate_meshes(
            [trimesh.Trimesh(mesh.vertices, np.vstack([mesh.faces, mesh.faces[pick]]), process=False), slivers]
        )

    return change_both(candidate, worse)


def add_fins(candidate: Candidate, count: int, rng: np.random.Generator) -> Candidate:
    """Adds fins on edges of the wall, so that three faces share an edge; each pierces the wall behind it."""

    def fin(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        pick = rng.permutation(len(mesh.faces))[:count]
        edge = mesh.faces[pick][:, :2]
        middle = mesh.vertices[edge].mean(axis=1)
        inward, outward = middle + _FIN_HEIGHT * mesh.face_normals[pick], middle - _FIN_HEIGHT * mesh.face_normals[pick]
        slanted = 0.3 * np.roll(mesh.face_normals[pick], 1, axis=1)
        first = len(mesh.vertices) + np.arange(2 * count)
        faces = [mesh.faces, np.column_stack([edge, first[:count]]), np.column_stack([edge, first[count:]])]
        return trimesh.Trimesh(
            np.vstack([mesh.vertices, inward + slanted, outward + slanted]), np.vstack(faces), process=False
        )

    return change_both(candidate, fin)


def add_vertex_noise(candidate: Candidate, sigma: float, rng: np.random.Generator) -> Candidate:
    """Displaces every vertex at random, m; twins in lining and solid alike."""
    solid = trimesh.Trimesh(candidate.solid.vertices, candidate.solid.faces, process=False)
    offset = rng.normal(0.0, sigma, solid.vertices.shape)
    distance, twin = cKDTree(candidate.solid.vertices).query(candidate.lining.vertices)
    own = rng.normal(0.0, sigma, candidate.lining.vertices.shape)
    moved = candidate.lining.vertices + np.where((distance < _SAME)[:, None], offset[twin], own)
    lining = trimesh.Trimesh(moved, candidate.lining.faces, process=False)
    return replace(candidate, lining=lining, solid=trimesh.Trimesh(solid.vertices + offset, solid.faces, process=False))


def coarsen(candidate: Candidate, share: float) -> Candidate:
    """Smooths (Laplace, the more the larger the share) and then reduces the number of faces."""

    def smooth(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        origin = mesh.vertices.mean(axis=0)
        work = pymeshlab.MeshSet()
        work.add_mesh(pymeshlab.Mesh(mesh.vertices - origin, mesh.faces))
        work.meshing_merge_close_vertices(threshold=pymeshlab.PureValue(_SAME))
        work.apply_coord_laplacian_smoothing(stepsmoothnum=max(int(10 * share), 1), boundary=True)
        work.meshing_decimation_quadric_edge_collapse(
            targetfacenum=int((1.0 - share) * len(mesh.faces)), preserveboundary=True, preservenormal=True
        )
        mesh_made = work.current_mesh()
        return trimesh.Trimesh(mesh_made.vertex_matrix() + origin, mesh_made.face_matrix(), process=False)

    return change_both(candidate, smooth)


# Controls of the compiled scene: a changed copy of the scene folder, with links to all that is unchanged.

PANELS = ("wall_", "bed_")


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
    np.savez(copy.tunnel, **arrays)
    return copy


def drop_scene_faces(candidate: Candidate, share: float, rng: np.random.Generator, scratch: Path) -> Candidate:
    """Removes random faces of the drawn lining in the compiled scene."""
    copy = copy_scene(candidate, scratch, lambda file: file.name.startswith("lining_"))
    for file in sorted((candidate.folder / "meshes").glob("lining_*.obj")):
        mesh = trimesh.load_mesh(file, process=False)
        without_faces(mesh, rng.random(len(mesh.faces)) < share).export(copy.folder / "meshes" / file.name)
    return copy


def collide_whole_mesh(candidate: Candidate, scratch: Path) -> Candidate:
    """Makes the bore collide as meshes instead of panels: MuJoCo takes the convex hull of each."""
    copy = copy_scene(candidate, scratch)
    candidate.lining.export(copy.folder / "meshes" / "whole_bore.obj")

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

    return edit_scene(copy, change)


def move_panels(candidate: Candidate, distance: float, scratch: Path) -> Candidate:
    """Moves the collision panels of the walls outwards, m."""
    copy = copy_scene(candidate, scratch)
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

    return edit_scene(copy, change)


def widen_plan(candidate: Candidate, wider: float, scratch: Path) -> Candidate:
    """Moves the walls of the environment's planar tunnel apart, so that it is not the mesh's, m."""
    copy = copy_scene(candidate, scratch, lambda file: file.name == "tunnel.npz")
    with np.load(candidate.tunnel) as data:
        arrays = {name: data[name] for name in data.files}
    normal = np.column_stack([-arrays["tangent"][:, 1], arrays["tangent"][:, 0]])
    for side, sign in (("left", 0.5), ("right", -0.5)):
        for lining in arrays["lining"]:
            at = arrays[f"{side}_station_{lining}"]
            away = np.stack([np.interp(at, arrays["station"], column) for column in normal.T], axis=1)
            arrays[f"{side}_{lining}"] = arrays[f"{side}_{lining}"] + sign * wider * away
    arrays["half_width"] = arrays["half_width"] + 0.5 * wider
    np.savez(copy.tunnel, **arrays)
    return copy


# Controls of the references, and cheats.


def turn_beams(case: Case, angle: float) -> Case:
    """Turns the held-out beams about each sensor's own vertical and side axis, rad."""
    hold = _require_hold(case)
    turn = Rotation.from_euler("zy", [angle, angle]).as_matrix()
    return replace(case, hold=replace(hold, direction=hold.direction @ turn.T, cache={}), cache={})


def permute_poses(case: Case, rng: np.random.Generator) -> Case:
    """Puts every scan at the place of another."""
    hold = _require_hold(case)
    scans, first, index = np.unique(hold.scan, return_index=True, return_inverse=True)
    place = hold.origin[first][rng.permutation(len(scans))]
    return replace(
        case, hold=replace(hold, origin=hold.origin - hold.origin[first][index] + place[index], cache={}), cache={}
    )


def judge_foreign(case: Case, other: Candidate) -> Case:
    """Judges another tunnel by this one's references, moved to its mouth and direction."""
    here, there = case.candidate.bore, other.bore
    turn = _yaw_matrix(there.tangent[0]) @ _yaw_matrix(here.tangent[0]).T
    shift = there.position[0] - turn @ here.position[0]
    return replace(move_references(case, turn, shift), candidate=other)


def forge_recording(case: Case, sigma: float, rng: np.random.Generator) -> Case:
    """Replaces the recording by beams cast in the candidate itself, with range noise or without."""
    hold = _require_hold(case)
    reach, _ = Caster(visible_mesh(case.candidate)).first(hold.origin, hold.direction)
    reach = reach + rng.normal(0.0, 1.0, len(reach)) * sigma
    forged = sha256(reach.tobytes()).hexdigest()
    keep = np.isfinite(reach)
    columns = {name: getattr(hold, name)[keep] for name in ("time", "scan", "origin", "direction")}
    return replace(case, hold=replace(hold, **columns, range=reach[keep], hash=forged, cache={}), cache={})


def leak_hold(case: Case) -> Case:
    """Gives the builder the held-out recording: the manifest's inputs hold its hash, and the fit is the hold."""
    hold = _require_hold(case)
    manifest = dict(case.candidate.manifest)
    manifest["inputs"] = [*manifest.get("inputs", []), {"file": "hold", "sha256": hold.hash}]
    return replace(case, candidate=replace(case.candidate, manifest=manifest), fit=hold, cache={})


def _require_hold(case: Case) -> Hold:
    if case.hold is None:
        raise FidelityError("this control needs a held-out recording, give one with --recording and --trajectory")
    return case.hold


def _yaw_matrix(tangent: np.ndarray) -> np.ndarray:
    return Rotation.from_euler("z", np.arctan2(tangent[1], tangent[0])).as_matrix()
