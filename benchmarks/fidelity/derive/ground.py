"""The ground that a small robot drives on, of candidate and reference, and routes over it.

A step of 10 cm stops the robot. Sleepers (6 cm above the ballast) do not, rails (18 cm above the sleepers) do: it
drives between the rails, and may drive beside them, but cannot change over.
"""

from dataclasses import dataclass, replace

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt, label
from skimage.graph import route_through_array

from benchmarks.fidelity.case import Case, per_case, per_hold, per_truth
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
_ACROSS = 5  # rays across a cell, of which the highest hit counts: a rail's head is narrower than a cell
_LEVELS = (0.3, 0.7)  # m above the ground at which the robot would run into something


@dataclass(frozen=True)
class Ground:
    """Ground under the robot and headroom over it.

    Attributes:
        station: Stations of the rows, m, `(n,)`.
        left: Offsets of the columns, m, `(m,)`.
        height: Height of the ground above the axis, m; NaN where none is seen, `(n, m)`.
        headroom: Headroom above the ground, m, `(n, m)`.
        step: Largest difference of height to the four neighbours, m; NaN beside what is not seen, `(n, m)`.
    """

    station: Float[np.ndarray, " n"]
    left: Float[np.ndarray, " m"]
    height: Float[np.ndarray, "n m"]
    headroom: Float[np.ndarray, "n m"]
    step: Float[np.ndarray, "n m"]

    @property
    def cell(self) -> float:
        """Edge of a cell, m."""
        return float(self.left[1] - self.left[0])

    @property
    def traversable(self) -> Bool[np.ndarray, "n m"]:
        """True where neither a step nor the roof stops the robot, `(n, m)`."""
        with np.errstate(invalid="ignore"):
            return (self.step < STEP_MOST) & (self.headroom > HEADROOM_LEAST)

    @property
    def clearance(self) -> Float[np.ndarray, "n m"]:
        """Distance to the nearest cell that is not traversable, m; the mouths are open."""
        free = self.traversable
        return distance_transform_edt(free, self.cell) if not free.all() else np.full(free.shape, GROUND_HALF)


def ground_curve(case: Case) -> Curve:
    """Return the reference axis, or the lining's own where there is no reference."""
    return lining_curve(case) if case.truth is None and case.hold is None else reference_curve(case)


def ground_axes(curve: Curve, cell: float) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " m"]]:
    """Return stations of the rows and offsets to the left of the columns, m."""
    station = curve.station[0] + MOUTH_MARGIN + cell * (np.arange(int((curve.length - 2 * MOUTH_MARGIN) / cell)) + 0.5)
    columns = int(GROUND_HALF / cell)
    return station, cell * np.arange(-columns, columns + 1)


@per_case
def judged_ground(case: Case) -> Ground:
    """Return the candidate's ground, by rays."""
    return _cast_ground(ground_curve(case), GROUND_CELL * case.tolerance, surface_caster(case), lining_radii(case))


@per_truth
def true_ground(case: Case) -> Ground:
    """Return the true ground, by rays."""
    return _cast_ground(ground_curve(case), GROUND_CELL * case.tolerance, truth_caster(case), truth_radii(case))


