"""Controls of the mesh itself: holes, flipped, doubled and crossing faces, noise, over-smoothing."""

from dataclasses import replace

import numpy as np
import pymeshlab
import trimesh
from scipy.spatial import cKDTree

from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.compiled import concatenated
from benchmarks.fidelity.controls.parts import without_faces

_SAME = 1e-6  # m between a vertex of the lining and its twin in the solid
_FIN = 0.6  # m that a fin stands into the bore
_SLIVER = 1e-4


def both(candidate: Candidate, change) -> Candidate:
    """Lining and solid changed alike."""
    return replace(candidate, lining=change(candidate.lining), solid=change(candidate.solid))


def faces_dropped(candidate: Candidate, share: float, rng: np.random.Generator) -> Candidate:
    """Random faces missing."""
    return both(candidate, lambda mesh: without_faces(mesh, rng.random(len(mesh.faces)) < share))


def holed(candidate: Candidate, area: float, rng: np.random.Generator) -> Candidate:
    """One round hole in a wall, m²."""
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

    return both(candidate, pierced)


def flipped(candidate: Candidate, share: float, rng: np.random.Generator) -> Candidate:
    """Faces wound the wrong way; a share of 1 flips all."""

    def wrong(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        turned = rng.random(len(mesh.faces)) < share
        return trimesh.Trimesh(mesh.vertices, np.where(turned[:, None], mesh.faces[:, ::-1], mesh.faces), process=False)

    return both(candidate, wrong)


def doubled(candidate: Candidate, share: float, rng: np.random.Generator) -> Candidate:
    """Faces there twice, and as many slivers along edges."""

    def worse(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        pick = rng.permutation(len(mesh.faces))[: max(int(share * len(mesh.faces)), 1)]
        corner = mesh.triangles[pick]
        thin = corner.copy()
        thin[:, 2] = corner[:, 0] + 0.5 * (corner[:, 1] - corner[:, 0]) + _SLIVER * (corner[:, 2] - corner[:, 0])
        slivers = trimesh.Trimesh(thin.reshape(-1, 3), np.arange(3 * len(pick)).reshape(-1, 3), process=False)
        return concatenated(
            [trimesh.Trimesh(mesh.vertices, np.vstack([mesh.faces, mesh.faces[pick]]), process=False), slivers]
        )

    return both(candidate, worse)


def finned(candidate: Candidate, count: int, rng: np.random.Generator) -> Candidate:
    """Fins on edges of the wall, so that three faces share an edge; each pierces the wall behind it."""

    def fin(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        pick = rng.permutation(len(mesh.faces))[:count]
        edge = mesh.faces[pick][:, :2]
        middle = mesh.vertices[edge].mean(axis=1)
        inward, outward = middle + _FIN * mesh.face_normals[pick], middle - _FIN * mesh.face_normals[pick]
        slanted = 0.3 * np.roll(mesh.face_normals[pick], 1, axis=1)
        first = len(mesh.vertices) + np.arange(2 * count)
        faces = [mesh.faces, np.column_stack([edge, first[:count]]), np.column_stack([edge, first[count:]])]
        return trimesh.Trimesh(
            np.vstack([mesh.vertices, inward + slanted, outward + slanted]), np.vstack(faces), process=False
        )

    return both(candidate, fin)


def noisy(candidate: Candidate, sigma: float, rng: np.random.Generator) -> Candidate:
    """Every vertex displaced at random, m; twins in lining and solid alike."""
    solid = trimesh.Trimesh(candidate.solid.vertices, candidate.solid.faces, process=False)
    offset = rng.normal(0.0, sigma, solid.vertices.shape)
    distance, twin = cKDTree(candidate.solid.vertices).query(candidate.lining.vertices)
    own = rng.normal(0.0, sigma, candidate.lining.vertices.shape)
    moved = candidate.lining.vertices + np.where((distance < _SAME)[:, None], offset[twin], own)
    lining = trimesh.Trimesh(moved, candidate.lining.faces, process=False)
    return replace(candidate, lining=lining, solid=trimesh.Trimesh(solid.vertices + offset, solid.faces, process=False))


def coarsened(candidate: Candidate, share: float) -> Candidate:
    """Smoothed (Laplace, the more the larger the share) and then left with fewer faces."""

    def smooth(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        origin = mesh.vertices.mean(axis=0)
        work = pymeshlab.MeshSet()
        work.add_mesh(pymeshlab.Mesh(mesh.vertices - origin, mesh.faces))
        work.meshing_merge_close_vertices(threshold=pymeshlab.PureValue(_SAME))
        work.apply_coord_laplacian_smoothing(stepsmoothnum=max(int(10 * share), 1), boundary=True)
        work.meshing_decimation_quadric_edge_collapse(
            targetfacenum=int((1.0 - share) * len(mesh.faces)), preserveboundary=True, preservenormal=True
        )
        made = work.current_mesh()
        return trimesh.Trimesh(made.vertex_matrix() + origin, made.face_matrix(), process=False)

    return both(candidate, smooth)
