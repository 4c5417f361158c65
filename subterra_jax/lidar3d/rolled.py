"""The wall of a shell as triangles: rolled out flat, triangulated with its recesses, and rolled up again.

In the plane of arc length around the section and station along the axis a recess is a rectangle. No other point comes
near its rim, so Delaunay's triangulation holds the rim's edges. The triangles are those of the scene's own meshes.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from subterra_jax.host.errors import TunnelError
from subterra_jax.lidar3d.surface import BOX_FACES, Axis, Triangles, join_surfaces
from subterra_jax.tunnel.shell import Shell, ShellLining, brick_corners

_BAND = 0.6  # share of the spacing around within which no grid point is near a rim or a corner of the section
_CORNER = np.radians(30.0)  # a section that turns more than this over four of its angles has a corner there
_NEAR, _WIDE = 2, 3  # steps of the grid
_PAD = 1.0  # of the sheet, repeated beyond the seam, m
_AROUND_CUT = 4.0  # of wall beyond a cut that is triangulated, m; further away no triangle depends on it
_LID = 0.05  # of a recess's box inside the bore, so that a union leaves no film, m


def raise_shell(shell: Shell, lining: str) -> tuple[Axis, Triangles]:
    """Return the axis and the surface of one variant: wall with recesses, track, furniture.

    Args:
        lining: Name of the variant.

    Raises:
        TunnelError: The shell does not have the variant.
    """
    axis, *parts = raise_parts(shell, lining)
    return axis, join_surfaces(parts)


def raise_parts(shell: Shell, lining: str) -> tuple[Axis, Triangles, Triangles, Triangles]:
    """Return the axis and, apart, the wall with its recesses, the track and the furniture.

    Args:
        shell: As for `raise_shell`.
        lining: As for `raise_shell`.

    Raises:
        TunnelError: As for `raise_shell`.
    """
    if lining not in shell.linings:
        raise TunnelError(f"the shell has no lining {lining!r}; it has {', '.join(shell.linings)}")
    own = shell.linings[lining]
    if own.radius is not None:
        shell = replace(shell, radius=own.radius)
    wall = _raise_wall(shell, own)
    return _cut_axis(shell), wall, _raise_bricks(shell.track), _raise_bricks(own.brick)


def _raise_bricks(brick: Float[np.ndarray, "k 13"]) -> Triangles:
    """Return bricks as triangles, eight vertices and twelve faces each."""
    first = 8 * np.arange(len(brick))
    return Triangles(brick_corners(brick).reshape(-1, 3), (first[:, None, None] + BOX_FACES).reshape(-1, 3))


def _cut_axis(shell: Shell) -> Axis:
    """Return the axis within the window, stations from 0."""
    start, end = shell.window[0], min(shell.window[1], shell.station[-1])
    if start == 0.0 and end == shell.station[-1]:
        return Axis(shell.station, shell.position, shell.tangent)
    step = shell.station[1] - shell.station[0]
    station = np.linspace(start, end, max(2, round((end - start) / step) + 1))
    position, tangent = (
        np.stack([np.interp(station, shell.station, column) for column in values.T], axis=-1)
        for values in (shell.position, shell.tangent)
    )
    return Axis(station - start, position, tangent / np.linalg.norm(tangent, axis=1, keepdims=True))


def _raise_wall(shell: Shell, lining: ShellLining) -> Triangles:
    plane = _unroll(shell, lining.seam)
    boxes, apart = _rectangles(shell, plane, lining.pocket)
    fold = np.sort(plane.to_around(_section_corners(shell)))
    near = np.array([shell.window[0] - _AROUND_CUT, shell.window[1] + _AROUND_CUT])
    whole = not apart.all()
    if whole:
        near = np.array([-np.inf, np.inf])  # the union needs the whole, closed at both mouths
    chosen = apart & (boxes[:, 2] > near[0]) & (boxes[:, 3] < near[1])
    sheet = _triangulate(plane, shell.station[-1], fold, boxes[chosen], shell.spacing, near)
    wall = _roll_up(shell, plane, sheet, lining.pocket[chosen])
    return wall if not whole else _sink(wall, sheet, shell, lining.pocket[~apart])


@dataclass(frozen=True)
class _Unrolled:
    """The section's arc length as a coordinate, cut open at a seam."""

    around: Float[np.ndarray, " k"]  # arc length from the seam at each of `angle`, m
    angle: Float[np.ndarray, " k"]  # angles over one turn from the seam, rad, growing

    @property
    def girth(self) -> float:
        """Length of the mean section's outline, m."""
        return float(self.around[-1])

    def to_angle(self, around: np.ndarray) -> np.ndarray:
        """Return the angle at an arc length, rad."""
        return np.interp(around, self.around, self.angle)

    def to_around(self, angle: np.ndarray) -> np.ndarray:
        """Return the arc length at any angle, m, in one turn from the seam."""
        turn = (np.asarray(angle) - self.angle[0]) % (2 * np.pi)
        return np.interp(turn + self.angle[0], self.angle, self.around)


