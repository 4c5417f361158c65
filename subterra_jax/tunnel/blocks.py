"""Cut walls into short blocks, each in a thin box, and list the blocks within reach of every place along the tunnel.

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
    """Blocks of wall, in order of station.

    Attributes:
        centre: Middle of each box, m, `(n_blocks, 2)`; exactly representable in float32.
        half: Half the long axis of each box as a vector, m, `(n_blocks, 2)`.
        thickness: Half the thickness of each box, m, `(n_blocks,)`.
        offset: Vertices of each block from the middle of its box, m, `(n_blocks, m, 2)`; padded with the last one.
        count: Vertices of each block without padding, `(n_blocks,)`.
        station: Station of the middle of each block, m, `(n_blocks,)`.
    """

    centre: np.ndarray
    half: np.ndarray
    thickness: np.ndarray
    offset: np.ndarray
    count: np.ndarray
    station: np.ndarray


@dataclasses.dataclass(frozen=True)
class _Pieces:
    """Pieces of polylines, each a run of vertices of one long list.

    Attributes:
        vertex: All vertices, m.
        first: First vertex of each piece.
        last: Last vertex of each piece.
        station: Station of the middle of each, m.
        inward: -1 for a left wall, +1 for a right wall, 0 for furniture.
    """

    vertex: Float[np.ndarray, "v 2"]
    first: Int[np.ndarray, " n"]
    last: Int[np.ndarray, " n"]
    station: Float[np.ndarray, " n"]
    inward: Float[np.ndarray, " n"]


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
    """Cut one wall into pieces."""
    off_x, off_y = (wall.vertex[:, i] - np.interp(wall.station, plan.station, plan.centre[:, i]) for i in range(2))
    cuts = np.array(_cuts(wall.station, np.sqrt(off_x * off_x + off_y * off_y), length, max_segments))
    first, last = cuts[:-1], cuts[1:]
    middle = 0.5 * (wall.station[first] + wall.station[last])
    return _Pieces(wall.vertex, first, last, middle, np.full(len(first), inward))


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


# Bounds are made to be less than true by this, m: more than any rounding on the device.
_BOUND_MARGIN = 1e-3
_BOUND_ROWS = 64  # blocks at a time, against memory


@dataclasses.dataclass(frozen=True)
class Order:
    """The order in which a beam visits blocks, and a bound by which it may stop.

    A beam visits the blocks from `start` on, and then those before it, outward. Across the tunnel at each block lies a
    plane. Whatever is still to be visited lies beyond it, however the tunnel bends, so a beam that does not reach the
    plane before the wall that it has met is done.

    Attributes:
        start: First block at or beyond each node of the station grid, `(n,)`.
        normal: Of the plane at each block, along the tunnel, `(n_blocks, 2)`; at most of length 1, with coordinates of
            16 bits, so that all kernels read the same.
        ahead: Distance along the normal from the middle of each block to the plane behind which it and all later
            blocks lie, m, `(n_blocks,)`, scaled like the normal.
        behind: The same against the normal, for it and all earlier blocks.
    """

    start: np.ndarray
    normal: np.ndarray
    ahead: np.ndarray
    behind: np.ndarray


def order(plan: TunnelPlan, blocks: Blocks, first: np.ndarray, count: np.ndarray) -> Order:
    """Return the order of blocks.

    Args:
        plan: The tunnel, for its station grid.
        blocks: Its blocks.
        first: First block within reach of each node, as from `windows`.
        count: Number of blocks from there on that may be within reach.
    """
    n = len(blocks.centre)
    start = np.searchsorted(blocks.station, plan.station)
    # Blocks that nobody sees who passes this one on the way out do not count.
    last, least = np.arange(n), np.arange(n)
    np.maximum.at(last, np.minimum(start, n - 1), first + count - 1)
    np.minimum.at(least, np.maximum(start - 1, 0), first)
    last = np.maximum.accumulate(last)
    least = np.minimum.accumulate(least[::-1])[::-1]
    tangent = np.stack([np.interp(blocks.station, plan.station, plan.tangent[:, i]) for i in range(2)], axis=-1)
    normal = half_float((1.0 - 2.0**-7) * tangent / np.linalg.norm(tangent, axis=1, keepdims=True))
    along = blocks.half / np.maximum(np.hypot(*blocks.half.T), 1e-12)[:, None]
    aside = blocks.thickness[:, None] * np.stack([-along[:, 1], along[:, 0]], axis=-1)
    ahead, behind = np.empty(n), np.empty(n)
    for begin in range(0, n, _BOUND_ROWS):
        rows = np.arange(begin, min(begin + _BOUND_ROWS, n))
        low, high = least[rows].min(), last[rows].max() + 1
        off = normal[rows] @ blocks.centre[low:high].T - np.sum(normal[rows] * blocks.centre[rows], axis=1)[:, None]
        size = np.abs(normal[rows] @ blocks.half[low:high].T) + np.abs(normal[rows] @ aside[low:high].T)
        # What lies behind a lid counts too: a clearance may be measured from within a pocket.
        vertices = np.abs(blocks.offset[low:high].reshape(-1, 2) @ normal[rows].T)
        size = np.maximum(size, vertices.reshape(high - low, -1, len(rows)).max(axis=1).T)
        which, row = np.arange(low, high), rows[:, None]
        later, earlier = (which >= row) & (which <= last[row]), (which <= row) & (which >= least[row])
        ahead[rows] = np.where(later, off - size, np.inf).min(axis=1) - _BOUND_MARGIN
        behind[rows] = np.where(earlier, -off - size, np.inf).min(axis=1) - _BOUND_MARGIN
    return Order(start, normal, ahead, behind)


def half_float(values: np.ndarray) -> np.ndarray:
    """Return the nearest numbers of which only the upper 16 bits of 32 are set."""
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    return ((bits + 0x8000) & 0xFFFF0000).astype(np.uint32).view(np.float32).astype(np.float64)


_ROWS = 128  # segments compared together: close enough to one another to share most of their blocks


def windows(plan: TunnelPlan, blocks: Blocks, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Return, for each node of the station grid, the blocks within reach of a robot near that node.

    Args:
        plan: The tunnel, for its station grid.
        blocks: Its blocks.
        reach: Distance that the window must cover, m, wherever across the tunnel the robot is and up to half a grid
            step along it; beyond a mouth, up to 0.5 m outside.

    Returns:
        First block of each node's window, and the number of blocks in it, both `(n,)`. As many blocks as the largest
        window holds follow every first block.
    """
    spacing = plan.station[1] - plan.station[0]
    slack = np.full(len(plan.station), 0.6 * spacing + 0.01)
    slack[[0, -1]] += 0.5
    normal = np.stack([-plan.tangent[:, 1], plan.tangent[:, 0]], axis=-1)
    node, block = _within(plan.centre, plan.half_width[:, None] * normal, np.zeros(len(slack)), blocks, reach + slack)
    first = np.full(len(plan.station), len(blocks.centre) - 1)
    last = np.zeros(len(plan.station), int)
    np.minimum.at(first, node, block)
    np.maximum.at(last, node, block)
    size = int(np.clip(np.max(last - first) + 1, 1, len(blocks.centre)))
    first = np.clip(first, 0, len(blocks.centre) - size)
    return first, np.maximum(last - first + 1, 1)


