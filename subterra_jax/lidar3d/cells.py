"""Sort the triangles of a bore on the host: into straight blocks of its axis, and there into cells around it.

A cell is a stretch of a block's axis and a wedge of directions around it. It lists every triangle within `MARGIN` of
it, and says how near the axis these come. Each block also has a prism in which there is no triangle at all. So a ray
inside the bore leaps to the prism's face, and from there passes from cell to cell, as a rule one or two, until it hits.
Boxes, such as rails and furniture, are met by themselves: each block lists its own. No triangle is simplified.
Coordinates are rounded to a few micrometres. Everything here is float64 NumPy.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from subterra_jax.host.errors import TunnelError
from subterra_jax.lidar3d.surface import Axis, Boxes, Triangles, split_boxes

# A ray may step this far over the face of a cell or prism without leaving what the cell lists, m.
MARGIN = 1e-3
# Cells of a block along the axis, wedges around it, a multiple of 4, and half-planes of its prism.
N_X, N_WEDGES, N_FACES = 12, 96, 16
FACES = np.array([(np.cos(a), np.sin(a)) for a in 2.0 * np.pi / N_FACES * np.arange(N_FACES)])
# Bits of a vertex's number in its block, of the two steps to the triangle's other vertices, and of a coordinate along
# and across the axis.
STEP_BITS, X_BITS, YZ_BITS = 10, 20, 22
MOST_VERTICES, MOST_STEP = 1 << (32 - 2 * STEP_BITS), (1 << STEP_BITS) - 1
# Unit in which a cell says how near its triangles come to the axis, m, and the most triangles of a cell.
NEAR_UNIT, MOST_LISTED = 1e-3, (1 << 16) - 1
_SHORTEST = 0.25  # m, of a block


@dataclasses.dataclass(frozen=True)
class Blocks:
    """Straight blocks along the axis, each with its own frame."""

    centre: Float[np.ndarray, "b 3"]  # origin of each frame, exactly representable in float32, m, `(b, 3)`
    # axes of the frame as rows: along, left, up, exactly representable in float32, `(b, 3, 3)`
    turn: Float[np.ndarray, "b 3 3"]
    # plane where the block begins, in its own frame, as a unit normal along the axis and an offset: inside, `normal ·
    # point >= offset`; m, `(b, 4)`
    back: Float[np.ndarray, "b 4"]
    front: Float[np.ndarray, "b 4"]  # plane where the block ends; inside, `normal · point <= offset`; m, `(b, 4)`
    ends: Float[np.ndarray, "b 2"]  # stations of the two planes, m, `(b, 2)`


def cut_blocks(axis: Axis, length: float) -> Blocks:
    """Cut an axis into blocks of about `length` m; one block if it is shorter."""
    station = axis.station
    joint = np.linspace(0.0, station[-1], max(1, round(station[-1] / length)) + 1)

    def at(values: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(joint, station, column) for column in values.T], axis=-1)

    point, normal = at(axis.position), at(axis.tangent)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    centre = _as_float32((point[1:] + point[:-1]) / 2)
    along = point[1:] - point[:-1]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    left = np.cross([0.0, 0.0, 1.0], along)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    turn = _as_float32(np.stack([along, left, np.cross(along, left)], axis=1))

    def plane(which: slice) -> np.ndarray:
        facing = np.einsum("bij,bj->bi", turn, normal[which])
        offset = np.einsum("bij,bj->bi", turn, point[which] - centre)
        return np.column_stack([facing, np.sum(facing * offset, axis=1)])

    ends = np.column_stack([joint[:-1], joint[1:]])
    return Blocks(centre, turn, plane(slice(None, -1)), plane(slice(1, None)), ends)


def _as_float32(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32).astype(np.float64)


@dataclasses.dataclass(frozen=True)
class Cells:
    """Triangles sorted by cell, in the integers that the kernels read."""

    blocks: Blocks
    # least coordinate along the axis in each block's frame, m; the first cell begins there, `(b,)`
    low: Float[np.ndarray, b]
    pitch: float  # length of a cell along the axis, m
    unit: Float[np.ndarray, 2]  # units of the vertices' coordinates along and across the axis, m, `(2,)`
    # distance of the faces of each block's empty prism from its axis, m, `(b, N_FACES)`
    prism: Float[np.ndarray, "b n_faces"]
    # first entry of each cell; number of entries in the upper half of a word, and in the lower the least distance from
    # the axis in units of `NEAR_UNIT`, measured as `wedge_depth`; cells of a block by station and then wedge, `(b * N_X
    # * N_WEDGES, 2)`
    cell: Int[np.ndarray, "c 2"]
    # triangles of each cell: number of the first vertex in its block, and steps to the other two, `(e,)`
    entry: Int[np.ndarray, e]
    first_vertex: Int[np.ndarray, b]  # first vertex of each block, `(b,)`
    # vertices, across and along the axis in the first word, upwards and along in the second, `(v, 2)`
    vertex: Int[np.ndarray, "v 2"]
    first_box: Int[np.ndarray, b1]  # first box of each block, and the end of the last, `(b + 1,)`
    # three rows that turn a point of the block's frame into a box's, where its faces are at -1 and 1: factors (1/m) and
    # what to subtract, `(k, 12)`
    box: Float[np.ndarray, "k 12"]
    box_top: Float[np.ndarray, b]  # upper end of each block's boxes in its frame, m, `(b,)`


class _TooDense(Exception):
    """A block has more triangles than its integers can number."""


def sort_triangles(axis: Axis, surface: Triangles, block_length: float) -> Cells:
    """Sort the triangles of a surface into cells around an axis.

    Args:
        block_length: Target length of a block, m; halved until every block can number its triangles.

    Raises:
        ValueError: No triangle lies along the axis.
        TunnelError: A quarter of a metre of the bore has too many triangles.
    """
    surface, boxes = split_boxes(surface)
    while True:
        try:
            return _sort(axis, surface, boxes, block_length)
        except _TooDense as error:
            block_length *= 0.5
            if block_length < _SHORTEST:
                raise TunnelError(
                    f"the surface is too fine for the LiDAR: {len(surface.faces)} triangles over "
                    f"{axis.station[-1]:.0f} m; simplify the mesh"
                ) from error


def _sort(axis: Axis, surface: Triangles, boxes: Boxes, block_length: float) -> Cells:
    blocks = cut_blocks(axis, block_length)
    chosen = _parts_of_blocks(axis, surface.vertices[surface.faces], blocks)
    chosen_boxes = _parts_of_blocks(axis, boxes.corners(), blocks)
    if not any(len(parts) for parts in (*chosen, *chosen_boxes)):
        raise ValueError("no triangle lies along the axis")
    half = float(np.max(blocks.ends[:, 1] - blocks.ends[:, 0])) / 2
    size = 2.0 * half / N_X
    local = [_compact(surface, faces, blocks, k) for k, faces in enumerate(chosen)]
    extent = np.abs(np.concatenate([np.ones((1, 3)), *(points for points, _ in local)])).max(axis=0)
    unit = np.array([extent[0], extent[1:].max()]) * (1.0 + 1e-6) / [(1 << X_BITS - 1) - 1, (1 << YZ_BITS - 1) - 1]
    parts, n_entries = [], 0
    for points, faces in local:
        parts.append(_pack_block(points, faces, unit, -half, size, n_entries))
        n_entries += len(parts[-1][1])
    low = np.full(len(local), -half)
    cell, entry, vertex = zip(*parts, strict=True)
    first_vertex = np.cumsum([0, *(len(words) for words in vertex[:-1])])
    cells, entries, vertices = (np.concatenate(part).astype(np.uint32).view(np.int32) for part in (cell, entry, vertex))
    prism = np.array([_empty_prism(points[:, 1:], faces) for points, faces in local])
    first_box = np.cumsum([0, *(len(parts) for parts in chosen_boxes)])
    placed = [boxes.pick(parts).seen_from(blocks.centre[k], blocks.turn[k]) for k, parts in enumerate(chosen_boxes)]
    top = np.array([float(part.corners()[..., 2].max(initial=-1e6)) for part in placed])
    box = np.concatenate([part.rows() for part in placed])
    return Cells(blocks, low, size, unit, prism, cells, entries, first_vertex, vertices, first_box, box, top + MARGIN)


def _pack_block(
    points: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    unit: Float[np.ndarray, 2],
    low: float,
    size: float,
    n_before: int,
) -> tuple[Int[np.ndarray, "c 2"], Int[np.ndarray, e], Int[np.ndarray, "w 2"]]:
    """Return cells, entries and vertices of one block, as `Cells` has them.

    Args:
        points: Vertices in the block's frame, m.
        faces: Triangles, by their vertices.
        unit: Units of the coordinates along and across the axis, m.
        low: Coordinate along the axis at which the first cell begins, m.
        size: Length of a cell along the axis, m.
        n_before: Entries of the blocks before.

    Raises:
        _TooDense: The block has more vertices, or one of its cells more triangles, than its integers can number.
    """
    vertex, numbered = _number_vertices(_pack_points(points, unit), faces)
    if len(vertex) > MOST_VERTICES:
        raise _TooDense
    which, count, near, order = _list(points[faces], low, size)
    if len(count) and count.max() > MOST_LISTED:
        raise _TooDense
    cell = np.zeros((N_X * N_WEDGES, 2), np.int64)
    cell[:, 0] = n_before
    cell[which, 0] = n_before + np.cumsum(count) - count
    cell[which, 1] = (count << 16) | np.clip(near / NEAR_UNIT, 0, (1 << 16) - 1).astype(np.int64)
    step = numbered[:, 1:] - numbered[:, :1]
    code = (numbered[:, 0] << 2 * STEP_BITS) | (step[:, 0] << STEP_BITS) | step[:, 1]
    return cell, code[order], vertex


def _parts_of_blocks(axis: Axis, parts: Float[np.ndarray, "k n 3"], blocks: Blocks) -> list[Int[np.ndarray, f]]:
    """Return which of some convex parts, given by their corners, reach between the planes of each block."""
    if not len(parts):
        return [np.zeros(0, np.int64) for _ in blocks.centre]
    from scipy.spatial import cKDTree  # half a second to import, and planar tasks do not need it

    # In rows of one coordinate each: NumPy reduces a short last axis many times slower.
    rows = np.ascontiguousarray(parts.transpose(1, 2, 0))
    low, high = rows.min(axis=0), rows.max(axis=0)
    near = axis.station[cKDTree(axis.position).query(((low + high) / 2).T)[1]]
    reach = np.sqrt(np.sum((high - low) ** 2, axis=0)) + 2.0 * (axis.station[1] - axis.station[0])
    order = np.argsort(near)
    sorted_near, widest = near[order], reach.max()
    chosen = []
    for turn, centre, back, front, ends in zip(
        blocks.turn, blocks.centre, blocks.back, blocks.front, blocks.ends, strict=True
    ):
        close = np.sort(order[slice(*np.searchsorted(sorted_near, [ends[0] - widest, ends[1] + widest]))])
        close = close[(near[close] + reach[close] >= ends[0]) & (near[close] - reach[close] <= ends[1])]
        from_centre, within = rows[:, :, close] - centre[:, None], np.ones(len(close), bool)
        for plane, sign in ((front, 1.0), (back, -1.0)):
            beyond = sign * ((plane[:3] @ turn) @ from_centre - plane[3])
            within &= beyond.min(axis=0) <= MARGIN
        chosen.append(close[within])
    return chosen


def _compact(
    surface: Triangles, chosen: np.ndarray, blocks: Blocks, k: int
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Return the chosen triangles in a block's frame, with only the vertices that they use."""
    faces = surface.faces[chosen]
    seen = np.zeros(len(surface.vertices), bool)
    seen[faces] = True
    used = np.flatnonzero(seen)
    return (surface.vertices[used] - blocks.centre[k]) @ blocks.turn[k].T, (np.cumsum(seen) - 1)[faces]


