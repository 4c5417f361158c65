"""Distances in the plane between points, rays and walls, on the host."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

_PIECE = 1.0  # m, longest piece of a wall that is compared with points at once
_BESIDE = 50.0  # m from the rays to the walls that are tried first
_CHUNK = 256  # rays at a time, against memory


def distance_to_segment(
    point: Float[np.ndarray, "*n 2"], middle: Float[np.ndarray, "*m 2"], half: Float[np.ndarray, "*m 2"]
) -> Float[np.ndarray, "*nm"]:
    """Return the distance from points to segments `middle ± half`, m; the shapes broadcast."""
    from_x, from_y = point[..., 0] - middle[..., 0], point[..., 1] - middle[..., 1]
    half_x, half_y = half[..., 0], half[..., 1]
    along = (from_x * half_x + from_y * half_y) / np.maximum(half_x * half_x + half_y * half_y, 1e-12)
    along = np.clip(along, -1.0, 1.0)
    off_x, off_y = from_x - along * half_x, from_y - along * half_y
    return np.sqrt(off_x * off_x + off_y * off_y)


def crossings(
    origin: Float[np.ndarray, "n 2"], direction: Float[np.ndarray, "n 2"], vertex: Float[np.ndarray, "k 2"]
) -> Float[np.ndarray, " n"]:
    """Return the distance along each ray to a polyline, m; `inf` where it is not met."""
    start, edge = vertex[:-1], np.diff(vertex, axis=0)
    low, high = np.minimum(vertex[:-1], vertex[1:]), np.maximum(vertex[:-1], vertex[1:])
    distance = np.empty(len(origin))
    for first in range(0, len(origin), _CHUNK):
        rows = slice(first, first + _CHUNK)
        here, ahead = origin[rows], direction[rows]
        # What is not beside these rays is further away than `_BESIDE`, and only rays that go on so far may meet it.
        beside = np.all((high >= here.min(axis=0) - _BESIDE) & (low <= here.max(axis=0) + _BESIDE), axis=1)
        found = _nearest_hits(here, ahead, start[beside], edge[beside])
        if len(far := np.flatnonzero(~(found <= _BESIDE))):
            found[far] = _nearest_hits(here[far], ahead[far], start, edge)
        distance[rows] = found
    return distance


def _nearest_hits(
    origin: Float[np.ndarray, "n 2"],
    direction: Float[np.ndarray, "n 2"],
    start: Float[np.ndarray, "k 2"],
    edge: Float[np.ndarray, "k 2"],
) -> Float[np.ndarray, " n"]:
    """Return the distance along each ray to the nearest of some segments, m; `inf` where it meets none."""
    d_x, d_y = direction[:, :1], direction[:, 1:]
    g_x, g_y = start[:, 0] - origin[:, :1], start[:, 1] - origin[:, 1:]
    size = d_x * edge[:, 1] - d_y * edge[:, 0]
    safe = np.where(np.abs(size) < 1e-12, 1.0, size)
    along, fraction = (g_x * edge[:, 1] - g_y * edge[:, 0]) / safe, (g_x * d_y - g_y * d_x) / safe
    meets = (np.abs(size) >= 1e-12) & (fraction >= -1e-9) & (fraction <= 1.0 + 1e-9) & (along >= 0.0)
    return np.where(meets, along, np.inf).min(axis=1, initial=np.inf)


def gaps_near(nodes: Any, segments: Float[np.ndarray, "s 4"], reach: float) -> Float[np.ndarray, " n"]:
    """Return the distance from each node of a KD tree to the nearest segment, m.

    It is exact up to `reach`; a node further from all segments has a larger number, or `inf`. Long segments are cut
    into pieces, each compared with the nodes beside it alone: every node with every segment takes minutes in 20 km.
    """
    along = segments[:, 2:] - segments[:, :2]
    count = np.maximum(1, np.ceil(np.linalg.norm(along, axis=1) / _PIECE)).astype(int)
    of = np.repeat(np.arange(len(segments)), count)
    number = np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
    half = 0.5 * along[of] / count[of, None]
    middle = segments[of, :2] + (2 * number + 1)[:, None] * half
    near = nodes.query_ball_point(middle, reach + 0.5 * _PIECE)
    piece = np.repeat(np.arange(len(of)), [len(row) for row in near])
    node = np.concatenate([np.zeros(0, int), *(row for row in near if row)]).astype(int)
    gap = np.full(nodes.n, np.inf)
    np.minimum.at(gap, node, distance_to_segment(nodes.data[node], middle[piece], half[piece]))
    return gap
