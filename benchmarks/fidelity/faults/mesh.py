"""Faults of the meshes themselves: holes, flipped, doubled and sliver faces, fins, noise, too few triangles."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pymeshlab
import trimesh
from scipy.spatial import cKDTree

from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.faults.kinds import Fault, Site, fault_kind
from benchmarks.fidelity.faults.scene import drop_scene_faces
from benchmarks.fidelity.meshes import concatenate_meshes, without_faces

_SAME = 1e-6  # m between a vertex of the lining and its twin in the solid
_FIN_HEIGHT = 0.6  # m that a fin stands into the bore
_SLIVER = 1e-4


def change_both(candidate: Candidate, change: Callable[[trimesh.Trimesh], trimesh.Trimesh]) -> Candidate:
    """Changes lining and solid alike."""
    return replace(candidate, lining=change(candidate.lining), solid=change(candidate.solid))


@fault_kind("holes", "share of the faces missing, of the released scene too", signed=False)
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


@fault_kind("flipped", "share of the faces wound the wrong way", signed=False)
def flip_faces(site: Site, fault: Fault) -> Candidate:
    """Winds faces the wrong way; 1 flips all."""

    def wrong(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        turned = site.rng.random(len(mesh.faces)) < fault.size
        return trimesh.Trimesh(mesh.vertices, np.where(turned[:, None], mesh.faces[:, ::-1], mesh.faces), process=False)

    return change_both(site.candidate, wrong)


@fault_kind("doubled", "share of the faces that stand twice, with as many slivers", signed=False)
def double_faces(site: Site, fault: Fault) -> Candidate:
    """Repeats faces, and adds as many slivers along edges."""

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


@fault_kind("coarse", "share of the faces that smoothing and decimation take", signed=False)
def coarsen(site: Site, fault: Fault) -> Candidate:
    """Smooths (Laplace, the more the larger the share) and then reduces the number of faces."""
    share = fault.size

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

    return change_both(site.candidate, smooth)
