"""Meshes of many bodies: joined, taken apart, each moved by itself."""

from collections.abc import Callable

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def concatenate_meshes(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Joins several meshes; without any, return an empty one."""
    if not meshes:
        return trimesh.Trimesh()
    before = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return trimesh.Trimesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, before, strict=False)]),
        process=False,
    )


def without_faces(mesh: trimesh.Trimesh, gone: Bool[np.ndarray, " f"]) -> trimesh.Trimesh:
    """Removes some faces, and the vertices that no face uses then."""
    left = trimesh.Trimesh(mesh.vertices, mesh.faces[~gone], process=False)
    left.remove_unreferenced_vertices()
    return left


def connected_groups(count: int, pairs: Int[np.ndarray, "k 2"]) -> Int[np.ndarray, " count"]:
    """Return the number of the group of each of `count` things; those of a pair belong together."""
    graph = coo_array((np.ones(len(pairs), bool), tuple(pairs.T)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


def count_edges(
    mesh: trimesh.Trimesh,
) -> tuple[Int[np.ndarray, "e 2"], Int[np.ndarray, " e"], Int[np.ndarray, " k"]]:
    """Return the vertex numbers of each edge, in order, its faces, and the edge of each row of `edges_sorted`."""
    size = max(len(mesh.vertices), 1)  # as numbers, edges are sorted ten times as fast
    key, edge, count = np.unique(mesh.edges_sorted @ [size, 1], return_inverse=True, return_counts=True)
    return np.column_stack(np.divmod(key, size)), count, edge


def find_bodies(mesh: trimesh.Trimesh) -> tuple[Int[np.ndarray, " v"], Float[np.ndarray, "b 3"]]:
    """Return the number of the body of each vertex, and the middle of each body, m."""
    count = len(mesh.vertices)
    if not count:
        return np.zeros(0, int), np.zeros((0, 3))
    welded = np.unique(np.round(mesh.vertices, 6), axis=0, return_inverse=True)[1].ravel()
    pairs = welded[mesh.faces[:, [[0, 1], [0, 2]]].reshape(-1, 2)]
    label = np.unique(connected_groups(count, pairs)[welded], return_inverse=True)[1]
    size = np.maximum(np.bincount(label), 1)[:, None]
    return label, np.stack([np.bincount(label, axis) for axis in mesh.vertices.T], axis=1) / size


def keep_bodies(
    mesh: trimesh.Trimesh, keep: Callable[[Float[np.ndarray, "b 3"]], Bool[np.ndarray, " b"]]
) -> trimesh.Trimesh:
    if not len(mesh.faces):
        return mesh
    label, middle = find_bodies(mesh)
    return without_faces(mesh, ~keep(middle)[label[mesh.faces[:, 0]]])


def move_bodies(
    mesh: trimesh.Trimesh, shift: Callable[[Float[np.ndarray, "b 3"]], Float[np.ndarray, "b 3"]]
) -> trimesh.Trimesh:
    if not len(mesh.faces):
        return mesh
    label, middle = find_bodies(mesh)
    return trimesh.Trimesh(mesh.vertices + shift(middle)[label], mesh.faces, process=False)
