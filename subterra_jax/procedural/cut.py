"""The planar tunnel of a drawn bore: its cut by the plane of the planar LiDAR."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from subterra_jax.procedural.bore import N_ANGLES, Bore, is_met
from subterra_jax.procedural.fixtures import Boxes
from subterra_jax.procedural.geometry import Alignment
from subterra_jax.tunnel.arrays import cut_pockets
from subterra_jax.tunnel.plan import Lining, Wall

SIDES = {"left": 1.0, "right": -1.0}
_AROUND = 9  # columns of the grid to either side of the design wall, in which the wall is looked for
_TOLERANCE = 0.001  # m by which a wall may move when vertices are left out
_PASSES = 4  # each leaves out at most every second vertex
_SLIT = 1e-3  # m between two features of one wall


Cut = dict[str, Float[np.ndarray, " n"]]


def plane_walls(bore: Bore, smooth: bool = False) -> Cut:
    """Return the cut of the wall without pockets and fixtures, or without any relief.

    Returns:
        By side: distance from the axis at the stations of the bore's grid, m, `(n,)`.
    """
    cut = {}
    for name, side in SIDES.items():
        height = float(bore.mount.plane(side * bore.section.half_width))
        lateral = bore.shift + side * float(bore.section.wall(height))
        usual = int(np.rint(np.mod(np.arctan2(height - bore.middle, lateral), 2.0 * np.pi) / (2.0 * np.pi) * N_ANGLES))
        # On the right the angle falls as the wall rises.
        columns = np.mod(usual + int(side) * np.arange(-_AROUND, _AROUND + 1), N_ANGLES)
        angle = bore.grid.angle[usual % N_ANGLES] + side * 2.0 * np.pi / N_ANGLES * np.arange(-_AROUND, _AROUND + 1)
        radius = bore.radius(columns, smooth)
        y, z = radius * np.cos(angle), bore.middle + radius * np.sin(angle)
        above = z - bore.mount.plane(y)
        upper = np.clip(np.argmax(above > 0.0, axis=1), 1, len(columns) - 1)
        rows = np.arange(len(radius))
        low, high = above[rows, upper - 1], above[rows, upper]
        fraction = -low / (high - low)
        cut[name] = side * (y[rows, upper - 1] + fraction * (y[rows, upper] - y[rows, upper - 1]))
    return cut


def cut_lining(bore: Bore, alignment: Alignment, variant: str, rough: Cut) -> Lining:
    """Return one variant of the walls in the plane.

    Walkways whose top is above the plane are the wall there. A vertex is left out where the wall stays within 1 mm.

    Args:
        variant: `built`, `bare` (without furniture) or `smooth` (design section).
        rough: Result of `plane_walls`.
    """
    walls = plane_walls(bore, smooth=True) if variant == "smooth" else rough
    made = {name: _side(bore, alignment, SIDES[name], walls[name], variant) for name in SIDES}
    return Lining(made["left"], made["right"], np.zeros((0, 4)))


def _side(bore: Bore, alignment: Alignment, side: float, distance: np.ndarray, variant: str) -> Wall:
    station = bore.grid.station
    bench = next((b for b in bore.benches if b.side == side), None)
    if variant != "smooth":
        rows = _crossed(bore, side, distance, variant)
        if variant == "built" and bench is not None and is_met(bench, bore.mount, bore.section):
            edge = bore.bench_edge(bench)
            rows = rows[_beyond(rows, station, distance) < edge]
            distance = np.minimum(distance, edge)
        station, distance = cut_pockets(station, distance, rows[:, 0], rows[:, 1], rows[:, 2])
    vertex = alignment.offset(station, side * distance)
    kept = _needed(vertex)
    return Wall(vertex[kept], station[kept])


def _beyond(rows: np.ndarray, station: np.ndarray, distance: np.ndarray) -> Float[np.ndarray, " r"]:
    """Return the distance of the backs of features from the axis, m."""
    return np.interp(rows[:, 0], station, distance) + rows[:, 2]


def _crossed(bore: Bore, side: float, distance: np.ndarray, variant: str) -> Float[np.ndarray, "r 3"]:
    """Return recesses and boxes of one wall that the plane crosses: begin, length, depth (below 0 for a box), m."""
    recess = [bore.pocket, bore.niche, *([bore.recess] if variant == "built" else [])]
    boxes = [bore.box, *([bore.furniture] if variant == "built" else [])]
    station = bore.grid.station
    parts = [_recesses(np.concatenate(recess), station, distance, side, bore)]
    parts += [_boxes(some, station, distance, side, bore) for some in boxes]
    rows = np.concatenate(parts)
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    # Features of one wall keep apart as they are drawn; a plane that leans may still graze two at one station.
    end = np.concatenate([[-np.inf], np.maximum.accumulate(rows[:, 0] + rows[:, 1])[:-1]])
    return rows[rows[:, 0] > end + _SLIT]


def _recesses(
    rows: np.ndarray, station: np.ndarray, distance: np.ndarray, side: float, bore: Bore
) -> Float[np.ndarray, "r 3"]:
    """Return the recesses that the plane crosses. It leaves one through its back or, leaning, through its top or foot.

    A recess is the wall within its rim, moved along the wall's normal at its middle.
    """
    rows = rows[np.sign(np.cos(rows[:, 1])) == side]
    height = bore.heights_of(rows)
    rise = bore.section.slope(height)
    across, upward = 1.0 / np.hypot(1.0, rise), -rise / np.hypot(1.0, rise)
    reach = 0.5 * rows[:, 3] * across
    lateral = np.interp(rows[:, 0], station, distance)
    plane = bore.mount.plane(side * lateral)
    # Depth at which the plane leaves the recess: through the back, or earlier through a rim above or below.
    rim = np.where(upward > 0.0, plane - (height - reach), (height + reach) - plane)
    depth = np.minimum(rows[:, 4], rim / np.maximum(np.abs(upward), 1e-9))
    out = bore.section.wall(plane - depth * upward) + depth * across - bore.section.wall(plane)
    crossed = (np.abs(plane - height) < reach) & (out > 1e-3)
    return np.column_stack([rows[:, 0] - 0.5 * rows[:, 2], rows[:, 2], out])[crossed]


def _boxes(
    boxes: Boxes, station: np.ndarray, distance: np.ndarray, side: float, bore: Bore
) -> Float[np.ndarray, "r 3"]:
    """Return the boxes that the plane crosses, as recesses of negative depth."""
    plane = bore.mount.plane(boxes.side * boxes.face)
    some = boxes.where((boxes.side == side) & (boxes.low < plane) & (plane < boxes.high))
    wall = np.minimum(np.interp(some.start, station, distance), np.interp(some.end, station, distance))
    out = wall - some.face
    return np.column_stack([some.start, some.end - some.start, -out])[out > 1e-3]


def _needed(vertex: Float[np.ndarray, "v 2"]) -> np.ndarray:
    """Return the vertices without which the wall would move by more than the tolerance."""
    kept = np.arange(len(vertex))
    for number in range(_PASSES):
        points = vertex[kept]
        inner = np.arange(1 + number % 2, len(kept) - 1, 2)
        before, at, after = points[inner - 1], points[inner], points[inner + 1]
        edge, way = after - before, at - before
        size = np.maximum(np.hypot(edge[:, 0], edge[:, 1]), 1e-12)
        off = np.abs(edge[:, 0] * way[:, 1] - edge[:, 1] * way[:, 0]) / size
        along = np.sum(edge * way, axis=1) / size
        flat = (off < _TOLERANCE / _PASSES) & (along > 0.0) & (along < size)
        kept = np.delete(kept, inner[flat])
    return kept
