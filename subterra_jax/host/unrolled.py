"""A wall unrolled, with its recesses: points a grid apart, and their Delaunay triangles.

In the plane of arc length around the section and station along the axis a recess is a rectangle. Because no other point
comes near its rim, Delaunay's triangulation holds the rim's edges, so that recesses need no Boolean operation, which
would leave slivers. The meshes of a scene and the surface that the LiDAR in three dimensions sees are made of it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

BAND = 0.6  # fraction of the spacing around within which no grid point is near a rim or a corner of the section
_CORNER = np.radians(30.0)  # a section that turns more than this over four of its angles has a corner there
_PAD = 1.0  # of the sheet, repeated beyond the seam, m
_LID = 0.05  # of a recess's box inside the bore, so that a union leaves no film, m
_FLUSH = 1e-4  # from the plane of a mouth, m


class Sections(NamedTuple):
    """A bore as sections along its axis."""

    station: Float[np.ndarray, " n"]  # m, from 0, uniform
    position: Float[np.ndarray, "n 3"]  # of the axis, m
    tangent: Float[np.ndarray, "n 3"]  # unit vectors, as are `left` and `up`
    left: Float[np.ndarray, "n 3"]
    up: Float[np.ndarray, "n 3"]
    angle: Float[np.ndarray, " m"]  # from `left` towards `up`, rad
    radius: Float[np.ndarray, "n m"]  # distance of the smooth wall from the axis, m

    def points(self, station: Float[np.ndarray, " k"], angle: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k 3"]:
        """Return points of the smooth wall, bilinear between the sections' points, m."""
        n, m = self.radius.shape
        row = np.clip(station / (self.station[1] - self.station[0]), 0, n - 1)
        column = (angle - self.angle[0]) / (2 * np.pi) * m
        r, c = np.minimum(row.astype(int), n - 2), np.floor(column).astype(int)
        along, across = (row - r)[:, None], (column - c)[:, None]
        c, d = c % m, (c + 1) % m
        near = self._node(r, c) * (1 - across) + self._node(r, d) * across
        far = self._node(r + 1, c) * (1 - across) + self._node(r + 1, d) * across
        return near * (1 - along) + far * along

    def _node(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        radius, angle = self.radius[row, column, None], self.angle[column, None]
        return self.position[row] + radius * (np.cos(angle) * self.left[row] + np.sin(angle) * self.up[row])

    def normals(self, station: Float[np.ndarray, " r"], angle: Float[np.ndarray, " r"]) -> Float[np.ndarray, "r 3"]:
        """Return outward unit normals of the smooth wall, over an arc of about 5°."""
        m = len(self.angle)
        row = np.rint(station / (self.station[1] - self.station[0])).astype(int)
        row = np.clip(row, 0, len(self.station) - 1)
        column, reach = np.rint((angle - self.angle[0]) / (2 * np.pi) * m).astype(int), max(1, m // 144)
        before, after = (self._node(row, (column + side * reach) % m) for side in (-1, 1))
        normal = np.cross(after - before, self.tangent[row])
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    def recess_boxes(
        self, pocket: Float[np.ndarray, "r 5"], tangent: Float[np.ndarray, "r 3"]
    ) -> Float[np.ndarray, "r 8 3"]:
        """Return corners of recesses as boxes square to the wall they are sunk into, m.

        Args:
            pocket: Station, m, angle, rad, length, width and depth, m, of each.
            tangent: Direction of the axis at each.
        """
        centre, outward = self.points(pocket[:, 0], pocket[:, 1]), self.normals(pocket[:, 0], pocket[:, 1])
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


@dataclass(frozen=True)
class Unrolled:
    """A section's arc length as a coordinate, cut open at a seam."""

    around: Float[np.ndarray, " k"]  # arc length from the seam at each of `angle`, m
    angle: Float[np.ndarray, " k"]  # rad, growing over one turn from the seam

    @property
    def girth(self) -> float:
        """Length of the section's outline, m."""
        return float(self.around[-1])

    def to_angle(self, around: np.ndarray | float) -> np.ndarray:
        """Return the angle at an arc length, rad."""
        return np.asarray(np.interp(around, self.around, self.angle))

    def to_around(self, angle: np.ndarray | float) -> np.ndarray:
        """Return the arc length at any angle, m, in one turn from the seam."""
        turn = (np.asarray(angle) - self.angle[0]) % (2 * np.pi)
        return np.asarray(np.interp(turn + self.angle[0], self.angle, self.around))


@dataclass(frozen=True)
class Sheet:
    """Triangles in the plane."""

    around: Float[np.ndarray, " p"]  # arc length of each point, m
    station: Float[np.ndarray, " p"]  # station of each point, m
    recess: Int[np.ndarray, " p"]  # number of the recess that a point belongs to, -1 for none
    rim: Bool[np.ndarray, " p"]  # points on the rim of their recess
    faces: Int[np.ndarray, "f 3"]  # counter-clockwise with `around` to the right and `station` upwards


def unroll(angle: Float[np.ndarray, " m"], radius: Float[np.ndarray, " m"], seam: float) -> Unrolled:
    """Return the arc length of a section, radius in m by angle in rad, from a seam on."""
    order = np.argsort((angle - seam) % (2 * np.pi))
    turn = (angle[order] - seam) % (2 * np.pi)
    whole = np.concatenate([[0.0], turn, [2 * np.pi]]) + seam
    mean = np.interp(whole, angle, radius, period=2 * np.pi)
    outline = mean[:, None] * np.column_stack([np.cos(whole), np.sin(whole)])
    around = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
    return Unrolled(around, whole)


def corners(angle: Float[np.ndarray, " m"], radius: Float[np.ndarray, " m"]) -> Float[np.ndarray, " c"]:
    """Return the angles at which a section has a corner, rad, such as a horseshoe's feet."""
    outline = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    edge = np.roll(outline, -2, axis=0) - outline
    before = np.roll(edge, 2, axis=0)
    turn = np.arctan2(before[:, 0] * edge[:, 1] - before[:, 1] * edge[:, 0], np.sum(before * edge, axis=1))
    near = np.max([np.roll(turn, k) for k in range(-6, 7)], axis=0)
    return angle[(turn >= near) & (turn > _CORNER)]


def rectangles(
    plane: Unrolled, length: float, pocket: Float[np.ndarray, "r 5"], clear: float
) -> tuple[Float[np.ndarray, "r 4"], Bool[np.ndarray, " r"]]:
    """Return each recess's rectangle in the plane, and whether it is `clear`, m, of others, the seam and the mouths.

    A rectangle is least and greatest arc length, least and greatest station, m; recesses as for `recess_boxes`.
    """
    u, (station, _, long, wide, _) = plane.to_around(pocket[:, 1]), pocket.T
    box = np.column_stack([u - wide / 2, u + wide / 2, station - long / 2, station + long / 2])
    apart = (box[:, 0] > clear) & (box[:, 1] < plane.girth - clear)
    apart &= (box[:, 2] > clear) & (box[:, 3] < length - clear)
    order = np.argsort(box[:, 2], kind="stable")
    for place, k in enumerate(order):
        last = np.searchsorted(box[order, 2], box[k, 3] + clear)
        others = order[place + 1 : last]
        near = (box[others, 0] < box[k, 1] + clear) & (box[others, 1] > box[k, 0] - clear)
        apart[others[near]] = False
    return box, apart


class Grid(NamedTuple):
    """Points in rows by station, every second row half a step aside, and one of each row on every fold."""

    around: Float[np.ndarray, " p"]  # arc length of each point, m
    station: Float[np.ndarray, " p"]  # its station, m
    node: Int[np.ndarray, " p"]  # row times columns plus column; -1 of points on folds and rims
    shape: tuple[int, int]  # rows and columns


def triangulate(
    plane: Unrolled,
    length: float,
    fold: Float[np.ndarray, " c"],
    boxes: Float[np.ndarray, "r 4"],
    spacing: tuple[float, float],
    near: tuple[float, float] = (-np.inf, np.inf),
    faces_of: Callable[[Grid], Int[np.ndarray, "f 3"]] | None = None,
) -> Sheet:
    """Triangulates one turn, with edges along the axis at the arc lengths `fold`, m.

    Args:
        length: Of the whole, m.
        boxes: Rectangles of recesses that are clear of one another, of the seam and of the mouths.
        spacing: Of the points along and around, m.
        near: Stations between which it is done, m.
        faces_of: What finds the triangles of points; Delaunay's of all where none is given.
    """
    band = BAND * spacing[1]
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
    faces = faces_of(Grid(u, s, node, grid.shape)) if faces_of is not None else delaunay(u, s, plane.girth)
    return Sheet(u, s, np.concatenate([recess[clear], owner]), np.arange(len(u)) >= clear.sum(), faces)


def _grid(girth: float, length: float, fold: np.ndarray, spacing: tuple[float, float]) -> Grid:
    columns, rows = max(round(girth / spacing[1]), 8), max(round(length / spacing[0]), 2)
    station = np.linspace(0.0, length, rows + 1)
    u = (np.arange(columns) + np.where(np.arange(rows + 1) % 2, 0.75, 0.25)[:, None]) * (girth / columns)
    distance = np.abs((u[..., None] - fold + girth / 2) % girth - girth / 2).min(axis=-1, initial=np.inf)
    clear = distance > BAND * spacing[1]
    u = np.concatenate([u[clear], np.tile(fold, rows + 1)])
    s = np.concatenate([np.repeat(station, columns)[clear.ravel()], np.repeat(station, len(fold))])
    node = np.concatenate([np.flatnonzero(clear), np.full((rows + 1) * len(fold), -1)])
    order = np.lexsort([u, s])
    return Grid(u[order], s[order], node[order], (rows + 1, columns))


def _rim(box: Float[np.ndarray, "4"], step: float) -> Float[np.ndarray, "k 2"]:
    """Return points on a rectangle's outline, counter-clockwise, a step or less apart."""
    u0, u1, s0, s1 = box
    across, along = (max(int(np.ceil(size / step - 1e-6)), 1) for size in (u1 - u0, s1 - s0))
    u, s = np.linspace(u0, u1, across + 1), np.linspace(s0, s1, along + 1)
    sides = [(u[:-1], s0), (u1, s[:-1]), (u[:0:-1], s1), (u0, s[:0:-1])]
    return np.concatenate([np.column_stack(np.broadcast_arrays(*side)) for side in sides])


def delaunay(u: np.ndarray, s: np.ndarray, girth: float) -> Int[np.ndarray, "f 3"]:
    """Return Delaunay's triangles of points on a cylinder, from the plane with a strip repeated at either side."""
    from scipy.spatial import Delaunay  # half a second to import, and planar tasks do not need it

    low, high = np.flatnonzero(u < _PAD), np.flatnonzero(u > girth - _PAD)
    source = np.concatenate([np.arange(len(u)), low, high])
    shift = np.concatenate([np.zeros(len(u)), np.full(len(low), girth), np.full(len(high), -girth)])
    points = np.column_stack([u[source] + shift, s[source]])
    faces = Delaunay(points).simplices
    corner = points[faces]
    (ax, ay), (bx, by) = (corner[:, 1] - corner[:, 0]).T, (corner[:, 2] - corner[:, 0]).T
    area = ax * by - ay * bx
    faces = np.where((area < 0)[:, None], faces[:, ::-1], faces)
    middle = points[faces, 0].mean(axis=1)
    return source[faces[(middle >= 0) & (middle < girth) & (np.abs(area) > 1e-12)]]


def roll_up(
    sections: Sections, plane: Unrolled, sheet: Sheet, pocket: Float[np.ndarray, "r 5"]
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Return vertices, m, and faces of the sheet rolled up, its recesses pushed outwards; open at the mouths."""
    vertex = sections.points(sheet.station, plane.to_angle(sheet.around))
    count, faces, rim = len(vertex), sheet.faces, np.flatnonzero(sheet.rim)
    sunk = np.arange(count)
    sunk[rim] = count + np.arange(len(rim))
    push = np.zeros((count, 3))
    if len(pocket):
        outward = sections.normals(pocket[:, 0], pocket[:, 1]) * pocket[:, 4:]
        push = np.where(sheet.recess[:, None] >= 0, outward[sheet.recess], 0.0)
    vertex = np.concatenate([np.where(sheet.rim[:, None], vertex, vertex + push), vertex[rim] + push[rim]])
    owner = sheet.recess[faces]
    inside = (owner[:, 0] >= 0) & (owner == owner[:, :1]).all(axis=1)
    faces = np.where(inside[:, None], sunk[faces], faces)
    first = np.flatnonzero(np.diff(sheet.recess[rim], prepend=-1))
    following = rim + 1
    following[np.append(first, len(rim))[1:] - 1] = rim[first]
    sides = [np.column_stack([rim, following, sunk[following]]), np.column_stack([rim, sunk[following], sunk[rim]])]
    return vertex, np.concatenate([faces, *sides])


def close_mouths(
    sections: Sections, sheet: Sheet, vertex: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """Return a wall rolled up as a closed surface: fans about the axis at both ends."""
    caps, n = [], len(vertex)
    for k, station in enumerate((0.0, sheet.station.max())):
        ring = np.flatnonzero((sheet.station == station) & ~sheet.rim)
        ring = ring[np.argsort(sheet.around[ring])]
        after = np.roll(ring, -1)
        caps.append(np.column_stack([np.full(len(ring), n + k), *((after, ring) if k == 0 else (ring, after))]))
    return np.concatenate([vertex, sections.position[[0, -1]]]), np.concatenate([faces, *caps])


def open_mouths(
    sections: Sections, vertex: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Int[np.ndarray, "g 3"]:
    """Return the faces that do not lie in the plane of a mouth."""
    keep = np.ones(len(faces), bool)
    for place in (0, -1):
        flush = np.abs((vertex - sections.position[place]) @ sections.tangent[place]) < _FLUSH
        near = np.linalg.norm(vertex - sections.position[place], axis=1) < 2 * sections.radius.max()
        keep &= ~(flush & near)[faces].all(axis=1)
    return faces[keep]
