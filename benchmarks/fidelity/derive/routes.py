"""Ways of the robot over the ground: from mouth to mouth between the rails, and between any two places."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import label
from skimage.graph import route_through_array

from benchmarks.fidelity.case import Case, derived
from benchmarks.fidelity.derive.ground import Ground, judged_ground
from benchmarks.fidelity.derive.groundpair import both_grounds

RADIUS = 0.40  # m of the robot
GAUGE_HALF = 0.70  # m; between the rails
INFLATIONS = (0.15, 0.25, 0.35, 0.45, 0.55)  # m
TRIPLES = 1000  # 200 let the seed move the category by a point
_ENDS = 1.0  # m from a mouth within which a way begins
_BARRED = 1e6
_EIGHT = np.ones((3, 3), int)


@dataclass(frozen=True)
class Route:
    """A way.

    Attributes:
        cells: Row and column of each cell, `(k, 2)`.
        place: Station and left of each, m, `(k, 2)`.
        clearance: To what stops the robot, m, `(k,)`.
    """

    cells: Int[np.ndarray, "k 2"]
    place: Float[np.ndarray, "k 2"]
    clearance: Float[np.ndarray, " k"]

    @property
    def length(self) -> float:
        """Along the way, m."""
        return float(np.linalg.norm(np.diff(self.place, axis=0), axis=1).sum())


def route(ground: Ground) -> Route | None:
    """The way of most clearance from mouth to mouth, begun and ended next to the axis; `None` where there is none.

    A cell costs the inverse square of its clearance, and what the robot does not fit on is barred.
    """
    clearance = ground.clearance
    fits = clearance >= RADIUS
    start, goal = (_nearest_to_axis(ground, fits, end) for end in (0, -1))
    if start is None or goal is None:
        return None
    part = label(fits, _EIGHT)[0]
    if part[start] != part[goal]:
        return None
    cost = np.where(fits, 1.0 / np.maximum(clearance, 1e-3) ** 2, _BARRED)
    cells = np.asarray(route_through_array(cost, start, goal, fully_connected=True, geometric=True)[0])
    place = np.column_stack([ground.station[cells[:, 0]], ground.left[cells[:, 1]]])
    return Route(cells, place, clearance[tuple(cells.T)])


def _nearest_to_axis(ground: Ground, fits: Bool[np.ndarray, "n m"], end: int) -> tuple[int, int] | None:
    rows = range(int(_ENDS / ground.cell)) if end == 0 else range(-1, -1 - int(_ENDS / ground.cell), -1)
    between = np.abs(ground.left) < GAUGE_HALF
    for row in rows:
        columns = np.flatnonzero(fits[row] & between)
        if len(columns):
            return row % len(fits), int(columns[np.argmin(np.abs(ground.left[columns]))])
    return None


@derived
def judged_route(case: Case) -> Route | None:
    """On the candidate's own ground."""
    return route(judged_ground(case))


@derived
def both_routes(case: Case) -> tuple[Route | None, Route | None]:
    """On the two grounds that are compared."""
    judged, reference = both_grounds(case)
    return route(judged), route(reference)


def blocked(ground: Ground) -> int:
    """Stretches of 1 m between the rails that the robot does not get through."""
    between = np.abs(ground.left) < GAUGE_HALF
    passable = (ground.clearance[:, between] >= RADIUS).any(axis=1)
    metre = ((ground.station - ground.station[0]) / 1.0).astype(int)
    return len(np.unique(metre[~passable]))


def feasible(ground: Ground, triples: Int[np.ndarray, "t 3"]) -> Bool[np.ndarray, " t"]:
    """Whether a robot of each inflation gets from start to goal; cells are flat indices."""
    clearance = ground.clearance
    parts = [label(clearance >= inflation, _EIGHT)[0].ravel() for inflation in INFLATIONS]
    return np.array([parts[k][a] == parts[k][b] > 0 for a, b, k in triples])


def draw(ground: Ground, rng: np.random.Generator) -> Int[np.ndarray, "t 3"]:
    """Random start, goal and inflation on traversable ground.

    Raises:
        ValueError: There is none.
    """
    places = np.flatnonzero(ground.traversable)
    if not len(places):
        raise ValueError("the reference has no traversable ground")
    ends = rng.choice(places, (TRIPLES, 2))
    return np.column_stack([ends, rng.integers(0, len(INFLATIONS), TRIPLES)])
