"""Cut walls into short blocks, each in a thin box.

A ray is compared only with the blocks near its hit. Everything here runs once, on the host, in float64. Nothing is
simplified: a block keeps every segment of its piece of wall, and its box encloses them. A piece is a row of `k`
vertices, padded with its last one; its box does not depend on the other pieces.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from subterra_jax.tunnel.distances import distance_to_segment
from subterra_jax.tunnel.plan import Lining, TunnelPlan, Wall

# Boxes are larger than their walls by this, m, so that rounding on the device cannot move a wall out of its box.
BOX_MARGIN = 1e-5
# A robot never brings its LiDAR nearer to a wall than this: footprint radius less the motion of one step, m.
LIDAR_GAP = 0.2
_REPEATED = 1e-9  # m between vertices that are one
_FOLDED = 1e-4  # m that a segment of wall runs backwards where the wall folds
_CHUNK = 256  # pieces at a time, so that intermediates stay in the cache


def add_lids(
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


# Position of padding, m, and half the thickness of its boxes: negative, or a beam exactly towards them would enter them
# and take them for the nearest.
PADDING_CENTRE, PADDING_THICKNESS = 1e6, -1.0


@dataclasses.dataclass(frozen=True)
class Blocks:
    """Blocks of wall, in order of station."""

    centre: np.ndarray  # middle of each box, m, `(n_blocks, 2)`; exactly representable in float32
    half: np.ndarray  # half the long axis of each box as a vector, m, `(n_blocks, 2)`
    thickness: np.ndarray  # half the thickness of each box, m, `(n_blocks,)`
    # vertices of each block from the middle of its box, m, `(n_blocks, m, 2)`; padded with the last one
    offset: np.ndarray
    count: np.ndarray  # vertices of each block without padding, `(n_blocks,)`
    station: np.ndarray  # station of the middle of each block, m, `(n_blocks,)`


@dataclasses.dataclass(frozen=True)
class _Pieces:
    """Pieces of polylines, each a run of vertices of one long list."""

    vertex: Float[np.ndarray, "v 2"]  # all vertices, m
    first: Int[np.ndarray, " n"]  # first vertex of each piece
    last: Int[np.ndarray, " n"]  # last vertex of each piece
    station: Float[np.ndarray, " n"]  # station of the middle of each, m
    inward: Float[np.ndarray, " n"]  # -1 for a left wall, +1 for a right wall, 0 for furniture


def _join(parts: list[_Pieces]) -> _Pieces:
    """Join the pieces of several polylines in order of station."""
    shift = np.cumsum([0, *(len(part.vertex) for part in parts)])
    station = np.concatenate([part.station for part in parts])
    order = np.argsort(station, kind="stable")
    return _Pieces(
        vertex=np.concatenate([part.vertex for part in parts]),
        first=np.concatenate([p.first + s for p, s in zip(parts, shift, strict=False)])[order],
        last=np.concatenate([p.last + s for p, s in zip(parts, shift, strict=False)])[order],
        station=station[order],
        inward=np.concatenate([part.inward for part in parts])[order],
    )


def _wall_pieces(plan: TunnelPlan, wall: Wall, inward: float, length: float, max_segments: int) -> _Pieces:
    """Cut one wall into pieces.

    Where the wall runs backwards, as in an undercut niche, a beam may come to it past its lids: there are none.
    """

    def along(values: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "v 2"]:
        return np.stack([np.interp(wall.station, plan.station, column) for column in values.T], axis=-1)

    off, tangent = wall.vertex - along(plan.centre), along(plan.tangent)
    cuts = np.array(_cuts(wall.station, np.sqrt(off[:, 0] ** 2 + off[:, 1] ** 2), length, max_segments))
    first, last = cuts[:-1], cuts[1:]
    sides = np.full(len(first), inward)
    back = np.flatnonzero(np.sum(np.diff(wall.vertex, axis=0) * tangent[:-1], axis=1) < -_FOLDED)
    place = wall.station + np.sum(off * tangent, axis=1)
    for step, low, high in zip(back, place[back + 1], place[back], strict=True):
        beside = (wall.station[last] >= low) & (wall.station[first] <= high)
        sides[beside | ((first <= step) & (step < last))] = 0.0
    return _Pieces(wall.vertex, first, last, 0.5 * (wall.station[first] + wall.station[last]), sides)


def _cuts(
    station: Float[np.ndarray, " v"], clearance: Float[np.ndarray, " v"], length: float, max_segments: int
) -> list[int]:
    """Return the vertices between which the blocks of one wall lie.

    A block ends at the innermost vertex of the last part of its allowed length. It never ends in a recess, whose mouth
    would then lie slanted in two thick boxes.
    """
    end = len(station) - 1
    furthest = np.searchsorted(station, station + length + 1e-9, side="right") - 1
    at = np.arange(len(station))
    furthest = np.minimum(np.maximum(furthest, at + 1), at + max_segments)
    within = np.minimum(furthest, end)
    earliest = np.searchsorted(station, station + 0.65 * (station[within] - station))
    earliest = np.minimum(np.maximum(earliest, at + 1), within)
    cuts = [0]
    while cuts[-1] < end:
        low, high = earliest[cuts[-1]], furthest[cuts[-1]]
        cuts.append(end if high >= end else int(low + np.argmin(clearance[low : high + 1])))
    return cuts


def _furniture_pieces(plan: TunnelPlan, furniture: Float[np.ndarray, "f 4"], max_segments: int) -> _Pieces:
    """Join segments that begin where the one before ends into polylines of a few segments."""
    follows = np.all(np.abs(furniture[1:, :2] - furniture[:-1, 2:]) <= 1e-9, axis=1).tolist()
    begins, segments = [0], 1
    for i, joined in enumerate(follows, start=1):
        segments = segments + 1 if joined and segments < max_segments else 1
        if segments == 1:
            begins.append(i)
    begin = np.array(begins)
    count = np.diff(begin, append=len(furniture))
    # The vertices of a run: the start of each of its segments, and the end of the last.
    first = begin + np.arange(len(begin))
    last = first + count
    vertex = np.empty((len(furniture) + len(begin), 2))
    vertex[last] = furniture[begin + count - 1, 2:]
    vertex[np.setdiff1d(np.arange(len(vertex)), last, assume_unique=True)] = furniture[:, :2]
    mean = np.add.reduceat(vertex, first) / (count + 1)[:, None]
    nearest = [int(np.argmin((plan.centre[:, 0] - x) ** 2 + (plan.centre[:, 1] - y) ** 2)) for x, y in mean]
    return _Pieces(vertex, first, last, plan.station[nearest], np.zeros(len(first)))


def build_blocks(plan: TunnelPlan, lining: Lining, length: float, max_segments: int) -> Blocks:
    """Cut one lining into blocks.

    Args:
        plan: The tunnel, for its centreline.
        lining: The walls and furniture to cut.
        length: Target length of a block, m. A single longer wall segment stays whole.
        max_segments: Most segments in one block.
    """
    parts = [
        _wall_pieces(plan, lining.left, -1.0, length, max_segments),
        _wall_pieces(plan, lining.right, 1.0, length, max_segments),
    ]
    if len(lining.furniture):
        parts.append(_furniture_pieces(plan, lining.furniture, max_segments))
    pieces = _join(parts)
    count = pieces.last - pieces.first + 1
    place = np.minimum(pieces.first[:, None] + np.arange(count.max()), pieces.last[:, None])
    vertex = pieces.vertex[place]
    centre, half, thickness = thin_boxes(*add_lids(vertex, count, pieces.inward))
    return Blocks(centre, half, thickness, vertex - centre[:, None, :], count, pieces.station)
