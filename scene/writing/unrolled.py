"""The wall rolled out flat, with its recesses: points a grid apart, and their Delaunay triangles.

In the plane of arc length around the section and station along the axis a recess is a rectangle. Because no other point
comes near its rim, Delaunay's triangulation holds the rim's edges, so that recesses need no Boolean operation, which
would leave slivers.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import Delaunay

from scene.bore import Bore
from scene.geometry import arc_length

_LID_OVERLAP = 0.05  # how far a box reaches into the air, so that a union leaves no film


def wall_points(
    bore: Bore, station: Float[np.ndarray, " k"], angle: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "k 3"]:
    """Return points of the smooth wall, bilinear between the sections' points, m."""
    n, m = bore.radius.shape
    row = np.clip(station / (bore.station[1] - bore.station[0]), 0, n - 1)
    column = (angle - bore.angle[0]) / (2 * np.pi) * m
    r, c = np.minimum(row.astype(int), n - 2), np.floor(column).astype(int)
    along, across = (row - r)[:, None], (column - c)[:, None]
    c, d = c % m, (c + 1) % m
    near = _point(bore, r, c) * (1 - across) + _point(bore, r, d) * across
    far = _point(bore, r + 1, c) * (1 - across) + _point(bore, r + 1, d) * across
    return near * (1 - along) + far * along


