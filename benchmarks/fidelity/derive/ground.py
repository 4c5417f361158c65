"""The ground that a small robot drives on, of candidate and reference.

A step of 10 cm stops the robot. Sleepers (6 cm above the ballast) do not, rails (18 cm above the sleepers) do: it
drives between the rails, and may drive beside them, but cannot change over. Steps are those between cells of 10 cm.
There is a cell around every centimetre across, so that the edge of a lane moves by centimetres: in cells side by side
a millimetre of rail more or less takes or gives a whole one.
"""

from dataclasses import dataclass, replace

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import distance_transform_edt, label
from skimage.graph import MCP_Geometric

from benchmarks.fidelity.case import Case, kept_until, per_case, per_reference
from benchmarks.fidelity.derive.axis import hold_curve, hold_local, lining_curve, reference_curve
from benchmarks.fidelity.derive.beams import synthetic_points
from benchmarks.fidelity.derive.curve import Curve, grouped_median
from benchmarks.fidelity.derive.sections import Radii, lining_radii, sections, truth_caster, truth_radii, widths
from benchmarks.fidelity.derive.surface import Caster, surface_caster

GROUND_CELL = 0.10  # m
GROUND_HALF = 3.5  # m to either side
STEP_MOST = 0.10  # m; a higher one stops the robot
HEADROOM_LEAST = 0.80  # m
MOUTH_MARGIN = 0.5  # m at either end that is left out: a track that ends a hand's breadth early is no way around a rail
_EYE_HEIGHT = -0.5  # m above the axis: from here rays go up and down
LATTICES = 10  # of cells side by side, each a tenth of a cell farther left than the one before
_RAYS_AT_ONCE = 200_000
_LEVELS = (0.3, 0.7)  # m above the ground at which the robot would run into something


@dataclass(frozen=True)
class Ground:
    """Ground under the robot and headroom over it, in cells whose middles lie closer across than a cell is wide."""

    station: Float[np.ndarray, " n"]  # Stations of the rows, one cell apart, m
    left: Float[np.ndarray, " m"]  # Offsets of the columns, m
    height: Float[np.ndarray, "n m"]  # Height of the ground above the axis, m; NaN where none is seen
    headroom: Float[np.ndarray, "n m"]  # Headroom above the ground, m
    # Largest difference of height to the cells before, behind and beside, m; NaN beside what is not seen
    step: Float[np.ndarray, "n m"]

    @property
    def spacing(self) -> float:
        """Distance between two columns, m."""
        return float(self.left[1] - self.left[0])

    @property
    def width(self) -> Float[np.ndarray, " n"]:
        return self.traversable.sum(axis=1) * self.spacing

    @property
    def traversable(self) -> Bool[np.ndarray, "n m"]:
        """True where neither a step nor the roof stops the robot, `(n, m)`."""
        with np.errstate(invalid="ignore"):
            return (self.step < STEP_MOST) & (self.headroom > HEADROOM_LEAST)

    @property
    def clearance(self) -> Float[np.ndarray, "n m"]:
        """Distance to the nearest cell that is not traversable, m; the mouths are open."""
        free, apart = self.traversable, (GROUND_CELL, self.spacing)
        return distance_transform_edt(free, apart) if not free.all() else np.full(free.shape, GROUND_HALF)

    def lattices(self) -> "list[Ground]":
        """Return the grounds of cells side by side that this one is made of."""
        return [
            Ground(self.station, *(a[..., k::LATTICES] for a in (self.left, self.height, self.headroom, self.step)))
            for k in range(LATTICES)
        ]


def ground_curve(case: Case) -> Curve:
    """Return the reference axis, or the lining's own where there is no reference."""
    return lining_curve(case) if case.truth is None and case.hold is None else reference_curve(case)


def _ground_axes(curve: Curve) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " m"]]:
    cell, length = GROUND_CELL, curve.length - 2 * MOUTH_MARGIN
    columns = LATTICES * int(GROUND_HALF / cell)
    return (
        curve.station[0] + MOUTH_MARGIN + cell * (np.arange(int(length / cell)) + 0.5),
        cell / LATTICES * np.arange(-columns, columns + 1),
    )