@dataclass(frozen=True)
class _Sheet:
    """Triangles in the plane."""

    around: Float[np.ndarray, " p"]  # arc length of each point, m
    station: Float[np.ndarray, " p"]  # station of each point, m
    recess: Int[np.ndarray, " p"]  # number of the recess that a point belongs to, -1 for none
    rim: Bool[np.ndarray, " p"]  # true for points on the rim of their recess
    faces: Int[np.ndarray, "f 3"]  # rows of three points


def _unroll(shell: Shell, seam: float) -> _Unrolled:
    order = np.argsort((shell.angle - seam) % (2 * np.pi))
    turn = (shell.angle[order] - seam) % (2 * np.pi)
    angle = np.concatenate([[0.0], turn, [2 * np.pi]]) + seam
    mean = np.interp(angle, shell.angle, shell.section, period=2 * np.pi)
    outline = mean[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    around = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
    return _Unrolled(around, angle)


def _section_corners(shell: Shell) -> Float[np.ndarray, " c"]:
    """Return the angles at which the mean section has a corner, rad, such as a horseshoe's feet."""
    outline = shell.section[:, None] * np.column_stack([np.cos(shell.angle), np.sin(shell.angle)])
    edge = np.roll(outline, -2, axis=0) - outline
    before = np.roll(edge, 2, axis=0)
    turn = np.arctan2(before[:, 0] * edge[:, 1] - before[:, 1] * edge[:, 0], np.sum(before * edge, axis=1))
    near = np.max([np.roll(turn, k) for k in range(-6, 7)], axis=0)
    return shell.angle[(turn >= near) & (turn > _CORNER)]


def _points(shell: Shell, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    radius, angle = shell.radius[row, column, None], shell.angle[column, None]
    return shell.position[row] + radius * (np.cos(angle) * shell.left[row] + np.sin(angle) * shell.up[row])


def _wall_points(shell: Shell, station: np.ndarray, angle: np.ndarray) -> Float[np.ndarray, "k 3"]:
    """Return points of the smooth wall, bilinear between the sections' points, m."""
    n, m = shell.radius.shape
    row = np.clip(station / (shell.station[1] - shell.station[0]), 0, n - 1)
    column = (angle - shell.angle[0]) / (2 * np.pi) * m
    r, c = np.minimum(row.astype(int), n - 2), np.floor(column).astype(int)
    along, across = (row - r)[:, None], (column - c)[:, None]
    c, d = c % m, (c + 1) % m
    near = _points(shell, r, c) * (1 - across) + _points(shell, r, d) * across
    far = _points(shell, r + 1, c) * (1 - across) + _points(shell, r + 1, d) * across
    return near * (1 - along) + far * along


def _wall_normals(shell: Shell, pocket: Float[np.ndarray, "r 5"]) -> Float[np.ndarray, "r 3"]:
    """Return outward unit normals of the wall at some recesses, over an arc of about 5°."""
    m = len(shell.angle)
    row = np.rint(pocket[:, 0] / (shell.station[1] - shell.station[0])).astype(int)
    row = np.clip(row, 0, len(shell.station) - 1)
    column, reach = np.rint((pocket[:, 1] - shell.angle[0]) / (2 * np.pi) * m).astype(int), max(1, m // 144)
    before, after = (_points(shell, row, (column + side * reach) % m) for side in (-1, 1))
    normal = np.cross(after - before, shell.tangent[row])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _rectangles(
    shell: Shell, plane: _Unrolled, pocket: Float[np.ndarray, "r 5"]
) -> tuple[Float[np.ndarray, "r 4"], Bool[np.ndarray, " r"]]:
    """Return each recess's rectangle in the plane, and whether it is clear of others, the seam and the mouths."""
    clear = _BAND * shell.spacing[1]
    u, (_, _, length, width, _) = plane.to_around(pocket[:, 1]), pocket.T
    start = pocket[:, 0] - length / 2
    box = np.column_stack([u - width / 2, u + width / 2, start, pocket[:, 0] + length / 2])
    apart = (box[:, 0] > clear) & (box[:, 1] < plane.girth - clear)
    apart &= (box[:, 2] > clear) & (box[:, 3] < shell.station[-1] - clear)
    order = np.argsort(box[:, 2], kind="stable")
    for place, k in enumerate(order):
        last = np.searchsorted(box[order, 2], box[k, 3] + clear)
        others = order[place + 1 : last]
        near = (box[others, 0] < box[k, 1] + clear) & (box[others, 1] > box[k, 0] - clear)
        apart[others[near]] = False
    return box, apart


def _triangulate(
    plane: _Unrolled,
    length: float,
    fold: Float[np.ndarray, " c"],
    boxes: Float[np.ndarray, "r 4"],
    spacing: tuple[float, float],
    near: Float[np.ndarray, "2"],
) -> _Sheet:
    """Triangulate one turn between two stations, with edges along the axis at the arc lengths `fold`, m."""
    band = _BAND * spacing[1]
    grid = _grid(plane.girth, length, fold, spacing)
    within = (grid.station >= near[0]) & (grid.station <= near[1])
    u, s, node = (values[within] for values in (grid.around, grid.station, grid.node))
    recess, clear = np.full(len(u), -1), np.ones(len(u), bool)
    for k, (u0, u1, s0, s1) in enumerate(boxes):
        rows = slice(*np.searchsorted(s, [s0 - band, s1 + band]))
        inside = np.minimum(np.minimum(u[rows] - u0, u1 - u[rows]), np.minimum(s[rows] - s0, s1 - s[rows]))
        clear[rows] &= np.abs(inside) > band
        recess[rows] = np.where(inside > band, k, recess[rows])
    rims = [_rim(box, spacing[1]) for box in boxes]
    owner = np.repeat(np.arange(len(boxes)), [len(rim) for rim in rims])
    u = np.concatenate([u[clear], *(rim[:, 0] for rim in rims)])
    s = np.concatenate([s[clear], *(rim[:, 1] for rim in rims)])
    node = np.concatenate([node[clear], np.full(len(owner), -1)])
    faces = _faces(u, s, node, grid.shape, plane.girth, length)
    return _Sheet(u, s, np.concatenate([recess[clear], owner]), np.arange(len(u)) >= clear.sum(), faces)


class _Grid(NamedTuple):
    """Points in rows by station, every second row half a step aside, and one of each row on every fold."""

    around: Float[np.ndarray, " p"]  # arc length of each point, m
    station: Float[np.ndarray, " p"]  # its station, m
    node: Int[np.ndarray, " p"]  # row times columns plus column; -1 of points on folds
    shape: tuple[int, int]  # rows and columns


def _grid(girth: float, length: float, fold: np.ndarray, spacing: tuple[float, float]) -> _Grid:
    columns, rows = max(round(girth / spacing[1]), 8), max(round(length / spacing[0]), 2)
    station = np.linspace(0.0, length, rows + 1)
    u = (np.arange(columns) + np.where(np.arange(rows + 1) % 2, 0.75, 0.25)[:, None]) * (girth / columns)
    distance = np.abs((u[..., None] - fold + girth / 2) % girth - girth / 2).min(axis=-1, initial=np.inf)
    clear = distance > _BAND * spacing[1]
    u = np.concatenate([u[clear], np.tile(fold, rows + 1)])
    s = np.concatenate([np.repeat(station, columns)[clear.ravel()], np.repeat(station, len(fold))])
    node = np.concatenate([np.flatnonzero(clear), np.full((rows + 1) * len(fold), -1)])
    order = np.lexsort([u, s])
    return _Grid(u[order], s[order], node[order], (rows + 1, columns))


def _rim(box: Float[np.ndarray, "4"], step: float) -> Float[np.ndarray, "k 2"]:
    """Return points on a rectangle's outline, a step or less apart."""
    u0, u1, s0, s1 = box
    across, along = (max(int(np.ceil(size / step - 1e-6)), 1) for size in (u1 - u0, s1 - s0))
    u, s = np.linspace(u0, u1, across + 1), np.linspace(s0, s1, along + 1)
    sides = [(u[:-1], s0), (u1, s[:-1]), (u[:0:-1], s1), (u0, s[:0:-1])]
    return np.concatenate([np.column_stack(np.broadcast_arrays(*side)) for side in sides])


def _faces(
    u: np.ndarray, s: np.ndarray, node: np.ndarray, shape: tuple[int, int], girth: float, length: float
) -> Int[np.ndarray, "f 3"]:
    """Return Delaunay's triangles; those of the plain grid, which are known, need not be looked for.

    Around what is not of the grid, and where a point of it is missing, triangles are looked for among the points
    within `_WIDE` steps of those that may be affected, which lie within `_NEAR` steps.
    """
    point = np.full(shape, -1)
    there = np.flatnonzero(node >= 0)
    point.ravel()[node[there]] = there
    foreign = np.flatnonzero(node < 0)
    rows = np.clip(np.rint(s[foreign] / length * (shape[0] - 1)).astype(int), 0, shape[0] - 1)
    odd = point < 0
    odd[rows, np.floor(u[foreign] / girth * shape[1]).astype(int) % shape[1]] = True
    near = _grown(odd, _NEAR)
    patch = np.sort(np.concatenate([foreign, point[_grown(near, _WIDE) & (point >= 0)]]))
    if len(patch) > 0.5 * len(u):
        return _delaunay(u, s, girth)
    found = patch[_delaunay(u[patch], s[patch], girth)]
    affected = np.ones(len(u), bool)
    affected[point[~near]] = False
    return np.concatenate([_plain(point, ~near), found[affected[found].any(axis=1)]])


def _grown(mask: Bool[np.ndarray, "r c"], steps: int) -> Bool[np.ndarray, "r c"]:
    """Return a mask grown by some rows and columns to either side; columns go round."""
    grown = mask.copy()
    for k in range(1, steps + 1):
        grown[k:] |= mask[:-k]
        grown[:-k] |= mask[k:]
    wide = grown.copy()
    for k in range(1, steps + 1):
        wide |= np.roll(grown, k, axis=1) | np.roll(grown, -k, axis=1)
    return wide


def _plain(point: Int[np.ndarray, "r c"], free: Bool[np.ndarray, "r c"]) -> Int[np.ndarray, "f 3"]:
    """Return the triangles between the rows of a plain grid, of free points alone."""
    parts = []
    for first in (0, 1):
        # The row above an even one lies half a step ahead of it, that above an odd one half a step behind.
        low, high = point[first:-1:2], point[first + 1 :: 2]
        ahead = high if first == 0 else np.roll(high, -1, axis=1)
        parts += [
            np.stack([low, np.roll(low, -1, axis=1), ahead], axis=-1).reshape(-1, 3),
            np.stack([ahead, np.roll(ahead, 1, axis=1), low], axis=-1).reshape(-1, 3),
        ]
    faces = np.concatenate(parts)
    known = np.zeros(point.max() + 2, bool)  # the last is that of a missing point, whose number is -1
    known[point[free]] = True
    return faces[known[faces].all(axis=1)]


def _delaunay(u: np.ndarray, s: np.ndarray, girth: float) -> Int[np.ndarray, "f 3"]:
    """Return Delaunay's triangles of points on a cylinder, from the plane with a strip repeated at either side."""
    low, high = np.flatnonzero(u < _PAD), np.flatnonzero(u > girth - _PAD)
    source = np.concatenate([np.arange(len(u)), low, high])
    shift = np.concatenate([np.zeros(len(u)), np.full(len(low), girth), np.full(len(high), -girth)])
    points = np.column_stack([u[source] + shift, s[source]])
    from scipy.spatial import Delaunay  # half a second to import, and planar tasks do not need it

    faces = Delaunay(points).simplices
    corner = points[faces]
    (ax, ay), (bx, by) = (corner[:, 1] - corner[:, 0]).T, (corner[:, 2] - corner[:, 0]).T
    area = ax * by - ay * bx
    faces = np.where((area < 0)[:, None], faces[:, ::-1], faces)
    middle = points[faces, 0].mean(axis=1)
    return source[faces[(middle >= 0) & (middle < girth) & (np.abs(area) > 1e-12)]]


def _roll_up(shell: Shell, plane: _Unrolled, sheet: _Sheet, pocket: Float[np.ndarray, "r 5"]) -> Triangles:
    """Return the sheet rolled up, its recesses pushed outwards; open at the mouths."""
    vertex = _wall_points(shell, sheet.station, plane.to_angle(sheet.around))
    count, faces, rim = len(vertex), sheet.faces, np.flatnonzero(sheet.rim)
    sunk = np.arange(count)
    sunk[rim] = count + np.arange(len(rim))
    push = np.zeros((count, 3))
    if len(pocket):
        outward = _wall_normals(shell, pocket) * pocket[:, 4:]
        push = np.where(sheet.recess[:, None] >= 0, outward[sheet.recess], 0.0)
    vertex = np.concatenate([np.where(sheet.rim[:, None], vertex, vertex + push), vertex[rim] + push[rim]])
    owner = sheet.recess[faces]
    inside = (owner[:, 0] >= 0) & (owner == owner[:, :1]).all(axis=1)
    faces = np.where(inside[:, None], sunk[faces], faces)
    first = np.flatnonzero(np.diff(sheet.recess[rim], prepend=-1))
    following = rim + 1
    following[np.append(first, len(rim))[1:] - 1] = rim[first]
    sides = [np.column_stack([rim, following, sunk[following]]), np.column_stack([rim, sunk[following], sunk[rim]])]
    return Triangles(vertex, np.concatenate([faces, *sides]))


def _sink(wall: Triangles, sheet: _Sheet, shell: Shell, pocket: Float[np.ndarray, "r 5"]) -> Triangles:
    """Return a wall with recesses that touch others, the seam or a mouth, as the union of the air with their boxes."""
    from manifold3d import Manifold, Mesh64, OpType  # planar tasks do not need it

    caps, n = [], len(wall.vertices)
    for k, station in enumerate((0.0, sheet.station.max())):
        ring = np.flatnonzero((sheet.station == station) & ~sheet.rim)
        ring = ring[np.argsort(sheet.around[ring])]
        after = np.roll(ring, -1)
        caps.append(np.column_stack([np.full(len(ring), n + k), *((after, ring) if k == 0 else (ring, after))]))
    vertices = np.concatenate([wall.vertices, shell.position[[0, -1]]])
    solid = Manifold(Mesh64(vertices, np.concatenate([wall.faces, *caps]).astype(np.uint64)))
    recesses = [Manifold.hull_points(box) for box in _recess_boxes(shell, pocket)]
    whole = solid + Manifold.batch_boolean(recesses, OpType.Add)
    mesh = max(whole.decompose(), key=lambda part: part.volume()).to_mesh64()
    vertices, faces = np.array(mesh.vert_properties[:, :3]), np.array(mesh.tri_verts, np.int64)
    for place in (0, -1):
        flush = np.abs((vertices - shell.position[place]) @ shell.tangent[place]) < 1e-4
        near = np.linalg.norm(vertices - shell.position[place], axis=1) < 2 * shell.radius.max()
        faces = faces[~(flush & near)[faces].all(axis=1)]
    return Triangles(vertices, faces)


def _recess_boxes(shell: Shell, pocket: Float[np.ndarray, "r 5"]) -> Float[np.ndarray, "r 8 3"]:
    """Return corners of some recesses as boxes square to the wall they are sunk into, m."""
    centre, outward = _wall_points(shell, pocket[:, 0], pocket[:, 1]), _wall_normals(shell, pocket)
    tangent = np.stack([np.interp(pocket[:, 0], shell.station, column) for column in shell.tangent.T], axis=-1)
    around = np.cross(outward, tangent)
    along = np.cross(around, outward)
    _, _, length, width, depth = pocket.T[..., None]
    corners = [
        centre + i * length / 2 * along + j * width / 2 * around + reach * outward
        for i in (-1, 1)
        for j in (-1, 1)
        for reach in (np.full_like(depth, -_LID), depth)
    ]
    return np.stack(corners, axis=1)
