"""Welded meshes of lining and solid, and the topology of the space inside."""

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_closing, distance_transform_edt, label
from trimesh.ray.ray_pyembree import RayMeshIntersector

from benchmarks.fidelity.case import Case, kept_until, per_case, per_reference
from benchmarks.fidelity.derive.axis import hold_curve
from benchmarks.fidelity.derive.curve import Curve, candidate_curve, interpolate_rows, truth_curve
from benchmarks.fidelity.derive.surface import sample_surface, surface_caster, visible_surface
from benchmarks.fidelity.meshes import connected_groups, count_edges

_WELD_DIGITS = 6  # a format with float32 keeps corners together and moves them by less
_MOUTH_RIM = 0.15  # m from the plane of a mouth: its rim need not be cut straight
_AXIS_RAYS = 60_000


@dataclass(frozen=True)
class Edges:
    """Undirected edges of a welded mesh."""

    ends: Int[np.ndarray, "e 2"]  # Vertex numbers
    faces: Int[np.ndarray, " e"]  # Number of faces at the edge
    length: Float[np.ndarray, " e"]  # m


def weld(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a copy in which corners at one place are one vertex, about a whole-metre origin."""
    if not is_sound(mesh):
        raise ValueError("vertices are not finite or faces name none")
    origin = np.floor(mesh.vertices.mean(axis=0)) if len(mesh.vertices) else np.zeros(3)
    copy = trimesh.Trimesh(np.asarray(mesh.vertices) - origin, np.asarray(mesh.faces), process=False)
    copy.merge_vertices(digits_vertex=_WELD_DIGITS)
    return copy


def is_sound(mesh: trimesh.Trimesh) -> bool:
    """Return True where all vertices are finite and all faces name existing vertices."""
    faces = np.asarray(mesh.faces)
    in_range = not len(faces) or (faces.min() >= 0 and faces.max() < len(mesh.vertices))
    return bool(np.isfinite(np.asarray(mesh.vertices)).all() and in_range)


def mesh_edges(mesh: trimesh.Trimesh) -> Edges:
    ends, count, _ = count_edges(mesh)
    return Edges(ends, count, np.linalg.norm(mesh.vertices[ends[:, 0]] - mesh.vertices[ends[:, 1]], axis=1))


@kept_until("TOP", per_case)
def welded_lining(case: Case) -> trimesh.Trimesh:
    return weld(case.candidate.lining)


@kept_until("TOP", per_case)
def welded_solid(case: Case) -> trimesh.Trimesh:
    return weld(case.candidate.solid)


@kept_until("TOP", per_case)
def lining_edges(case: Case) -> Edges:
    return mesh_edges(welded_lining(case))


def weld_offset(case: Case) -> Float[np.ndarray, "3"]:
    """Return the origin that `weld` subtracts from the lining, m."""
    return np.floor(case.candidate.lining.vertices.mean(axis=0))


def mouth_vertices(case: Case) -> Bool[np.ndarray, " v"]:
    """Return True for vertices of the welded lining in the plane of a declared mouth."""
    bore, vertices = case.candidate.bore, welded_lining(case).vertices + weld_offset(case)
    flush = np.zeros(len(vertices), bool)
    for end in (0, -1):
        away = vertices - bore.position[end]
        near = np.linalg.norm(away, axis=1) < 2.0 * bore.radius[end].max()
        flush |= near & (np.abs(away @ bore.tangent[end]) < _MOUTH_RIM)
    return flush


def face_parts(mesh: trimesh.Trimesh) -> Int[np.ndarray, " f"]:
    """Return the number of the component of each face; faces that share an edge belong together."""
    ends, _, edge = count_edges(mesh)
    count = len(mesh.faces)
    face = mesh.edges_face
    group = connected_groups(count + len(ends), np.column_stack([face, count + edge]))
    return np.unique(group[:count], return_inverse=True)[1]


@dataclass(frozen=True)
class AxisHits:
    """First hits of rays from the axis."""

    origin: Float[np.ndarray, "k 3"]  # m, less `weld_offset`
    direction: Float[np.ndarray, "k 3"]  # Unit vectors
    distance: Float[np.ndarray, " k"]  # m; `inf` where nothing was hit
    # Cosine between ray and normal of the face; negative where the face looks at the eye
    cosine: Float[np.ndarray, " k"]


@kept_until("TOP", per_case)
def axis_hits(case: Case) -> AxisHits:
    """Casts rays in random directions from random places of the axis, into the lining alone."""
    bore, rng = case.candidate.bore, case.rng("axis_hits")
    station = rng.uniform(bore.station[0] + 0.2, bore.station[-1] - 0.2, _AXIS_RAYS)
    middle = interpolate_rows(station, bore.station, bore.position)
    direction = rng.normal(size=(_AXIS_RAYS, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin, mesh = middle - weld_offset(case), welded_lining(case)
    face, distance = first_hits(mesh, origin, direction)
    cosine = np.where(face >= 0, np.einsum("ij,ij->i", mesh.face_normals[face], direction), 0.0)
    return AxisHits(origin, direction, distance, cosine)


def first_hits(
    mesh: trimesh.Trimesh, origin: Float[np.ndarray, "k 3"], direction: Float[np.ndarray, "k 3"]
) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Return the face that each ray meets first (-1 for none) and its distance, m, exact in the plane of the face."""
    caster = RayMeshIntersector(mesh, scale_to_box=False)
    face = np.asarray(caster.intersects_first(origin, direction), np.int64)
    normal = mesh.face_normals[face]
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.einsum("ij,ij->i", mesh.triangles[face, 0] - origin, normal)
        distance = reach / np.einsum("ij,ij->i", direction, normal)
    return face, np.where(face >= 0, distance, np.inf)


# Free space on a grid along a curve, and the persistence of its clearance.

_GRID_CELL = (0.5, 0.25, 0.25)  # m along, left, up
_SAMPLE_SPACING = 0.10  # m between samples of a surface
_GRID_PAD = 0.3  # m beyond the walls; more would give leaks room to loop in
_LEAST_PERSISTENCE = 0.05  # m; pairs of less persistence are the grid's
_FLOOD_HALF = 0.5  # m about the curve, in which the flood starts
Diagrams = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Grid:
    """Box along a curve."""

    curve: Curve  # Curve of the box
    cell: Float[np.ndarray, "3"]  # Sizes along, left and up, m
    low: Float[np.ndarray, "3"]  # Station, left and up of its first corner, m
    shape: tuple[int, int, int]  # Cells each way

    def occupied(self, points: Float[np.ndarray, "k 3"]) -> Bool[np.ndarray, "a b c"]:
        """Return True for cells with a point in them; points outside the box are left out."""
        cells = np.zeros(self.shape, bool)
        index = np.floor((self.curve.local(points) - self.low) / self.cell).astype(int)
        cells[tuple(index[((index >= 0) & (index < self.shape)).all(axis=1)].T)] = True
        return cells

    def on_curve(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        middle = np.floor((0.0 - self.low[1:]) / self.cell[1:]).astype(int)
        along = np.arange(self.shape[0])
        return along, np.full_like(along, middle[0]), np.full_like(along, middle[1])

    def clearance(self, occupied: Bool[np.ndarray, "a b c"]) -> Float[np.ndarray, "a b c"]:
        """Return the distance to the bounds of the space about the curve, m; 0 outside it. The mouths are open."""
        number, _ = label(~occupied)
        _, left, up = self.on_curve()
        reach = np.ceil(_FLOOD_HALF / self.cell[1:]).astype(int)
        tube = number[:, left[0] - reach[0] : left[0] + reach[0] + 1, up[0] - reach[1] : up[0] + reach[1] + 1]
        free = np.isin(number, np.setdiff1d(np.unique(tube), [0]))
        return distance_transform_edt(free, sampling=self.cell)


def _make_grid(case: Case, curve: Curve, points: Float[np.ndarray, "k 3"]) -> Grid:
    cell = np.asarray(_GRID_CELL)
    across = np.abs(curve.local(points[::10])[:, 1:])
    half = np.percentile(across, 99.9, axis=0) + _GRID_PAD
    low = np.array([curve.station[0], *-half])
    shape = np.ceil(np.array([curve.length, *2 * half]) / cell).astype(int)
    return Grid(curve, cell, low, (int(shape[0]), int(shape[1]), int(shape[2])))


@kept_until("TOP", per_case)
def surface_samples(case: Case) -> Float[np.ndarray, "k 3"]:
    return sample_surface(visible_surface(case), _SAMPLE_SPACING)[0]


@kept_until("TOP", per_reference)
def _reference_samples(case: Case) -> Float[np.ndarray, "k 3"]:
    if case.truth is not None:
        return sample_surface(case.truth.surface, _SAMPLE_SPACING)[0]
    assert case.hold is not None
    return case.hold.points


@per_case
def free_components(case: Case) -> tuple[int, int]:
    """Count the components of free space along the candidate's centreline, and its free cells."""
    import cc3d

    curve = candidate_curve(case)
    grid = _make_grid(case, curve, surface_samples(case))
    number = cc3d.connected_components(~grid.occupied(surface_samples(case)), connectivity=6)
    ends = 1  # a mouth's own cell is cut by its rim
    numbers = number[grid.on_curve()][ends:-ends]
    return len(np.setdiff1d(np.unique(numbers), [0])), int((numbers > 0).sum())


@per_reference
def _reference_grid(case: Case) -> Grid:
    curve = truth_curve(case) if case.truth is not None else hold_curve(case)
    return _make_grid(case, curve, _reference_samples(case))


@per_reference
def reference_diagrams(case: Case) -> Diagrams:
    """Return the persistence of the true clearance, or of that which the held-out returns leave."""
    return _diagrams(case, _reference_samples(case))


@per_case
def candidate_diagrams(case: Case) -> Diagrams:
    """Return the persistence of the candidate's clearance, sampled as the reference is."""
    if case.truth is not None:
        return _diagrams(case, surface_samples(case))
    hold = case.hold
    assert hold is not None
    distance = surface_caster(case).first(hold.origin, hold.direction)[0]
    hit = np.isfinite(distance) & hold.returned
    distance = distance[hit] + hold.sigma * case.rng("clearance").normal(size=int(hit.sum()))
    return _diagrams(case, hold.origin[hit] + distance[:, None] * hold.direction[hit])


def _diagrams(case: Case, points: Float[np.ndarray, "k 3"]) -> Diagrams:
    """Return the persistence of the clearance between points; gaps of one cell between the beams are closed."""
    grid = _reference_grid(case)
    occupied = grid.occupied(points)
    if case.truth is None:
        occupied = binary_closing(np.pad(occupied, 1, mode="edge"), np.ones((3, 3, 3)))[1:-1, 1:-1, 1:-1]
    return persistence_diagrams(grid.clearance(occupied))


def persistence_diagrams(clearance: Float[np.ndarray, "a b c"]) -> Diagrams:
    """Return birth and death of components, loops and voids as the clearance falls, m, `(k, 2)` each.

    Nothing lies below 0, so that a slit between two beams, however deep the wall behind it, lasts no longer than it is
    wide. Signs are turned, so that births come before deaths: the space at level t is where minus the clearance is
    below t.
    """
    import gudhi

    complex_ = gudhi.CubicalComplex(top_dimensional_cells=-clearance)
    complex_.compute_persistence(min_persistence=_LEAST_PERSISTENCE)
    zero, one, two = (np.asarray(complex_.persistence_intervals_in_dimension(k)).reshape(-1, 2) for k in range(3))
    return zero, one, two