def _pack_points(points: Float[np.ndarray, "v 3"], unit: Float[np.ndarray, 2]) -> Int[np.ndarray, "v 3"]:
    """Return points in two words each, see `Cells.vertex`, and their integer place along the axis."""
    half = X_BITS // 2
    x = np.rint(points[:, 0] / unit[0]).astype(np.int64) + (1 << X_BITS - 1)
    y, z = np.rint(points[:, 1:] / unit[1]).astype(np.int64).T
    words = np.stack([(y << half) | (x >> half), (z << half) | (x & ((1 << half) - 1))], axis=-1) & 0xFFFFFFFF
    return np.concatenate([words, x[:, None]], axis=1)


def _number_vertices(
    points: Int[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Int[np.ndarray, "w 2"], Int[np.ndarray, "f 3"]]:
    """Number vertices along the block, each once, so that those of a triangle are close; where not, copy them."""
    _, first, same = np.unique((points[:, 0] << 32) | points[:, 1], return_index=True, return_inverse=True)
    order = np.argsort(points[first, 2], kind="stable")
    number = np.empty(len(first), np.int64)
    number[order] = np.arange(len(first))
    words, faces = points[first[order], :2], np.sort(number[same.ravel()][faces], axis=1)
    far = np.flatnonzero(faces[:, 2] - faces[:, 0] > MOST_STEP)
    copies = len(words) + np.arange(3 * len(far)).reshape(-1, 3)
    words = np.concatenate([words, words[faces[far]].reshape(-1, 2)])
    faces[far] = copies
    return words, faces


def wedge_edge(number: np.ndarray) -> Float[np.ndarray, "k 2"]:
    """Return the direction in which a wedge begins, left and up; not a unit vector: |left| + |up| is 1."""
    quarter = N_WEDGES // 4
    turn, fraction = np.divmod(np.mod(number, N_WEDGES), quarter)
    fraction = fraction / quarter
    y = np.choose(turn, [1.0 - fraction, -fraction, fraction - 1.0, fraction])
    return np.stack([y, np.choose(turn, [fraction, 1.0 - fraction, -fraction, fraction - 1.0])], axis=-1)


def wedge_place(y: Float[np.ndarray, "*k"], z: Float[np.ndarray, "*k"]) -> Float[np.ndarray, "*k"]:
    """Return the directions of points left and up as numbers of wedges, with fractions."""
    turn = np.where(z >= 0.0, np.where(y > 0.0, 0, 1), np.where(y < 0.0, 2, 3))
    fraction = np.where(turn % 2 == 0, np.abs(z), np.abs(y)) / np.maximum(np.abs(y) + np.abs(z), 1e-30)
    return (turn + fraction) * (N_WEDGES // 4)


def _list(
    corner: Float[np.ndarray, "t 3 3"], low: float, size: float
) -> tuple[Int[np.ndarray, c], Int[np.ndarray, c], Float[np.ndarray, c], Int[np.ndarray, p]]:
    """List the triangles of every cell of a block.

    Returns:
        Cells with triangles; the number of their triangles; the least depth of these within the cell's wedge, m; and
        the triangles, cell by cell.
    """
    triangle, wedge = _wedges(corner[..., 1:])
    x, depth, inside = _clip(corner[triangle], wedge)
    there = inside.any(axis=0)
    least, most = np.where(inside, x, np.inf).min(axis=0), np.where(inside, x, -np.inf).max(axis=0)
    near = np.where(inside, depth, np.inf).min(axis=0)[there] - MARGIN
    start, stop = (
        np.clip(np.floor((value[there] - low) / size), 0, N_X - 1).astype(np.int64)
        for value in (least - MARGIN, most + MARGIN)
    )
    span = stop - start + 1
    place = np.repeat(start - np.cumsum(span) + span, span) + np.arange(span.sum())
    pair = np.repeat(np.arange(len(span)), span)
    cell = place * N_WEDGES + wedge[there][pair]
    order = np.argsort(cell, kind="stable")
    which, first, count = np.unique(cell[order], return_index=True, return_counts=True)
    nearest = np.minimum.reduceat(near[pair[order]], first) if len(first) else np.zeros(0)
    return which, count, nearest, triangle[there][pair[order]]


def _wedges(corner: Float[np.ndarray, "t 3 2"]) -> tuple[Int[np.ndarray, p], Int[np.ndarray, p]]:
    """Pair triangles with the wedges that they may reach into, seen along the axis."""
    y, z = np.ascontiguousarray(corner.transpose(2, 1, 0))
    (edge_y, edge_z), turn = (np.roll(along, -1, axis=0) - along for along in (y, z)), wedge_place(y, z)
    size = edge_y**2 + edge_z**2
    fraction = np.clip(-(y * edge_y + z * edge_z) / np.where(size > 0.0, size, 1.0), 0.0, 1.0)
    apart = np.sqrt(np.min((y + fraction * edge_y) ** 2 + (z + fraction * edge_z) ** 2, axis=0))
    swing = np.mod(np.roll(turn, -1, axis=0) - turn + 0.5 * N_WEDGES, N_WEDGES) - 0.5 * N_WEDGES
    # Around the axis, or too near it to tell.
    whole = (np.abs(swing.sum(axis=0)) > 1.0) | (apart < 20.0 * MARGIN)
    from_first = np.stack([np.zeros_like(apart), swing[0], swing[0] + swing[1]])
    loose = 0.5 * N_WEDGES * MARGIN / np.maximum(apart, MARGIN)
    start = np.floor(turn[0] + from_first.min(axis=0) - loose).astype(np.int64)
    stop = np.floor(turn[0] + from_first.max(axis=0) + loose).astype(np.int64)
    start, span = np.where(whole, 0, start), np.where(whole, N_WEDGES, np.minimum(stop - start + 1, N_WEDGES))
    triangle = np.repeat(np.arange(len(corner)), span)
    wedge = np.repeat(start - np.cumsum(span) + span, span) + np.arange(span.sum())
    return triangle, np.mod(wedge, N_WEDGES)


def _clip(
    corner: Float[np.ndarray, "p 3 3"], wedge: Int[np.ndarray, p]
) -> tuple[Float[np.ndarray, "9 p"], Float[np.ndarray, "9 p"], Bool[np.ndarray, "9 p"]]:
    """Return the corners of triangles cut to wedges: place along the axis and depth, m, and which of nine there are."""
    begin, end = wedge_edge(wedge).T, wedge_edge(wedge + 1).T
    corner = np.ascontiguousarray(corner.transpose(2, 1, 0))  # of columns, as above
    _, y, z = corner
    sides = [
        sign * (z * facing[0] - y * facing[1]) / np.hypot(*facing) + MARGIN
        for facing, sign in ((begin, 1.0), (end, -1.0))
    ]
    following = np.roll(corner, -1, axis=1)
    points, inside = [corner], [(sides[0] >= 0.0) & (sides[1] >= 0.0)]
    for side, other in (sides, sides[::-1]):
        after, other_after = np.roll(side, -1, axis=0), np.roll(other, -1, axis=0)
        crosses = (side >= 0.0) != (after >= 0.0)
        fraction = np.where(crosses, side / np.where(crosses, side - after, 1.0), 0.0)
        points.append(corner + fraction * (following - corner))
        inside.append(crosses & (other + fraction * (other_after - other) >= -1e-12))
    x, y, z = np.concatenate(points, axis=1)
    middle = begin + end
    return x, y * middle[0] + z * middle[1], np.concatenate(inside)


def _empty_prism(points: Float[np.ndarray, "v 2"], faces: Int[np.ndarray, "t 3"]) -> Float[np.ndarray, n_faces]:
    """Return the distances of a prism's faces from the axis, m: no triangle reaches into the prism.

    Each triangle stays behind one of the faces, the one for which that costs the least.
    """
    distance = np.full(N_FACES, 1e6)
    if len(faces):
        along = FACES @ points.T
        nearest = np.minimum(np.minimum(along[:, faces[:, 0]], along[:, faces[:, 1]]), along[:, faces[:, 2]])
        face = np.argmax(nearest - along.max(axis=1)[:, None], axis=0)
        np.minimum.at(distance, face, nearest[face, np.arange(len(face))] - MARGIN)
    return distance
