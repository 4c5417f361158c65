"""Routes of a small robot over the ground: from mouth to mouth between the rails, and between any two places."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import label
from skimage.graph import MCP_Geometric

from benchmarks.fidelity.case import Case, per_case, per_reference
from benchmarks.fidelity.derive.ground import Ground, both_grounds, judged_ground

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
    search = MCP_Geometric(cost, sampling=(ground.cell, ground.spacing))
    search.find_costs([start], [goal])
    cells = np.asarray(search.traceback(goal))
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
    """Draws random start, goal and inflation on traversable ground."""
    places = np.flatnonzero(ground.traversable)
    if not len(places):
        raise ValueError("the reference has no traversable ground")
    ends = rng.choice(places, (TRIPLES, 2))
    return np.column_stack([ends, rng.integers(0, len(INFLATIONS), TRIPLES)])