def _point(bore: Bore, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    radius, angle = bore.radius[row, column, None], bore.angle[column, None]
    return bore.position[row] + radius * (np.cos(angle) * bore.lateral[row] + np.sin(angle) * bore.up[row])


def wall_normals(bore: Bore, pocket: Int[np.ndarray, " r"]) -> Float[np.ndarray, "r 3"]:
    """Return outward unit normals of the wall at some pockets, over an arc of about 5°."""
    m = len(bore.angle)
    row = bore.row_of(bore.pocket["station"][pocket])
    turn = (bore.pocket["angle"][pocket] - bore.angle[0]) / (2 * np.pi) * m
    column, reach = np.rint(turn).astype(int), max(1, m // 144)
    normal = np.cross(
        _point(bore, row, (column + reach) % m) - _point(bore, row, (column - reach) % m), bore.tangent[row]
    )
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def recess_boxes(bore: Bore, pocket: Int[np.ndarray, " r"]) -> list[Float[np.ndarray, "8 3"]]:
    """Return corners of some pockets as boxes square to the wall they are sunk into, m."""
    rows = bore.pocket[pocket]
    centre, outward = wall_points(bore, rows["station"], rows["angle"]), wall_normals(bore, pocket)
    around = np.cross(outward, bore.axis.at(rows["station"]).tangent)
    along = np.cross(around, outward)
    return [np.array([
        centre[k] + i * rows["length"][k] / 2 * along[k] + j * rows["width"][k] / 2 * around[k] + d * outward[k]
        for i in (-1, 1) for j in (-1, 1) for d in (-_LID_OVERLAP, float(rows["depth"][k]))
    ]) for k in range(len(rows))]  # fmt: skip


ALONG, AROUND = 0.18, 0.2  # of the grid, m
_BAND = 0.6 * AROUND  # no grid point is this near a rim or a corner of the section, m
_CORNER = np.radians(30.0)  # a section that turns more than this over four of its angles has a corner there
_PAD = 1.0  # beyond the seam, m


@dataclass(frozen=True)
class Unrolled:
    """The section's arc length as a coordinate, cut open at a seam."""

    around: Float[np.ndarray, " k"]  # Arc length from the seam at each of `angle`, m
    angle: Float[np.ndarray, " k"]  # rad, growing over one turn from the seam

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
class Sheet:
    """Triangles in the plane."""

    around: Float[np.ndarray, " p"]  # Arc length of each point, m
    station: Float[np.ndarray, " p"]  # Station of each point, m
    recess: Int[np.ndarray, " p"]  # Number of the recess that a point belongs to, -1 for none
    rim: Bool[np.ndarray, " p"]  # Points on the rim of their recess
    faces: Int[np.ndarray, "f 3"]  # Counter-clockwise with `around` to the right and `station` upwards


def unroll_section(bore: Bore) -> Unrolled:
    """Return the mean section's arc length; the seam is in the widest gap between recesses, else at the floor."""
    taken = np.sort(bore.pocket["angle"] % (2 * np.pi))
    gap = np.diff(np.append(taken, taken[0] + 2 * np.pi)) if len(taken) else np.empty(0)
    seam = taken[np.argmax(gap)] + gap.max() / 2 if len(taken) else 1.5 * np.pi
    order = np.argsort((bore.angle - seam) % (2 * np.pi))
    turn = (bore.angle[order] - seam) % (2 * np.pi)
    angle = np.concatenate([[0.0], turn, [2 * np.pi]]) + seam
    mean = np.interp(angle, bore.angle, bore.radius.mean(0), period=2 * np.pi)
    outline = mean[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return Unrolled(arc_length(outline), angle)


def section_corners(bore: Bore) -> Float[np.ndarray, " c"]:
    """Return the angles at which the mean section has a corner, rad, such as a horseshoe's feet."""
    radius = bore.radius.mean(axis=0)
    outline = radius[:, None] * np.column_stack([np.cos(bore.angle), np.sin(bore.angle)])
    edge = np.roll(outline, -2, axis=0) - outline
    before = np.roll(edge, 2, axis=0)
    turn = np.arctan2(before[:, 0] * edge[:, 1] - before[:, 1] * edge[:, 0], np.sum(before * edge, axis=1))
    near = np.max([np.roll(turn, k) for k in range(-6, 7)], axis=0)
    return bore.angle[(turn >= near) & (turn > _CORNER)]


def triangulate(
    plane: Unrolled, length: float, fold: Float[np.ndarray, " c"], boxes: Float[np.ndarray, "r 4"]
) -> Sheet:
    """Triangulates one turn over the whole length, m, with edges along the axis at the arc lengths `fold`, m.

    Boxes are recesses as least and greatest arc length, least and greatest station, m. They are 0.6 grid steps clear of
    one another, of the seam and of the mouths.
    """
    u, s = _grid(plane.girth, length, fold)
    recess, clear = np.full(len(u), -1), np.ones(len(u), bool)
    for k, (u0, u1, s0, s1) in enumerate(boxes):
        rows = slice(*np.searchsorted(s, [s0 - _BAND, s1 + _BAND]))
        inside = np.minimum(np.minimum(u[rows] - u0, u1 - u[rows]), np.minimum(s[rows] - s0, s1 - s[rows]))
        clear[rows] &= np.abs(inside) > _BAND
        recess[rows] = np.where(inside > _BAND, k, recess[rows])
    rims = [_rim(box) for box in boxes]
    owner = np.repeat(np.arange(len(boxes)), [len(rim) for rim in rims])
    u = np.concatenate([u[clear], *(rim[:, 0] for rim in rims)])
    s = np.concatenate([s[clear], *(rim[:, 1] for rim in rims)])
    rim = np.arange(len(u)) >= clear.sum()
    return Sheet(u, s, np.concatenate([recess[clear], owner]), rim, _delaunay(u, s, plane.girth))


def _grid(girth: float, length: float, fold: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points in rows by station, every second row half a step aside, with a point of each row on every fold."""
    columns, rows = max(round(girth / AROUND), 8), max(round(length / ALONG), 2)
    step = girth / columns
    station = np.linspace(0.0, length, rows + 1)
    u = (np.arange(columns) + np.where(np.arange(rows + 1) % 2, 0.75, 0.25)[:, None]) * step
    distance = np.abs((u[..., None] - fold + girth / 2) % girth - girth / 2).min(axis=-1, initial=np.inf)
    clear = distance > _BAND
    u = np.concatenate([u[clear], np.tile(fold, rows + 1)])
    s = np.concatenate([np.repeat(station, columns)[clear.ravel()], np.repeat(station, len(fold))])
    order = np.lexsort([u, s])
    return u[order], s[order]


def _rim(box: Float[np.ndarray, "4"]) -> Float[np.ndarray, "k 2"]:
    """Points on a rectangle's outline, counter-clockwise, a grid step or less apart."""
    u0, u1, s0, s1 = box
    across, along = (max(int(np.ceil(size / AROUND - 1e-6)), 1) for size in (u1 - u0, s1 - s0))
    u, s = np.linspace(u0, u1, across + 1), np.linspace(s0, s1, along + 1)
    sides = [(u[:-1], s0), (u1, s[:-1]), (u[:0:-1], s1), (u0, s[:0:-1])]
    return np.concatenate([np.column_stack(np.broadcast_arrays(*side)) for side in sides])


def _delaunay(u: np.ndarray, s: np.ndarray, girth: float) -> Int[np.ndarray, "f 3"]:
    """Delaunay's triangles of points on a cylinder, from the plane with a strip repeated at either side."""
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