@kept_until("NAV", per_case)
def judged_ground(case: Case) -> Ground:
    return _cast_ground(ground_curve(case), surface_caster(case), lining_radii(case))


def _cast_ground(curve: Curve, caster: Caster, radii: Radii) -> Ground:
    station, left = _ground_axes(curve)
    rows = max(_RAYS_AT_ONCE // len(left), 1)
    parts = [_cast_rows(curve, caster, radii, station[k : k + rows], left) for k in range(0, len(station), rows)]
    highest, lowest, barred = (np.concatenate(grids) for grids in zip(*parts, strict=True))
    step = np.where(barred, np.inf, cell_steps(highest, LATTICES))
    return Ground(station, left, highest, lowest - highest, step)


def _cast_rows(
    curve: Curve, caster: Caster, radii: Radii, station: Float[np.ndarray, " n"], left: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, "n m"], Bool[np.ndarray, "n m"]]:
    """Return the highest ground and lowest roof of cells, m, and True where something upright bars one.

    A ray goes down and up between every two columns; a cell has those within half its width, for a rail's head is
    narrower than it.
    """
    position, _, across, up = curve.frames(station)
    fine = GROUND_CELL / LATTICES * (np.arange(len(left) + LATTICES - 1) - (LATTICES - 1) / 2) + left[0]
    eye = (position[:, None] + fine[None, :, None] * across[:, None] + _EYE_HEIGHT * up[:, None]).reshape(-1, 3)
    inside = radii.depth(eye) > 0
    upward = np.repeat(up, len(fine), axis=0)
    ends = []
    for sign in (-1, 1):
        reach = np.full(len(eye), np.nan)
        reach[inside] = caster.first(eye[inside], sign * upward[inside])[0]
        height = np.where(np.isfinite(reach), _EYE_HEIGHT + sign * reach, np.nan).reshape(len(station), -1)
        ends.append(sliding_window_view(height, LATTICES, 1))
    highest, lowest = ends[0].max(axis=2), ends[1].min(axis=2)
    return highest, lowest, _barred_cells(curve, caster, station, left, highest)


def _barred_cells(
    curve: Curve,
    caster: Caster,
    station: Float[np.ndarray, " n"],
    left: Float[np.ndarray, " m"],
    height: Float[np.ndarray, "n m"],
) -> Bool[np.ndarray, "n m"]:
    """Return True for cells with an obstacle towards the next cell along or across: a wall that rays down miss."""
    position, tangent, across, up = curve.frames(station)
    known = np.isfinite(height)
    barred = np.zeros(height.shape, bool)
    for above in _LEVELS:
        rise = (np.where(known, height, 0.0) + above)[..., None] * up[:, None]
        eye = (position[:, None] + left[:, None] * across[:, None] + rise)[known]
        for ahead in (tangent, -tangent):
            towards = np.broadcast_to(ahead[:, None], (*height.shape, 3))[known]
            barred[known] |= caster.first(eye, towards)[0] < GROUND_CELL
    return barred


def cell_steps(height: Float[np.ndarray, "n m"], apart: int = 1) -> Float[np.ndarray, "n m"]:
    """Return the largest difference to the cells before, behind and `apart` columns beside, m; mouths go on."""
    along = np.pad(height, ((1, 1), (0, 0)), mode="edge")
    aside = np.pad(height, ((0, 0), (apart, apart)), constant_values=np.nan)
    others = along[2:], along[:-2], aside[:, 2 * apart :], aside[:, : -2 * apart]
    return np.max([np.abs(height - other) for other in others], axis=0)


# The two grounds to compare: by rays against the truth, by the same beams against a recording.

