"""The lining as boxes to collide with: flat patches all around, and a few panels at robots' height.

MuJoCo collides a mesh as its convex hull, which of a bore is the bore filled up.
"""

from dataclasses import dataclass
from itertools import pairwise
from xml.etree import ElementTree as ET

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from shapely import LineString, Point

from scene.bore import Bore
from scene.geometry import arc_length
from scene.writing.markup import add_box, cross_product, rotation_along
from scene.writing.planar import Walls
from scene.writing.track import Track
from subterra_jax.host.rover import LOW_WALL, SOLID

_PATCH_TOLERANCE = 0.015  # of a patch from its wall, m
_STRETCH = 6.0  # longest patch, m
_LEAST = 3  # points along a patch's side below which it is not divided
_OVERLAP = 0.01  # m by which panels reach over their edges
_THICKNESS = 0.10  # m of a panel
_ON_BED = 0.03  # wall this little above the bed is floor, m


@dataclass(frozen=True)
class Panel:
    """A box behind the wall."""

    centre: Float[np.ndarray, "3"]  # m
    rotation: Rotation  # X along the bore, y around it, z out of the air
    half: Float[np.ndarray, "3"]  # Half its sizes, m
    height: tuple[float, float]  # Lowest and highest point above the bed, m


@dataclass(frozen=True)
class Opening:
    """Rows and columns of the bore's grid that a niche takes out of the wall, first and last of each."""

    rows: tuple[int, int]
    columns: tuple[int, int]


