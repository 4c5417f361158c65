"""Meshes made of many bodies: which there are, some taken out, each moved by itself."""

from collections.abc import Callable

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def bodies(mesh: trimesh.Trimesh) -> tuple[Int[np.ndarray, " v"], Float[np.ndarray, "b 3"]]:
    """Number of the body of each vertex, and the middle of each body, m."""
    count = len(mesh.vertices)
    if not count:
        return np.zeros(0, int), np.zeros((0, 3))
    welded = np.unique(np.round(mesh.vertices, 6), axis=0, return_inverse=True)[1].ravel()
    first, second = welded[mesh.faces[:, [0, 0]].ravel()], welded[mesh.faces[:, [1, 2]].ravel()]
    graph = coo_array((np.ones(len(first), bool), (first, second)), shape=(count, count))
    label = np.unique(connected_components(graph, directed=False)[1][welded], return_inverse=True)[1]
    size = np.maximum(np.bincount(label), 1)[:, None]
    return label, np.stack([np.bincount(label, axis) for axis in mesh.vertices.T], axis=1) / size


def cut_components(
    mesh: trimesh.Trimesh, keep: Callable[[Float[np.ndarray, "b 3"]], Bool[np.ndarray, " b"]]
) -> trimesh.Trimesh:
    """The bodies whose middle is to be kept."""
    if not len(mesh.faces):
        return mesh
    label, middle = bodies(mesh)
    return without_faces(mesh, ~keep(middle)[label[mesh.faces[:, 0]]])


def moved_components(
    mesh: trimesh.Trimesh, shift: Callable[[Float[np.ndarray, "b 3"]], Float[np.ndarray, "b 3"]]
) -> trimesh.Trimesh:
    """Each body moved by what is asked for its middle."""
    if not len(mesh.faces):
        return mesh
    label, middle = bodies(mesh)
    return trimesh.Trimesh(mesh.vertices + shift(middle)[label], mesh.faces, process=False)


def without_faces(mesh: trimesh.Trimesh, gone: Bool[np.ndarray, " f"]) -> trimesh.Trimesh:
    """The mesh less some faces; vertices that no face uses go too."""
    left = trimesh.Trimesh(mesh.vertices, mesh.faces[~gone], process=False)
    left.remove_unreferenced_vertices()
    return left