_ROW_SPREAD = (-2, -1, 0, 1, 2)  # rows whose returns a cell shares: one row has too few, and rails run along
_GROUND = 0.8  # of the returns in a cell lie lower than its ground: a rail fills only a part of it
_GAP_CELLS = 3  # cells without a return that are taken from their neighbours
_WALL_ABOVE = 0.6  # m above the middle of the ground; a return higher up is of the wall
_WALL_MARGIN = 0.25  # m before the wall
_WALL_FOOT = 0.3  # m above the floor where the wall's distance is taken
_FLOOR_BELOW = -1.0  # m above the axis; returns below it are of the ground


@kept_until("NAV", per_case)
def both_grounds(case: Case) -> tuple[Ground, Ground]:
    """Return the grounds to compare: by rays against the truth, else both by the same held-out beams.

    Beams that graze the ground leave gaps and blur steps; with the same beams and noise they do so on both sides.
    The last 25 cm before the reference's wall are left out: the robot's middle cannot get there.
    """
    judged = judged_ground(case) if case.truth is not None else _observed_ground(case)
    reference, cut = _reference_ground(case), sections(case)
    low = shapely.bounds(cut.reference_outline)[:, 1] + _WALL_FOOT
    reach = np.interp(reference.station, cut.station, widths(cut.reference_outline, low) / 2 - _WALL_MARGIN)
    off = np.abs(reference.left) > reach[:, None]
    left_out = [replace(side, step=np.where(off, np.nan, side.step)) for side in (judged, reference)]
    return left_out[0], left_out[1]


def _observed_ground(case: Case) -> Ground:
    curve, points = reference_curve(case), synthetic_points(case)
    return _ground_of_points(curve, curve.local(points[np.isfinite(points).all(axis=1)]))


@kept_until("NAV", per_reference)
def _reference_ground(case: Case) -> Ground:
    if case.truth is None:
        return _ground_of_points(hold_curve(case), hold_local(case))
    return _cast_ground(ground_curve(case), truth_caster(case), truth_radii(case))


def _ground_of_points(curve: Curve, local: Float[np.ndarray, "k 3"]) -> Ground:
    station, left = _ground_axes(curve)
    low = local[local[:, 2] < _FLOOR_BELOW]
    height, step = np.empty((len(station), len(left))), np.empty((len(station), len(left)))
    for k in range(LATTICES):
        beside = slice(k, None, LATTICES)
        height[:, beside] = _heights_of_points(station, left[beside], low)
        step[:, beside] = cell_steps(height[:, beside])
    return Ground(station, left, height, np.where(np.isfinite(height), np.inf, np.nan), step)


def _heights_of_points(
    station: Float[np.ndarray, " n"], left: Float[np.ndarray, " m"], low: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "n m"]:
    """Return the heights of cells side by side, m, from returns of the ground; NaN far from any return."""
    row = np.floor((low[:, 0] - station[0]) / GROUND_CELL + 0.5).astype(int)
    column = np.round((low[:, 1] - left[0]) / GROUND_CELL).astype(int)
    spread = np.concatenate([row + shift for shift in _ROW_SPREAD])
    column, above = np.tile(column, len(_ROW_SPREAD)), np.tile(low[:, 2], len(_ROW_SPREAD))
    kept = (spread >= 0) & (spread < len(station)) & (column >= 0) & (column < len(left))
    flat = spread[kept] * len(left) + column[kept]
    height = grouped_median(flat, above[kept], len(station) * len(left), fraction=_GROUND).reshape(len(station), -1)
    wall = np.nanquantile(height, 0.5) + _WALL_ABOVE
    height = np.where(height < wall, height, np.nan)
    away, nearest = distance_transform_edt(np.isnan(height), return_indices=True)
    return np.where(away <= _GAP_CELLS, height[tuple(nearest)], np.nan)


# Routes of the robot: from mouth to mouth between the rails, and between any two places.

ROBOT_RADIUS = 0.40  # m of the robot
GAUGE_HALF = 0.70  # m; between the rails
INFLATIONS = (0.15, 0.25, 0.35, 0.45, 0.55)  # m
TRIPLES = 1000  # 200 let the seed move the category by a point
_ROUTE_ENDS = 1.0  # m from a mouth within which a way begins
_BARRED = -1.0  # cost of a cell that no route enters
_EIGHT = np.ones((3, 3), int)