def wall_panels(bore: Bore, bed: Float[np.ndarray, " n"], openings: list[Opening]) -> list[Panel]:
    """Return boxes within about a centimetre of the smooth wall, but not below the bed or in openings."""
    surface, (n, m) = bore.surface(), bore.radius.shape
    above = surface[..., 2] - bed[:, None]
    floor = above.mean(axis=0) < _ON_BED
    start = int(np.flatnonzero(floor)[len(np.flatnonzero(floor)) // 2]) if floor.any() else 0
    turn = (start + np.arange(m + 1)) % m
    cuts = {0, n - 1} | {row for opening in openings for row in opening.rows}
    stretches = [stretch for r0, r1 in pairwise(sorted(cuts)) for stretch in _stretches(bore.station, r0, r1)]
    panels: list[Panel] = []
    for around in pairwise(_breaks_around(bore, floor, turn)):
        if floor[turn[around[0] : around[1] + 1]].mean() > 0.5:
            continue
        for first, last in stretches:
            for low, high in _columns_left(openings, (first, last), around, turn):
                columns = turn[low : high + 1]
                _divide_patch(surface[first : last + 1][:, columns], above[first : last + 1][:, columns], panels)
    return panels


def _breaks_around(bore: Bore, floor: np.ndarray, turn: np.ndarray) -> list[int]:
    """Return the places in `turn` at which the mean section bends, or meets the bed; the first and the last too."""
    outline = bore.radius.mean(axis=0)[:, None] * np.column_stack([np.cos(bore.angle), np.sin(bore.angle)])
    vertices = np.asarray(LineString(outline[turn]).simplify(_PATCH_TOLERANCE).coords)
    breaks = {int(np.argmin(np.linalg.norm(outline[turn[:-1]] - point, axis=1))) for point in vertices}
    edge = np.flatnonzero(np.diff(floor[turn].astype(int)))
    breaks |= {int(k) + int(floor[turn[k]]) for k in edge}
    return sorted(breaks | {0, len(turn) - 1})


def _stretches(station: np.ndarray, start: int, end: int) -> list[tuple[int, int]]:
    """Return the first and last rows of even stretches between two rows, of about `_STRETCH` each."""
    pieces = max(int(np.ceil((station[end] - station[start]) / _STRETCH - 1e-6)), 1)
    rows = np.rint(np.linspace(start, end, pieces + 1)).astype(int).tolist()
    return list(pairwise(sorted(set(rows))))


def _columns_left(
    openings: list[Opening], rows: tuple[int, int], columns: tuple[int, int], turn: np.ndarray
) -> list[tuple[int, int]]:
    """Return the columns of a stretch that no opening takes, as first and last place in `turn`."""
    low, high = columns
    for opening in openings:
        if opening.rows[0] <= rows[0] and rows[1] <= opening.rows[1]:
            first, last = sorted(int(np.flatnonzero(turn == column)[0]) for column in opening.columns)
            if first < high and low < last:
                return [(a, b) for a, b in ((low, min(high, first)), (max(low, last), high)) if b > a]
    return [(low, high)]


def _divide_patch(points: Float[np.ndarray, "r c 3"], above: Float[np.ndarray, "r c"], panels: list[Panel]) -> None:
    """Adds one panel where the patch is flat, else those of its halves, cut across the bend."""
    centre = points.mean(axis=(0, 1))
    x = points[-1].mean(axis=0) - points[0].mean(axis=0)
    x /= np.linalg.norm(x)
    y = points[:, -1].mean(axis=0) - points[:, 0].mean(axis=0)
    z = cross_product(y - (y @ x) * x, x)
    z /= np.linalg.norm(z)
    offset = points - centre
    local = np.stack([offset @ x, offset @ cross_product(z, x), offset @ z], axis=-1).reshape(-1, 3)
    slope = np.linalg.lstsq(np.column_stack([local[:, :2], np.ones(len(local))]), local[:, 2], rcond=None)[0]
    error = (local[:, 2] - local[:, :2] @ slope[:2] - slope[2]).reshape(points.shape[:2])
    rows, columns = points.shape[:2]
    if np.abs(error).max() > _PATCH_TOLERANCE and max(rows, columns) > _LEAST:
        bends = [np.ptp(error.mean(axis=axis)) for axis in (1, 0)]
        down = bends[0] > bends[1] if min(rows, columns) > _LEAST else rows > columns
        half = (rows if down else columns) // 2
        for part in (slice(None, half + 1), slice(half, None)):
            index = part if down else (slice(None), part)
            _divide_patch(points[index], above[index], panels)
        return
    z = z - slope[0] * x - slope[1] * cross_product(z, x)
    z /= np.linalg.norm(z)
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    frame = np.stack([x, cross_product(z, x), z], axis=1)
    inside = (points.reshape(-1, 3) - centre) @ frame
    low, high = inside.min(axis=0), inside.max(axis=0)
    middle = (low + high) / 2
    middle[2] = inside[:, 2].mean() + _THICKNESS / 2
    half_size = np.array([*((high - low)[:2] / 2 + _OVERLAP), _THICKNESS / 2])
    span = (float(above.min()), float(above.max()))
    panels.append(Panel(centre + frame @ middle, Rotation.from_matrix(frame), half_size, span))


_LINE_TOLERANCE = 0.02  # m from the polyline of a wall
_HEIGHT = 2.5  # m of a low panel
_DEPTH = 0.3  # below the top of the sleepers


def add_patches(world: ET.Element, bore: Bore, track: Track, openings: list[Opening]) -> int:
    """Adds invisible boxes behind the whole lining; returns how many."""
    panels = wall_panels(bore, track.bed, openings)
    for k, panel in enumerate(panels):
        add_box(world, f"wall_{k:05d}", panel.half, panel.centre, panel.rotation, SOLID, group="3")
    return len(panels)


def add_low_panels(world: ET.Element, walls: Walls, bore: Bore, track: Track, niches: list[tuple[float, float]]) -> int:
    """Adds upright boxes behind both walls at robots' height, within 2 cm of the wall's polyline; returns how many.

    `niches` of the left wall, as first and last station in m, are left open.
    """
    count = 0
    for side, name, wall, station in (
        (1, "left", walls.left, walls.left_station),
        (-1, "right", walls.right, walls.right_station),
    ):
        line = LineString(wall)
        vertices = np.asarray(line.simplify(_LINE_TOLERANCE).coords)
        arc = arc_length(wall)
        vertex_station = np.interp([line.project(Point(vertex)) for vertex in vertices], arc, station)
        gaps = niches if side == 1 else []
        cut = np.array([end for gap in gaps for end in gap])
        on_line = [line.interpolate(float(at)) for at in np.interp(cut, station, arc)]
        order = np.argsort(np.append(vertex_station, cut), kind="stable")
        vertices = np.concatenate([vertices, np.array([(at.x, at.y) for at in on_line]).reshape(-1, 2)])[order]
        vertex_station = np.append(vertex_station, cut)[order]
        middle_height = np.interp(vertex_station, bore.station, track.elevation) + _HEIGHT / 2 - _DEPTH
        ends = np.column_stack([vertices, middle_height])
        for k in range(len(ends) - 1):
            if any(first <= vertex_station[k : k + 2].mean() <= last for first, last in gaps):
                continue
            rotation = rotation_along(ends[k], ends[k + 1])
            middle = (ends[k] + ends[k + 1]) / 2 + rotation.apply([0, side * _THICKNESS / 2, 0])
            size = np.array([np.linalg.norm(ends[k + 1] - ends[k]) / 2 + 0.01, _THICKNESS / 2, _HEIGHT / 2])
            add_box(world, f"low_wall_{name}_{k:03d}", size, middle, rotation, LOW_WALL, group="3")
            count += 1
    return count


def add_niche(world: ET.Element, name: str, corners: Float[np.ndarray, "8 3"]) -> None:
    """Adds boxes behind the five sides of a niche.

    Bit 2 of a corner's number is along the bore, bit 1 around it, bit 0 into the wall.
    """
    grid = corners.reshape(2, 2, 2, 3)
    edges = [grid[1, 0, 0] - grid[0, 0, 0], grid[0, 1, 0] - grid[0, 0, 0], grid[0, 0, 1] - grid[0, 0, 0]]
    half = np.array([np.linalg.norm(edge) for edge in edges]) / 2
    frame = np.stack([edge / np.linalg.norm(edge) for edge in edges], axis=1)
    turned = frame * [1.0, np.sign(np.linalg.det(frame)), 1.0]
    centre, thin = corners.mean(axis=0), _THICKNESS / 2
    for side, axis, sign in (("back", 2, 1), ("near", 0, -1), ("far", 0, 1), ("below", 1, -1), ("above", 1, 1)):
        size = np.where(np.arange(3) == axis, thin, half)
        middle = centre + sign * (half[axis] + thin) * frame[:, axis]
        add_box(world, f"{name}_{side}", size, middle, Rotation.from_matrix(turned), SOLID | LOW_WALL, group="3")
