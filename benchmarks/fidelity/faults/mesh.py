"""Faults of the compiled scene and of the meshes: holes, flipped and doubled faces, noise; bodies in the bore."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import trimesh
from scipy.spatial import cKDTree

from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.derive.curve import interpolate_rows
from benchmarks.fidelity.faults.kinds import Fault, Site, fault_kind
from benchmarks.fidelity.meshes import concatenate_meshes, count_edges, without_faces
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


def drop_scene_faces(candidate: Candidate, fraction: float, rng: np.random.Generator, scratch: Path) -> Candidate:
    copy = copy_scene(candidate, scratch, lambda file: file.name.startswith("lining_"))
    for file in sorted((candidate.folder / "meshes").glob("lining_*.obj")):
        mesh = trimesh.load_mesh(file, process=False)
        without_faces(mesh, rng.random(len(mesh.faces)) < fraction).export(copy.folder / "meshes" / file.name)
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


# Faults of the meshes.

_SAME = 1e-6  # m between a vertex of the lining and its twin in the solid
_FIN_HEIGHT = 0.6  # m that a fin stands into the bore
_SLIVER = 1e-4


def change_both(candidate: Candidate, change: Callable[[trimesh.Trimesh], trimesh.Trimesh]) -> Candidate:
    return replace(candidate, lining=change(candidate.lining), solid=change(candidate.solid))


@fault_kind("holes", "fraction of the faces missing, of the released scene too", signed=False)
def drop_faces(site: Site, fault: Fault) -> Candidate:
    rng = site.rng
    holed = drop_scene_faces(site.candidate, fault.size, rng, site.scratch)
    return change_both(holed, lambda mesh: without_faces(mesh, rng.random(len(mesh.faces)) < fault.size))


@fault_kind("hole", "one round hole in a wall", "m2", signed=False)
def cut_hole(site: Site, fault: Fault) -> Candidate:
    bore = site.candidate.bore
    row = int(site.rng.integers(len(bore.station) // 4, 3 * len(bore.station) // 4))
    column = int(np.argmin(np.abs(bore.angle - 0.3)))
    aside = np.cos(bore.angle[column]) * bore.lateral[row] + np.sin(bore.angle[column]) * bore.up[row]
    middle = bore.position[row] + bore.radius[row, column] * aside

    def pierced(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        order = np.argsort(np.linalg.norm(mesh.triangles_center - middle, axis=1))
        gone = np.zeros(len(mesh.faces), bool)
        gone[order[: int(np.searchsorted(np.cumsum(mesh.area_faces[order]), fault.size)) + 1]] = True
        return without_faces(mesh, gone)

    return change_both(site.candidate, pierced)


@fault_kind("flipped", "fraction of the faces wound the wrong way", signed=False)
def flip_faces(site: Site, fault: Fault) -> Candidate:
    def wrong(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        turned = site.rng.random(len(mesh.faces)) < fault.size
        return trimesh.Trimesh(mesh.vertices, np.where(turned[:, None], mesh.faces[:, ::-1], mesh.faces), process=False)

    return change_both(site.candidate, wrong)


@fault_kind("doubled", "fraction of the faces that stand twice, with as many slivers", signed=False)
def double_faces(site: Site, fault: Fault) -> Candidate:
    def worse(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        pick = site.rng.permutation(len(mesh.faces))[: max(int(fault.size * len(mesh.faces)), 1)]
        corner = mesh.triangles[pick]
        thin = corner.copy()
        thin[:, 2] = corner[:, 0] + 0.5 * (corner[:, 1] - corner[:, 0]) + _SLIVER * (corner[:, 2] - corner[:, 0])
        slivers = trimesh.Trimesh(thin.reshape(-1, 3), np.arange(3 * len(pick)).reshape(-1, 3), process=False)
        return concatenate_meshes(
            [trimesh.Trimesh(mesh.vertices, np.vstack([mesh.faces, mesh.faces[pick]]), process=False), slivers]
        )

    return change_both(site.candidate, worse)


@fault_kind("fins", "fins on edges that three faces then share", "count", signed=False)
def add_fins(site: Site, fault: Fault) -> Candidate:
    """Adds fins on edges of the wall; each pierces the wall behind it."""
    count = int(fault.size)

    def fin(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        pick = site.rng.permutation(len(mesh.faces))[:count]
        edge = mesh.faces[pick][:, :2]
        middle = mesh.vertices[edge].mean(axis=1)
        inward, outward = middle + _FIN_HEIGHT * mesh.face_normals[pick], middle - _FIN_HEIGHT * mesh.face_normals[pick]
        slanted = 0.3 * np.roll(mesh.face_normals[pick], 1, axis=1)
        first = len(mesh.vertices) + np.arange(2 * count)
        faces = [mesh.faces, np.column_stack([edge, first[:count]]), np.column_stack([edge, first[count:]])]
        return trimesh.Trimesh(
            np.vstack([mesh.vertices, inward + slanted, outward + slanted]), np.vstack(faces), process=False
        )

    return change_both(site.candidate, fin)


@fault_kind("noise", "noise of the vertices", "m", signed=False)
def add_vertex_noise(site: Site, fault: Fault) -> Candidate:
    """Displaces every vertex at random; twins in lining and solid alike."""
    candidate = site.candidate
    offset = site.rng.normal(0.0, fault.size, candidate.solid.vertices.shape)
    distance, twin = cKDTree(candidate.solid.vertices).query(candidate.lining.vertices)
    own = site.rng.normal(0.0, fault.size, candidate.lining.vertices.shape)
    by = np.where((distance < _SAME)[:, None], offset[twin], own)
    lining, solid = (
        trimesh.Trimesh(mesh.vertices + shift, mesh.faces, process=False)
        for mesh, shift in ((candidate.lining, by), (candidate.solid, offset))
    )
    return replace(candidate, lining=lining, solid=solid)


@fault_kind("coarse", "fraction of the faces that smoothing and decimation take", signed=False)
def coarsen(site: Site, fault: Fault) -> Candidate:
    """Smooths (Laplace, the more the larger the fraction) and then reduces the number of faces."""
    import pymeshlab

    fraction = fault.size

    def smooth(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        origin = mesh.vertices.mean(axis=0)
        work = pymeshlab.MeshSet()
        work.add_mesh(pymeshlab.Mesh(mesh.vertices - origin, mesh.faces))
        work.meshing_merge_close_vertices(threshold=pymeshlab.PureValue(_SAME))
        work.apply_coord_laplacian_smoothing(stepsmoothnum=max(int(10 * fraction), 1), boundary=True)
        work.meshing_decimation_quadric_edge_collapse(
            targetfacenum=int((1.0 - fraction) * len(mesh.faces)), preserveboundary=True, preservenormal=True
        )
        mesh_made = work.current_mesh()
        return trimesh.Trimesh(mesh_made.vertex_matrix() + origin, mesh_made.face_matrix(), process=False)

    return change_both(site.candidate, smooth)


# Bodies in the bore, and a mouth that is closed.

EACH = 36.0  # m, the tunnels on which the points of the controls were set: a longer one gets its fraction
_WALL_THICKNESS = 0.3  # m
_DEBRIS_RADIUS = 0.3  # m
_PILLAR_SIZE = (0.5, 0.4)  # m along and across the tunnel


def place_box(site: Site, station: float, left: float, up: float, size: tuple[float, float, float]) -> trimesh.Trimesh:
    position, tangent, side, top = site.line.frames(np.array([station]))
    placement = np.eye(4)
    placement[:3, :3] = np.column_stack([tangent[0], side[0], top[0]])
    placement[:3, 3] = position[0] + left * side[0] + up * top[0]
    return trimesh.creation.box(size, transform=placement)


def add_bodies(candidate: Candidate, parts: list[trimesh.Trimesh]) -> Candidate:
    """Puts closed bodies into the bore; the air volume loses theirs."""
    solid = candidate.solid.copy()
    solid.merge_vertices(digits_vertex=6)
    taken = trimesh.boolean.difference([solid, *parts], engine="manifold", check_volume=False)
    extra = [part for part in (candidate.extra, *parts) if len(part.faces)]
    return replace(candidate, solid=taken, extra=concatenate_meshes(extra))


def _as_long_as(candidate: Candidate) -> int:
    """Return how many times `EACH` m a tunnel is long, at least 1."""
    return max(1, round(candidate.length / EACH))


def _middles(candidate: Candidate) -> list[float]:
    count = _as_long_as(candidate)
    return [float(candidate.length * (k + 0.5) / count) for k in range(count)]


@fault_kind("box", "a cube on the wall that is not there", "m", signed=False,
            sides=(0.0, np.pi, np.pi / 4, 3 * np.pi / 4))  # fmt: skip
def add_box(site: Site, fault: Fault) -> Candidate:
    bore, station = site.candidate.bore, (fault.start or 0.0) + 0.5 * fault.length
    row = int(np.clip(np.searchsorted(bore.station, station), 0, len(bore.station) - 1))
    column = int(np.argmin(np.abs(np.angle(np.exp(1j * (bore.angle - fault.side))))))
    reach = bore.radius[row, column] - 0.5 * fault.size
    left, up = reach * np.cos(fault.side), reach * np.sin(fault.side)
    return add_bodies(site.candidate, [place_box(site, station, left, up, (fault.size,) * 3)])


@fault_kind("obstacle", "a cube on the track in the middle of every 36 m", "m", signed=False)
def add_obstacles(site: Site, fault: Fault) -> Candidate:
    low = -0.5 * float(np.median(site.candidate.bore.height))
    size = (fault.size,) * 3
    boxes = [place_box(site, at, 0.0, low + 0.1 + 0.5 * fault.size, size) for at in _middles(site.candidate)]
    return add_bodies(site.candidate, boxes)


@fault_kind("barrier", "walls across the section in every 36 m", "count", signed=False)
def add_barriers(site: Site, fault: Fault) -> Candidate:
    bore = site.candidate.bore
    size = (_WALL_THICKNESS, float(bore.width.max()) + 0.5, float(bore.height.max()) + 0.5)
    return add_bodies(site.candidate, [place_box(site, at, 0.0, 0.0, size) for at in _middles(site.candidate)])


@fault_kind("debris", "floating blobs in every 36 m", "count", signed=False)
def add_debris(site: Site, fault: Fault) -> Candidate:
    count = int(fault.size) * _as_long_as(site.candidate)
    station = site.rng.uniform(1.0, site.candidate.length - 1.0, count)
    local = np.column_stack([station, site.rng.uniform(-1.5, 1.5, count), site.rng.uniform(-1.0, 1.5, count)])
    parts = []
    for middle in site.line.point(local):
        blob = trimesh.creation.icosphere(subdivisions=1, radius=_DEBRIS_RADIUS)
        blob.apply_translation(middle)
        parts.append(blob)
    return add_bodies(site.candidate, parts)


@fault_kind("pillars", "pillars beside the track, so far apart", "m", signed=False)
def add_pillars(site: Site, fault: Fault) -> Candidate:
    """Puts pillars beside the track, floor to crown, as landmarks that are not there."""
    bore, length = site.candidate.bore, site.candidate.length
    stations = np.arange(0.5 * min(fault.size, length), length - 1.0, fault.size)
    aside, height = 0.36 * float(np.median(bore.width)), float(np.median(bore.height))
    return add_bodies(site.candidate, [place_box(site, s, aside, 0.0, (*_PILLAR_SIZE, height)) for s in stations])


@fault_kind("mouth", "mouth closed by an end wall", signed=False)
def close_mouth(site: Site, fault: Fault) -> Candidate:
    lining, bore = site.candidate.lining.copy(), site.candidate.bore
    lining.merge_vertices(digits_vertex=6)
    edges, count, _ = count_edges(lining)
    rim = edges[count == 1]
    middle = lining.vertices[rim].mean(axis=1)
    near = np.abs((middle - bore.position[-1]) @ bore.tangent[-1]) < 0.3
    near &= np.linalg.norm(middle - bore.position[-1], axis=1) < 2.0 * float(bore.radius[-1].max())
    fan = np.column_stack([rim[near], np.full(int(near.sum()), len(lining.vertices))])
    vertices = np.vstack([lining.vertices, bore.position[-1]])
    corner = vertices[fan]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    fan = np.where((normal @ bore.tangent[-1] < 0)[:, None], fan, fan[:, ::-1])
    walled = trimesh.Trimesh(vertices, np.vstack([lining.faces, fan]), process=False)
    return replace(site.candidate, lining=walled)