@dataclass(frozen=True)
class Route:
    """Route of the robot over the ground."""

    cells: Int[np.ndarray, "k 2"]  # Row and column of each cell
    place: Float[np.ndarray, "k 2"]  # Station and left of each cell, m
    clearance: Float[np.ndarray, " k"]  # Distance to the nearest obstacle, m

    @property
    def length(self) -> float:
        """Length along the route, m."""
        return float(np.linalg.norm(np.diff(self.place, axis=0), axis=1).sum())


def find_route(ground: Ground) -> Route | None:
    """Return the route of most clearance from mouth to mouth, starting next to the axis; `None` where none exists.

    A cell costs the inverse square of its clearance, and what the robot does not fit on is barred.
    """
    clearance = ground.clearance
    fits = clearance >= ROBOT_RADIUS
    start, goal = (_nearest_to_axis(ground, fits, end) for end in (0, -1))
    if start is None or goal is None:
        return None
    part = label(fits, _EIGHT)[0]
    if part[start] != part[goal]:
        return None
    cost = np.where(fits, 1.0 / np.maximum(clearance, 1e-3) ** 2, _BARRED)
    search = MCP_Geometric(cost, sampling=(GROUND_CELL, ground.spacing))
    search.find_costs([start], [goal])
    cells = np.asarray(search.traceback(goal))
    place = np.column_stack([ground.station[cells[:, 0]], ground.left[cells[:, 1]]])
    return Route(cells, place, clearance[tuple(cells.T)])


def _nearest_to_axis(ground: Ground, fits: Bool[np.ndarray, "n m"], end: int) -> tuple[int, int] | None:
    count, between = int(_ROUTE_ENDS / GROUND_CELL), np.abs(ground.left) < GAUGE_HALF
    for row in range(count) if end == 0 else range(-1, -1 - count, -1):
        columns = np.flatnonzero(fits[row] & between)
        if len(columns):
            return row % len(fits), int(columns[np.argmin(np.abs(ground.left[columns]))])
    return None


@per_case
def judged_route(case: Case) -> Route | None:
    return find_route(judged_ground(case))


@per_case
def both_routes(case: Case) -> tuple[Route | None, Route | None]:
    return find_route(both_grounds(case)[0]), _reference_route(case)


@per_reference
def _reference_route(case: Case) -> Route | None:
    return find_route(both_grounds(case)[1])


def blocked_metres(ground: Ground) -> int:
    """Count the stretches of 1 m between the rails that the robot cannot pass."""
    between = np.abs(ground.left) < GAUGE_HALF
    passable = (ground.clearance[:, between] >= ROBOT_RADIUS).any(axis=1)
    metre = ((ground.station - ground.station[0]) / 1.0).astype(int)
    return len(np.unique(metre[~passable]))


def feasible_trips(ground: Ground, triples: Int[np.ndarray, "t 3"]) -> Bool[np.ndarray, " t"]:
    """Return True where a robot of each inflation gets from start to goal.

    Args:
        ground: One lattice: in ten at once a lane as wide as an inflation is open or closed for millimetres.
        triples: Flat indices of start and goal, and number of the inflation, `(t, 3)`.
    """
    clearance = ground.clearance
    parts = [label(clearance >= inflation, _EIGHT)[0].ravel() for inflation in INFLATIONS]
    return np.array([parts[k][a] == parts[k][b] > 0 for a, b, k in triples])


def draw_trips(ground: Ground, rng: np.random.Generator) -> Int[np.ndarray, "t 3"]:
    places = np.flatnonzero(ground.traversable)
    if not len(places):
        raise ValueError("the reference has no traversable ground")
    ends = rng.choice(places, (TRIPLES, 2))
    return np.column_stack([ends, rng.integers(0, len(INFLATIONS), TRIPLES)])
