"""The lining and the solid welded, their edges, their components, and first hits of rays from the axis."""

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from trimesh.ray.ray_pyembree import RayMeshIntersector

from benchmarks.fidelity.case import Case, derived, until

_WELD_DIGITS = 6  # a format with float32 keeps corners together and moves them by less
_MOUTH = 0.15  # m from the plane of a mouth: its rim need not be cut straight
_RAYS = 60_000


@dataclass(frozen=True)
class Edges:
    """Undirected edges of a welded mesh.

    Attributes:
        ends: Vertex numbers, `(e, 2)`.
        faces: How many faces meet there, `(e,)`.
        length: m, `(e,)`.
    """

    ends: Int[np.ndarray, "e 2"]
    faces: Int[np.ndarray, " e"]
    length: Float[np.ndarray, " e"]


def welded(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A copy in which corners at one place are one vertex, about a whole-metre origin.

    Raises:
        ValueError: Vertices that are not finite, or faces that name none.
    """
    if not sound(mesh):
        raise ValueError("vertices are not finite or faces name none")
    origin = np.floor(mesh.vertices.mean(axis=0)) if len(mesh.vertices) else np.zeros(3)
    copy = trimesh.Trimesh(np.asarray(mesh.vertices) - origin, np.asarray(mesh.faces), process=False)
    copy.merge_vertices(digits_vertex=_WELD_DIGITS)
    return copy


def sound(mesh: trimesh.Trimesh) -> bool:
    """Whether all vertices are finite and all faces name vertices that there are."""
    faces = np.asarray(mesh.faces)
    in_range = not len(faces) or (faces.min() >= 0 and faces.max() < len(mesh.vertices))
    return bool(np.isfinite(np.asarray(mesh.vertices)).all() and in_range)


def edges(mesh: trimesh.Trimesh) -> Edges:
    """Of a welded mesh."""
    ends, count = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
    return Edges(ends, count, np.linalg.norm(mesh.vertices[ends[:, 0]] - mesh.vertices[ends[:, 1]], axis=1))


@until("TOP")
@derived
def lining(case: Case) -> trimesh.Trimesh:
    """The lining, welded."""
    return welded(case.candidate.lining)


@until("TOP")
@derived
def solid(case: Case) -> trimesh.Trimesh:
    """The solid, welded."""
    return welded(case.candidate.solid)


@until("TOP")
@derived
def lining_edges(case: Case) -> Edges:
    """Edges of the welded lining."""
    return edges(lining(case))


@until("MSH")
@derived
def solid_edges(case: Case) -> Edges:
    """Edges of the welded solid."""
    return edges(solid(case))


def offset(case: Case) -> Float[np.ndarray, "3"]:
    """What `welded` subtracted from the lining."""
    return np.floor(case.candidate.lining.vertices.mean(axis=0))


def at_mouth(case: Case) -> Bool[np.ndarray, " v"]:
    """Whether each vertex of the welded lining lies in the plane of a declared mouth."""
    bore, vertices = case.candidate.bore, lining(case).vertices + offset(case)
    flush = np.zeros(len(vertices), bool)
    for end in (0, -1):
        away = vertices - bore.position[end]
        near = np.linalg.norm(away, axis=1) < 2.0 * bore.radius[end].max()
        flush |= near & (np.abs(away @ bore.tangent[end]) < _MOUTH)
    return flush


def parts(mesh: trimesh.Trimesh) -> Int[np.ndarray, " f"]:
    """Number of the component of each face; faces that share an edge belong together."""
    ends, edge = np.unique(mesh.edges_sorted, axis=0, return_inverse=True)
    count = len(mesh.faces)
    face = mesh.edges_face
    graph = coo_array((np.ones(len(face), bool), (face, count + edge.ravel())), shape=(count + len(ends),) * 2)
    label = connected_components(graph, directed=False)[1][:count]
    return np.unique(label, return_inverse=True)[1]


@dataclass(frozen=True)
class Hits:
    """First hits of rays from the axis.

    Attributes:
        origin: m, less `offset`, `(k, 3)`.
        direction: Unit vectors, `(k, 3)`.
        distance: m; `inf` where nothing was hit, `(k,)`.
        cosine: Between the ray and the face's normal; negative where the face looks at the eye, `(k,)`.
    """

    origin: Float[np.ndarray, "k 3"]
    direction: Float[np.ndarray, "k 3"]
    distance: Float[np.ndarray, " k"]
    cosine: Float[np.ndarray, " k"]


@until("TOP")
@derived
def axis_hits(case: Case) -> Hits:
    """Rays in random directions from random places of the axis, into the lining alone."""
    bore, rng = case.candidate.bore, case.rng("axis_hits")
    station = rng.uniform(bore.station[0] + 0.2, bore.station[-1] - 0.2, _RAYS)
    middle = np.stack([np.interp(station, bore.station, axis) for axis in bore.position.T], axis=1)
    direction = rng.normal(size=(_RAYS, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin, mesh = middle - offset(case), lining(case)
    face, distance = first_hits(mesh, origin, direction)
    cosine = np.where(face >= 0, np.einsum("ij,ij->i", mesh.face_normals[face], direction), 0.0)
    return Hits(origin, direction, distance, cosine)


def first_hits(
    mesh: trimesh.Trimesh, origin: Float[np.ndarray, "k 3"], direction: Float[np.ndarray, "k 3"]
) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Face that each ray meets first (-1 for none) and how far away, m; exact in the plane that embree finds."""
    caster = RayMeshIntersector(mesh, scale_to_box=False)
    face = np.asarray(caster.intersects_first(origin, direction), np.int64)
    normal = mesh.face_normals[face]
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.einsum("ij,ij->i", mesh.triangles[face, 0] - origin, normal)
        distance = reach / np.einsum("ij,ij->i", direction, normal)
    return face, np.where(face >= 0, distance, np.inf)