def _cast_ground(curve: Curve, cell: float, caster: Caster, radii: Radii) -> Ground:
    station, left = ground_axes(curve, cell)
    position, _, across, up = curve.frames(station)
    fine = (left[:, None] + cell * (np.arange(_ACROSS) - _ACROSS // 2) / _ACROSS).ravel()
    eye = (position[:, None] + fine[None, :, None] * across[:, None] + _EYE_HEIGHT * up[:, None]).reshape(-1, 3)
    inside = radii.depth(eye) > 0
    upward = np.repeat(up, len(fine), axis=0)
    shape = (len(station), len(left), _ACROSS)
    height, roof = (_ray_heights(caster, eye, sign * upward, inside, sign).reshape(shape) for sign in (-1, 1))
    whole = inside.reshape(shape).all(axis=2)
    highest = np.where(whole, height.max(axis=2), np.nan)
    headroom = np.where(whole, roof.min(axis=2), np.nan) - highest
    return Ground(
        station,
        left,
        highest,
        headroom,
        np.where(_barred_cells(caster, curve, station, left, highest), np.inf, cell_steps(highest)),
    )


def _barred_cells(
    caster: Caster,
    curve: Curve,
    station: Float[np.ndarray, " n"],
    left: Float[np.ndarray, " m"],
    height: Float[np.ndarray, "n m"],
) -> Bool[np.ndarray, "n m"]:
    """Return True for cells with an obstacle towards the next cell along or across: a wall that rays down miss."""
    position, tangent, across, up = curve.frames(station)
    cell, known = left[1] - left[0], np.isfinite(height)
    barred = np.zeros(height.shape, bool)
    for above in _LEVELS:
        rise = (np.where(known, height, 0.0) + above)[..., None] * up[:, None]
        eye = (position[:, None] + left[:, None] * across[:, None] + rise)[known]
        for ahead in (tangent, -tangent):
            towards = np.broadcast_to(ahead[:, None], (*height.shape, 3))[known]
            barred[known] |= caster.first(eye, towards)[0] < cell
    return barred


def _ray_heights(
    caster: Caster,
    eye: Float[np.ndarray, "k 3"],
    direction: Float[np.ndarray, "k 3"],
    among: Bool[np.ndarray, " k"],
    sign: int,
) -> Float[np.ndarray, " k"]:
    """Return the height above the axis at which rays up or down end, m; NaN where they do not."""
    reach = np.full(len(eye), np.nan)
    reach[among] = caster.first(eye[among], direction[among])[0]
    return np.where(np.isfinite(reach), _EYE_HEIGHT + sign * reach, np.nan)


def cell_steps(height: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
    """Return the largest difference to the four neighbours, m; beyond the mouths the ground goes on."""
    padded = np.pad(height, ((1, 1), (0, 0)), mode="edge")
    padded = np.pad(padded, ((0, 0), (1, 1)), constant_values=np.nan)
    inner = padded[1:-1, 1:-1]
    shifted = (padded[2:, 1:-1], padded[:-2, 1:-1], padded[1:-1, 2:], padded[1:-1, :-2])
    return np.max([np.abs(inner - other) for other in shifted], axis=0)


# The two grounds to compare: by rays against the truth, by the same beams against a recording.

_ROW_SPREAD = (-2, -1, 0, 1, 2)  # rows whose returns a cell shares: one row has too few, and rails run along
_GROUND_SHARE = 0.8  # of the returns in a cell lie lower than its ground: a rail fills only a part of it
_GAP_CELLS = 3  # cells without a return that are taken from their neighbours
_WALL_ABOVE = 0.6  # m above the middle of the ground; a return higher up is of the wall
_WALL_MARGIN = 0.25  # m before the wall
_WALL_FOOT = 0.3  # m above the floor where the wall's distance is taken
_FLOOR_BELOW = -1.0  # m above the axis; returns below it are of the ground


@per_case
def both_grounds(case: Case) -> tuple[Ground, Ground]:
    """Return the grounds to compare: by rays against the truth, else both by the same held-out beams.

    Beams that graze the ground leave gaps and blur steps; with the same beams and noise they do so on both sides.
    The last 25 cm before the reference's wall are left out: the robot's middle cannot get there.
    """
    if case.truth is not None:
        judged, reference = judged_ground(case), true_ground(case)
    else:
        judged, reference = _observed_ground(case), _seen_ground(case)
    cut = sections(case)
    low = shapely.bounds(cut.reference_outline)[:, 1] + _WALL_FOOT
    reach = np.interp(reference.station, cut.station, widths(cut.reference_outline, low) / 2 - _WALL_MARGIN)
    off = np.abs(reference.left) > reach[:, None]
    left_out = [replace(side, step=np.where(off, np.nan, side.step)) for side in (judged, reference)]
    return left_out[0], left_out[1]


@per_case
def _observed_ground(case: Case) -> Ground:
    curve, points = reference_curve(case), synthetic_points(case)
    return _ground_of_points(curve, GROUND_CELL * case.tolerance, curve.local(points[np.isfinite(points).all(axis=1)]))


@per_hold
def _seen_ground(case: Case) -> Ground:
    return _ground_of_points(hold_curve(case), GROUND_CELL * case.tolerance, hold_local(case))


def _ground_of_points(curve: Curve, cell: float, local: Float[np.ndarray, "k 3"]) -> Ground:
    station, left = ground_axes(curve, cell)
    low = local[local[:, 2] < _FLOOR_BELOW]
    row = np.floor((low[:, 0] - station[0]) / cell + 0.5).astype(int)
    column = np.round(low[:, 1] / cell).astype(int) + len(left) // 2
    spread = np.concatenate([row + shift for shift in _ROW_SPREAD])
    column, above = np.tile(column, len(_ROW_SPREAD)), np.tile(low[:, 2], len(_ROW_SPREAD))
    kept = (spread >= 0) & (spread < len(station)) & (column >= 0) & (column < len(left))
    flat = spread[kept] * len(left) + column[kept]
    height = grouped_median(flat, above[kept], len(station) * len(left), share=_GROUND_SHARE).reshape(len(station), -1)
    wall = np.nanquantile(height, 0.5) + _WALL_ABOVE
    height = np.where(height < wall, height, np.nan)
    away, nearest = distance_transform_edt(np.isnan(height), return_indices=True)
    height = np.where(away <= _GAP_CELLS, height[tuple(nearest)], np.nan)
    return Ground(station, left, height, np.where(np.isfinite(height), np.inf, np.nan), cell_steps(height))


# Routes of the robot: from mouth to mouth between the rails, and between any two places.

ROBOT_RADIUS = 0.40  # m of the robot
GAUGE_HALF = 0.70  # m; between the rails
INFLATIONS = (0.15, 0.25, 0.35, 0.45, 0.55)  # m
TRIPLES = 1000  # 200 let the seed move the category by a point
_ROUTE_ENDS = 1.0  # m from a mouth within which a way begins
_BARRED_COST = 1e6
_EIGHT = np.ones((3, 3), int)


@dataclass(frozen=True)
class Route:
    """Route of the robot over the ground.

    Attributes:
        cells: Row and column of each cell, `(k, 2)`.
        place: Station and left of each cell, m, `(k, 2)`.
        clearance: Distance to the nearest obstacle, m, `(k,)`.
    """

    cells: Int[np.ndarray, "k 2"]
    place: Float[np.ndarray, "k 2"]
    clearance: Float[np.ndarray, " k"]

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
    cost = np.where(fits, 1.0 / np.maximum(clearance, 1e-3) ** 2, _BARRED_COST)
    cells = np.asarray(route_through_array(cost, start, goal, fully_connected=True, geometric=True)[0])
    place = np.column_stack([ground.station[cells[:, 0]], ground.left[cells[:, 1]]])
    return Route(cells, place, clearance[tuple(cells.T)])


def _nearest_to_axis(ground: Ground, fits: Bool[np.ndarray, "n m"], end: int) -> tuple[int, int] | None:
    rows = range(int(_ROUTE_ENDS / ground.cell)) if end == 0 else range(-1, -1 - int(_ROUTE_ENDS / ground.cell), -1)
    between = np.abs(ground.left) < GAUGE_HALF
    for row in rows:
        columns = np.flatnonzero(fits[row] & between)
        if len(columns):
            return row % len(fits), int(columns[np.argmin(np.abs(ground.left[columns]))])
    return None


@per_case
def judged_route(case: Case) -> Route | None:
    """Return the route on the candidate's own ground."""
    return find_route(judged_ground(case))


@per_case
def both_routes(case: Case) -> tuple[Route | None, Route | None]:
    """Return the routes on the two grounds that are compared."""
    judged, reference = both_grounds(case)
    return find_route(judged), find_route(reference)


def blocked_metres(ground: Ground) -> int:
    """Count the stretches of 1 m between the rails that the robot cannot pass."""
    between = np.abs(ground.left) < GAUGE_HALF
    passable = (ground.clearance[:, between] >= ROBOT_RADIUS).any(axis=1)
    metre = ((ground.station - ground.station[0]) / 1.0).astype(int)
    return len(np.unique(metre[~passable]))


def feasible_trips(ground: Ground, triples: Int[np.ndarray, "t 3"]) -> Bool[np.ndarray, " t"]:
    """Return True where a robot of each inflation gets from start to goal; cells are flat indices."""
    clearance = ground.clearance
    parts = [label(clearance >= inflation, _EIGHT)[0].ravel() for inflation in INFLATIONS]
    return np.array([parts[k][a] == parts[k][b] > 0 for a, b, k in triples])


def draw_trips(ground: Ground, rng: np.random.Generator) -> Int[np.ndarray, "t 3"]:
    """Draws random start, goal and inflation on traversable ground.

    Raises:
        ValueError: There is none.
    """
    places = np.flatnonzero(ground.traversable)
    if not len(places):
        raise ValueError("the reference has no traversable ground")
    ends = rng.choice(places, (TRIPLES, 2))
    return np.column_stack([ends, rng.integers(0, len(INFLATIONS), TRIPLES)])
