"""The visible surface of a candidate: rays into it, distances to it, samples of it."""

import numpy as np
import trimesh
from jaxtyping import Float, Int, Shaped
from scipy.spatial import cKDTree
from trimesh.ray.ray_pyembree import RayMeshIntersector

from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.case import Case, kept_until, per_case
from benchmarks.fidelity.meshes import concatenate_meshes

SAMPLE_CELL = 0.08  # m between the samples that lead to the nearest triangle
NEAREST_CANDIDATES = 8
_CHUNK = 200_000
_POINTS = 20_000  # whose distances are computed at once
_PARALLEL = 1e-12


class Caster:
    """First hits of rays in a mesh, from both sides: embree finds the triangle, float64 the place."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self.mesh = mesh
        self._offset = np.round(mesh.bounds.mean(axis=0)) if len(mesh.faces) else np.zeros(3)
        moved = trimesh.Trimesh(mesh.vertices - self._offset, mesh.faces, process=False)
        self._rays = RayMeshIntersector(moved, scale_to_box=False) if len(mesh.faces) else None

    def first(
        self, origin: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
        """Return the distance to the first hit along unit vectors, m, and the face hit; `inf` and -1 for none."""
        face, reach = np.full(len(origin), -1, np.int64), np.full(len(origin), np.inf)
        if self._rays is not None:
            for start in range(0, len(origin), _CHUNK):
                part = slice(start, start + _CHUNK)
                face[part] = self._rays.intersects_first(origin[part] - self._offset, direction[part])
                reach[part] = self._reach(origin[part], direction[part], face[part])
        return reach, face

    def _reach(
        self, origin: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "n 3"], face: Int[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """Return the distance to the plane of the face that each ray hits, m; `inf` where it hits none."""
        hit = face >= 0
        reach = np.full(len(origin), np.inf)
        corner = face_corners(self.mesh, face[hit])
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        along = np.einsum("ij,ij->i", normal, direction[hit])
        along = np.where(np.abs(along) < _PARALLEL, np.inf, along)
        gap = corner[:, 0] - origin[hit]
        reach[hit] = np.maximum(np.einsum("ij,ij->i", normal, gap) / along, 0.0)
        return reach


class Nearest:
    """Closest points of a mesh.

    A k-d tree over samples of every triangle proposes triangles, `trimesh` gives the exact closest point of each. Where
    many small triangles crowd around a large one the distance may come out up to `SAMPLE_CELL` too long, but nowhere
    too short.
    """

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self.mesh = mesh
        samples, self._face = sample_surface(mesh, SAMPLE_CELL)
        self._tree = cKDTree(samples, balanced_tree=False)

    def query(
        self, points: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
        """Return distance, m, closest point, and its face."""
        if not len(self._face):
            raise ValueError("no surface to measure distances to")
        parts = [self._query(points[start : start + _POINTS]) for start in range(0, max(len(points), 1), _POINTS)]
        distance, closest, face = (np.concatenate(column) for column in zip(*parts, strict=True))
        return distance, closest, face

    def _query(
        self, points: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
        count = min(NEAREST_CANDIDATES, len(self._face))
        proposed = self._face[self._tree.query(points, count)[1].reshape(len(points), -1)]
        best = np.full(len(points), np.inf)
        closest, face = np.zeros((len(points), 3)), np.full(len(points), -1)
        for column in range(proposed.shape[1]):
            repeated = (proposed[:, :column] == proposed[:, column, None]).any(axis=1)
            rows = np.flatnonzero(~repeated)
            near = trimesh.triangles.closest_point(face_corners(self.mesh, proposed[rows, column]), points[rows])
            distance = np.linalg.norm(near - points[rows], axis=1)
            better = distance < best[rows]
            rows = rows[better]
            best[rows], closest[rows], face[rows] = distance[better], near[better], proposed[rows, column]
        return best, closest, face


def face_corners(mesh: trimesh.Trimesh, face: Int[np.ndarray, " k"] | slice) -> Float[np.ndarray, "k 3 3"]:
    """Return the corners of some faces, m, without the cache of `mesh.triangles`, which is most of a mesh."""
    return np.asarray(mesh.vertices)[np.asarray(mesh.faces)[face]]


def face_normals(mesh: trimesh.Trimesh, face: Int[np.ndarray, " k"]) -> Float[np.ndarray, "k 3"]:
    """Return the normals of some faces, as long as twice their areas, m²."""
    return trimesh.triangles.cross(face_corners(mesh, face))


def sample_surface(mesh: trimesh.Trimesh, cell: float) -> tuple[Float[np.ndarray, "k 3"], Int[np.ndarray, " k"]]:
    """Return points on every triangle, at most about `cell` apart and at least one each, and their faces."""
    if not len(mesh.faces):
        return np.zeros((0, 3)), np.zeros(0, np.int64)
    triangles = face_corners(mesh, slice(None))
    sides = np.linalg.norm(triangles[:, [2, 0, 1]] - triangles[:, [1, 2, 0]], axis=2)  # opposite corner 0, 1, 2
    turn = (np.argmax(sides, axis=1)[:, None] + np.arange(3)) % 3
    apex, left, right = np.take_along_axis(triangles, turn[:, :, None], axis=1).transpose(1, 0, 2)
    base = np.maximum(sides.max(axis=1), 1e-12)
    height = np.linalg.norm(np.cross(left - apex, right - apex), axis=1) / base
    columns = np.maximum(np.ceil(base / cell), 1).astype(int)
    rows = np.maximum(np.ceil(height / cell), 1).astype(int)
    face = np.repeat(np.arange(len(triangles)), columns * rows)
    place = np.arange(len(face)) - np.repeat(np.cumsum(columns * rows) - columns * rows, columns * rows)
    down = (place // columns[face] + 0.5) / rows[face]
    across = (place % columns[face] + 0.5) / columns[face]
    foot = left[face] + across[:, None] * (right - left)[face]
    return apex[face] + down[:, None] * (foot - apex[face]), face


def visible_mesh(candidate: Candidate) -> trimesh.Trimesh:
    """Return everything that a sensor can see of a candidate: lining, nails, track, bed, extra surfaces."""
    return concatenate_meshes([part for part in visible_bodies(candidate).values() if len(part.faces)])


def visible_parts(candidate: Candidate) -> Shaped[np.ndarray, " f"]:
    """Return the name of the part that each face of `visible_mesh` belongs to."""
    parts = visible_bodies(candidate)
    return np.repeat(list(parts), [len(part.faces) for part in parts.values()])


def visible_bodies(candidate: Candidate) -> dict[str, trimesh.Trimesh]:
    """Return the meshes of what a sensor can see of a candidate, by part; some may be empty."""
    track = candidate.track
    return {
        "lining": candidate.lining, "sleeper": track.sleeper_mesh, "rail": track.rail_mesh,
        "fastening": track.fastening_mesh, "extra": candidate.extra, "nail": candidate.nails, "bed": candidate.bed,
    }  # fmt: skip


@kept_until("NAV", per_case)
def visible_surface(case: Case) -> trimesh.Trimesh:
    return visible_mesh(case.candidate)


@kept_until("NAV", per_case)
def surface_caster(case: Case) -> Caster:
    return Caster(visible_surface(case))


@kept_until("BEA", per_case)  # F3D and SCN make it anew: 0.2 GiB of 351 m
def surface_nearest(case: Case) -> Nearest:
    return Nearest(visible_surface(case))


def cell_numbers(points: Float[np.ndarray, "n 3"], edge: float) -> Int[np.ndarray, " n"]:
    """Return a whole number for the cube that each point lies in."""
    index = np.floor(points / edge).astype(np.int64) + (1 << 20)
    return (index[:, 0] << 42) | (index[:, 1] << 21) | index[:, 2]
