"""NAV: where a small robot gets through, on the candidate's ground and on the reference's."""

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import routes
from benchmarks.fidelity.derive.groundpair import both_grounds
from benchmarks.fidelity.derive.routes import Route, both_routes, judged_route
from benchmarks.fidelity.registry import metric
from benchmarks.fidelity.value import Value, estimate, missing, number, passed

_NONE = "the candidate has no way from mouth to mouth"
_NO_REFERENCE = "the reference shows no way from mouth to mouth"


def mean(values: np.ndarray) -> float:
    """Arithmetic mean."""
    return float(np.mean(values))


def _ways(case: Case) -> tuple[Route, Route] | Value:
    judged, reference = both_routes(case)
    if reference is None:
        return missing(_NO_REFERENCE)
    if judged is None:
        return Value(None, None, 0, _NONE, failed=True)
    return judged, reference


@metric("nav_path_exists")
def nav_path_exists(case: Case) -> Value:
    """Whether the robot gets from mouth to mouth."""
    return passed(judged_route(case) is not None, "" if judged_route(case) is not None else _NONE)


@metric("nav_path_len_ratio", needs="reference")
def nav_path_len_ratio(case: Case) -> Value:
    """Length of the way over the reference's."""
    ways = _ways(case)
    return ways if isinstance(ways, Value) else number(ways[0].length / ways[1].length, len(ways[0].place))


@metric("nav_path_dev_p95", needs="reference")
def nav_path_dev_p95(case: Case) -> Value:
    """95th percentile of the distance from the way to the reference's, m."""
    ways = _ways(case)
    if isinstance(ways, Value):
        return ways
    apart = cKDTree(ways[1].place).query(ways[0].place)[0]
    along = ways[0].place[:, 0]
    return estimate(lambda v: float(np.percentile(v, 95)), apart, along, case.rng("nav_path_dev_p95"))


@metric("nav_clearance_min_err", needs="reference")
def nav_clearance_min_err(case: Case) -> Value:
    """Error of the least clearance on the way, m, absolute."""
    ways = _ways(case)
    if isinstance(ways, Value):
        return ways
    return number(abs(float(ways[0].clearance.min() - ways[1].clearance.min())), len(ways[0].place))


@metric("nav_clearance_mean_err", needs="reference")
def nav_clearance_mean_err(case: Case) -> Value:
    """Error of the mean clearance on the way, m, absolute."""
    ways = _ways(case)
    if isinstance(ways, Value):
        return ways
    return number(abs(mean(ways[0].clearance) - mean(ways[1].clearance)), len(ways[0].place))


@metric("nav_drivable_width_mae", needs="reference")
def nav_drivable_width_mae(case: Case) -> Value:
    """Mean absolute error of the drivable width, m."""
    judged, reference = both_grounds(case)
    width = [ground.traversable.sum(axis=1) * ground.cell for ground in (judged, reference)]
    return estimate(mean, np.abs(width[0] - width[1]), judged.station, case.rng("nav_drivable_width_mae"))


@metric("nav_feasible_agree", needs="reference")
def nav_feasible_agree(case: Case) -> Value:
    """Share of 1,000 random starts, goals and inflations for which both say the same."""
    judged, reference = both_grounds(case)
    triples = routes.draw(reference, case.rng("nav_feasible_agree"))
    agree = routes.feasible(judged, triples) == routes.feasible(reference, triples)
    return number(mean(agree.astype(float)), len(agree))


@metric("nav_blocked_diff", needs="reference")
def nav_blocked_diff(case: Case) -> Value:
    """Difference in the number of blocked metres between the rails, absolute."""
    judged, reference = both_grounds(case)
    return number(abs(routes.blocked(judged) - routes.blocked(reference)), 1)


@metric("nav_traversable_iou", needs="reference")
def nav_traversable_iou(case: Case) -> Value:
    """Intersection over union of traversable cells, where the reference sees the ground."""
    judged, reference = both_grounds(case)
    free = [judged.traversable, reference.traversable]
    among = free[0] | free[1]
    if case.truth is None:
        among &= np.isfinite(reference.step) & np.isfinite(judged.step)
    station = np.broadcast_to(judged.station[:, None], among.shape)[among]
    return estimate(mean, (free[0] & free[1])[among].astype(float), station, case.rng("nav_traversable_iou"))


@metric("nav_step_p95_err", needs="reference")
def nav_step_p95_err(case: Case) -> Value:
    """Error of the 95th percentile of the step between neighbouring cells, m, absolute."""
    judged, reference = both_grounds(case)
    among = np.isfinite(judged.step) & np.isfinite(reference.step)
    return number(
        abs(float(np.diff(np.percentile([judged.step[among], reference.step[among]], 95, axis=1))[0])), int(among.sum())
    )


@metric("nav_footprint_margin")
def nav_footprint_margin(case: Case) -> Value:
    """Least clearance on the way less the robot's radius, m."""
    way = judged_route(case)
    return missing(_NONE) if way is None else number(float(way.clearance.min()) - routes.RADIUS, len(way.place))