def _within(
    middle: Float[np.ndarray, "n 2"],
    half: Float[np.ndarray, "n 2"],
    thickness: Float[np.ndarray, " n"],
    blocks: Blocks,
    limit: Float[np.ndarray, " n"],
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Find pairs of a thin box `middle ± half` and a block within a distance of one another.

    Both may be thicker than a line. A wall behind a lid is at most a pocket further away than the box, never nearer.

    Args:
        middle: Middle of each box, m.
        half: Half the long axis of each box, m.
        thickness: Half the thickness of each box, m.
        blocks: The blocks.
        limit: Distance for each box, m.

    Returns:
        Numbers of the box and of the block of each pair.
    """
    length, size = np.hypot(*half.T), np.hypot(*blocks.half.T)
    found = []
    for first in range(0, len(middle), _ROWS):
        rows = slice(first, first + _ROWS)
        most = (limit[rows] + thickness[rows]).max() + (size + blocks.thickness).max() + length[rows].max()
        low, high = middle[rows].min(axis=0) - most, middle[rows].max(axis=0) + most
        near = np.flatnonzero(np.all((blocks.centre >= low) & (blocks.centre <= high), axis=1))
        x, y = (middle[rows, i, None] - blocks.centre[near, i] for i in range(2))
        room = (limit + thickness)[rows, None] + blocks.thickness[near]
        squared, surely = x * x + y * y, np.maximum(room, 0.0)
        maybe = surely + length[rows, None] + size[near]
        sure = squared <= surely * surely
        row, column = np.nonzero(~sure & (squared <= maybe * maybe))
        gap = _gap(middle[rows][row], half[rows][row], blocks.centre[near[column]], blocks.half[near[column]])
        sure[row, column] = gap <= room[row, column]
        row, column = np.nonzero(sure)
        found.append((first + row, near[column]))
    box, block = (np.concatenate(part) for part in zip(*found, strict=True))
    return box, block


def _gap(
    middle: Float[np.ndarray, "n 2"],
    half: Float[np.ndarray, "n 2"],
    other: Float[np.ndarray, "n 2"],
    other_half: Float[np.ndarray, "n 2"],
) -> Float[np.ndarray, " n"]:
    """Return the distance between segments `middle ± half` that do not cross: it is at an end of one of them."""
    ends = (
        distance_to_segment(middle + half, other, other_half),
        distance_to_segment(middle - half, other, other_half),
        distance_to_segment(other + other_half, middle, half),
        distance_to_segment(other - other_half, middle, half),
    )
    return np.minimum(np.minimum(ends[0], ends[1]), np.minimum(ends[2], ends[3]))
