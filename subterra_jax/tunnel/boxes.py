"""Thin boxes around many short pieces of wall at once.

A piece is a row of `k` vertices, padded with its last one. Its box does not depend on the other pieces.
"""

import numpy as np
from jaxtyping import Float, Int

# Boxes are larger than their walls by this, m, so that rounding on the device cannot move a wall out of its box.
BOX_MARGIN = 1e-5
# A robot never brings its LiDAR nearer to a wall than this: footprint radius less the motion of one step, m.
LIDAR_GAP = 0.2
_REPEATED = 1e-9  # m between vertices that are one
_CHUNK = 256  # pieces at a time, so that intermediates stay in the cache


def lidded(
    vertex: Float[np.ndarray, "n k 2"], count: Int[np.ndarray, " n"], inward: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n k 2"], Int[np.ndarray, " n"]]:
    """Return the inner hulls of pieces of wall, with pockets and hollows closed by lids.

    A beam from inside the tunnel meets a piece only through this line, and anything behind a lid belongs to the same
    piece. So the box need only enclose the line, which keeps boxes thin at deep pockets.

    Args:
        vertex: Vertices of each piece in the direction of growing station, m.
        count: Vertices of each piece without padding.
        inward: -1 for a left wall, whose inside is on its right; +1 for a right wall; 0 keeps every vertex.

    Returns:
        Vertices of each hull, and their number; all vertices of a piece if a recess is deep.
    """
    hull, size = _hulls(vertex, count, inward)
    short = np.flatnonzero(size < count)
    for some in np.array_split(short, -(-len(short) // _CHUNK) if len(short) else 1):
        wide, deep = _recess(vertex[some], hull[some], size[some])
        # Inside a wide and deep recess the LiDAR itself would look out through the lid.
        roomy = some[(deep > LIDAR_GAP) & (2.0 * wide > 2.0 * LIDAR_GAP)]
        hull[roomy], size[roomy] = vertex[roomy], count[roomy]
    return hull, size


def _hulls(
    vertex: Float[np.ndarray, "n k 2"], count: Int[np.ndarray, " n"], inward: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n k 2"], Int[np.ndarray, " n"]]:
    """Return the vertices that turn outward, as in Andrew's monotone chain: drop the last while it turns inward."""
    n, k, _ = vertex.shape
    hull, size, row = np.zeros_like(vertex), np.zeros(n, int), np.arange(n)
    for i in range(k):
        point = vertex[:, i]
        asked = row[(i < count) & (size >= 2) & (inward != 0.0)]
        while len(asked):
            last, before = hull[asked, size[asked] - 1], hull[asked, size[asked] - 2]
            (a_x, a_y), (b_x, b_y) = (last - before).T, (point[asked] - last).T
            asked = asked[inward[asked] * (a_x * b_y - a_y * b_x) >= 0.0]
            size[asked] -= 1
            asked = asked[size[asked] >= 2]
        new = row[i < count]
        hull[new, size[new]] = point[new]
        size[new] += 1
    return _repeat_last(hull, size), size


def _repeat_last(vertex: Float[np.ndarray, "n k 2"], count: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n k 2"]:
    """Replace padding by the last vertex without padding."""
    place = np.minimum(np.arange(vertex.shape[1]), count[:, None] - 1)
    return np.take_along_axis(vertex, place[..., None], axis=1)


def _recess(
    vertex: Float[np.ndarray, "n k 2"], hull: Float[np.ndarray, "n k 2"], size: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return half the longest lid of each hull, and the largest distance of a vertex behind the lids, m."""
    middle, half = 0.5 * (hull[:, 1:] + hull[:, :-1]), 0.5 * (hull[:, 1:] - hull[:, :-1])
    # Padding is a point on the hull's end, which is never nearer than the last lid.
    behind = distance_to_segment(vertex[:, :, None], middle[:, None], half[:, None])
    return np.hypot(half[..., 0], half[..., 1]).max(axis=1), behind.min(axis=2).max(axis=1)


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


def thin_boxes(
    vertex: Float[np.ndarray, "n k 2"], count: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Return the centre, half long axis as a vector and half thickness of a thin box around each piece.

    The thinnest box of a polygon lies along an edge of its hull, so only directions between pairs of vertices are
    tried.

    Returns:
        Centres, exactly representable in float32, half long axes and half thicknesses, m.
    """
    centre, half, thickness = np.empty((len(vertex), 2)), np.empty((len(vertex), 2)), np.empty(len(vertex))
    for size in np.unique(count):
        rows = np.flatnonzero(count == size)
        for some in np.array_split(rows, -(-len(rows) // _CHUNK)):
            centre[some], half[some], thickness[some] = _boxes(vertex[some, :size])
    return centre, half, thickness


def _boxes(
    vertex: Float[np.ndarray, "n k 2"],
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Return `thin_boxes` of pieces that all have `k` vertices."""
    first, second = np.triu_indices(vertex.shape[1], k=1)
    edge = vertex[:, second] - vertex[:, first]
    size = np.sqrt(edge[..., 0] * edge[..., 0] + edge[..., 1] * edge[..., 1])
    # A file may repeat a vertex; a block with nothing else is a point, for which any direction will do.
    same = size <= _REPEATED
    d_x = np.where(same, 1.0, edge[..., 0] / np.where(same, 1.0, size))
    d_y = np.where(same, 0.0, edge[..., 1] / np.where(same, 1.0, size))
    directions = np.stack([d_x, d_y], axis=-1)
    normals = np.stack([-d_y, d_x], axis=-1)
    along, across = vertex @ directions.swapaxes(1, 2), vertex @ normals.swapaxes(1, 2)
    ends, sides = (along.min(axis=1), along.max(axis=1)), (across.min(axis=1), across.max(axis=1))
    area = (sides[1] - sides[0] + 1e-3) * (ends[1] - ends[0])
    row, best = np.arange(len(vertex)), np.argmin(np.where(same, np.inf, area), axis=1)
    direction = np.stack([d_x[row, best], d_y[row, best]], axis=-1)
    normal = np.stack([-direction[:, 1], direction[:, 0]], axis=-1)
    middle = 0.5 * (ends[0] + ends[1])[row, best, None] * direction
    middle = middle + 0.5 * (sides[0] + sides[1])[row, best, None] * normal
    centre = middle.astype(np.float32).astype(np.float64)
    from_x, from_y = (vertex - centre[:, None]).transpose(2, 0, 1)
    half_length = np.abs(from_x * direction[:, :1] + from_y * direction[:, 1:]).max(axis=1) + BOX_MARGIN
    half_thickness = np.abs(from_x * normal[:, :1] + from_y * normal[:, 1:]).max(axis=1) + BOX_MARGIN
    return centre, half_length[:, None] * direction, half_thickness
