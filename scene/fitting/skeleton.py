"""A first guess of the axis from distances along the surface: no orientation or straightness is assumed."""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from scene.errors import FitError
from scene.fitting.branches import require_one_bore

VOXEL = 0.5
_NEIGHBOURS = (1.2, 1.8, 2.6, 3.8)  # m; profiles may be apart, surveys have gaps
_MIN_JOINED = 0.95
_PART = 0.02  # of the nodes: a smaller part is clutter
_LONGEST_GAP = 12.0  # m
_RIM = 0.5  # m
_SLICE = 1.5
_TILTED = 3


def skeleton(
    points: Float[np.ndarray, "n 3"], min_length: float, origin: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "k 3"]:
    """Centres of slices across the surface distance from end to end, m.

    Args:
        points: Registered cloud, m.
        min_length: A shorter one is refused, m.
        origin: Of the points' frame in the input's, m, for the error message.

    Raises:
        FitError: Too short, without two ends, or with a branch or a room.
    """
    cells = np.unique(np.floor(points / VOXEL).astype(np.int64), axis=0)
    nodes = (cells + 0.5) * VOXEL
    extent = 2 * float(np.linalg.norm(nodes[:, :2] - nodes[:, :2].mean(axis=0), axis=1).max())
    if extent < min_length:
        raise FitError(f"the tunnel is at most {extent:.1f} m long; at least {min_length:g} m are needed")
    graph, nodes = _surface_graph(nodes)

    def distances(start: int) -> np.ndarray:
        return dijkstra(graph, directed=False, indices=start)

    from_start = distances(int(np.argmax(distances(0))))
    from_end = distances(int(np.argmax(from_start)))
    along = (from_start - from_end) / 2  # the half difference is square to the axis where one distance alone is tilted
    if np.ptp(along) < min_length:
        raise FitError(f"the tunnel is {np.ptp(along):.1f} m long; at least {min_length:g} m are needed")
    own = require_one_bore(nodes, along - along.min(), _SLICE, VOXEL, origin)
    nodes, along = nodes[own], along[own]
    index = np.floor((along - along.min()) / _SLICE).astype(np.intp)
    count = np.bincount(index)
    centres = np.stack([np.bincount(index, nodes[:, axis]) / np.maximum(count, 1) for axis in range(3)], axis=1)
    full = count > 0.4 * np.median(count)
    if full.sum() < 6:
        raise FitError("no tunnel in the cloud: its surface has no two ends")
    # The last slices are tilted: at a mouth the surface distances still fan out from one point.
    trimmed = centres[full]
    return trimmed[_TILTED:-_TILTED] if len(trimmed) >= 4 * _TILTED else trimmed[1:-1]


def _surface_graph(nodes: Float[np.ndarray, "k 3"]) -> tuple[csr_matrix, Float[np.ndarray, "j 3"]]:
    """Nodes within reach of each other, joined; the reach grows until nearly all hang together, then gaps are bridged.

    What is still apart from the largest part, further than the longest gap, is left out.
    """
    for reach in _NEIGHBOURS:
        pairs = cKDTree(nodes).query_pairs(reach, output_type="ndarray")
        labels = connected_components(_graph(nodes, pairs), directed=False)[1]
        if np.bincount(labels).max() >= _MIN_JOINED * len(nodes):
            break
    graph = _graph(nodes, np.concatenate([pairs, *_bridges(nodes, labels)]))
    labels = connected_components(graph, directed=False)[1]
    largest = np.flatnonzero(labels == np.bincount(labels).argmax())
    return graph[largest][:, largest], nodes[largest]


def _graph(nodes: np.ndarray, pairs: Int[np.ndarray, "e 2"]) -> csr_matrix:
    lengths = np.linalg.norm(nodes[pairs[:, 0]] - nodes[pairs[:, 1]], axis=1)
    return csr_matrix((lengths, (pairs[:, 0], pairs[:, 1])), shape=(len(nodes), len(nodes)))


def _bridges(nodes: np.ndarray, labels: np.ndarray) -> list[np.ndarray]:
    """Pairs of nodes across each gap between large parts: all nearly as close as the closest, so all around the rim."""
    count = np.bincount(labels)
    parts = [np.flatnonzero(labels == label) for label in np.flatnonzero(count > _PART * len(nodes))]
    result = []
    for k, part in enumerate(parts):
        for other in parts[k + 1 :]:
            distance, nearest = cKDTree(nodes[other]).query(nodes[part], distance_upper_bound=_LONGEST_GAP)
            close = distance < distance.min() + _RIM
            if np.isfinite(distance.min()):
                result.append(np.stack([part[close], other[nearest[close]]], axis=1))
    return result
