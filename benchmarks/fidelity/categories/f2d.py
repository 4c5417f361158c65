"""F2D: free space in the plane of the sensor."""

import numpy as np

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import freeplane
from benchmarks.fidelity.derive.freeplane import plane, whole
from benchmarks.fidelity.registry import metric
from benchmarks.fidelity.value import Value, estimate, number

_NEAR = 0.10  # m between two edges that agree
_WIDEST = 20.0  # m in place of an open side


def share(values: np.ndarray) -> float:
    """Mean of zeros and ones."""
    return float(np.mean(values))


def _agreement(case: Case, id: str, among: np.ndarray, both: np.ndarray) -> Value:
    """Share of cells `among` which `both` are free."""
    picked = among & plane(case).known
    station = np.broadcast_to(plane(case).station[:, None], picked.shape)[picked]
    return estimate(share, both[picked].astype(float), station, case.rng(id))


@metric("occ2d_free_iou", needs="reference")
def occ2d_free_iou(case: Case) -> Value:
    """Intersection over union of the free cells, where the reference knows."""
    judged, reference = plane(case).judged, plane(case).reference
    return _agreement(case, "occ2d_free_iou", judged | reference, judged & reference)


@metric("occ2d_free_precision", needs="reference")
def occ2d_free_precision(case: Case) -> Value:
    """Share of the candidate's free cells that are free."""
    return _agreement(case, "occ2d_free_precision", plane(case).judged, plane(case).reference)


@metric("occ2d_free_recall", needs="reference")
def occ2d_free_recall(case: Case) -> Value:
    """Share of the free cells that the candidate has."""
    return _agreement(case, "occ2d_free_recall", plane(case).reference, plane(case).judged)


@metric("occ2d_boundary_f1", needs="reference")
def occ2d_boundary_f1(case: Case) -> Value:
    """F1 of the edges of free space, 10 cm apart at most."""
    judged, reference = (freeplane.edge_cells(free) for free in whole(case)[:2])
    edge, reach = plane(case).lattice.edge, _NEAR * case.tolerance + 1e-9
    precision = share(freeplane.distances(judged, reference, edge) <= reach)
    recall = share(freeplane.distances(reference, judged, edge) <= reach)
    return number(2 * precision * recall / max(precision + recall, 1e-12), int(judged.sum() + reference.sum()))


@metric("free2d_area_rel_err", needs="reference")
def free2d_area_rel_err(case: Case) -> Value:
    """Relative error of the free area, %."""
    judged, reference, _ = whole(case)
    return number(100.0 * abs(judged.sum() / max(reference.sum(), 1) - 1.0), int(reference.sum()))


@metric("free2d_width_mae", needs="reference")
def free2d_width_mae(case: Case) -> Value:
    """Mean absolute error of the free width, m; an open side counts as 20 m."""
    station, judged, reference = freeplane.free_widths(case)
    error = np.abs(np.minimum(judged, _WIDEST) - np.minimum(reference, _WIDEST))
    return estimate(share, error, station, case.rng("free2d_width_mae"))


@metric("free2d_width_min_err", needs="reference")
def free2d_width_min_err(case: Case) -> Value:
    """Error of the narrowest width, m, absolute."""
    _, judged, reference = freeplane.free_widths(case)
    return number(abs(float(np.min(judged)) - float(np.min(reference))), len(judged))


@metric("free2d_edt_rmse", needs="reference")
def free2d_edt_rmse(case: Case) -> Value:
    """Root mean square error of the distance to the edge of free space, m, where either is free."""
    judged, reference, rows = whole(case)
    picked = judged | reference
    clear = [_clear(free, plane(case).lattice.edge) for free in (judged, reference)]
    station = np.broadcast_to(rows[:, None], picked.shape)[picked]
    squares = ((clear[0] - clear[1]) ** 2)[picked]
    return estimate(lambda v: float(np.sqrt(np.mean(v))), squares, station, case.rng("free2d_edt_rmse"))


def _clear(free: np.ndarray, edge: float) -> np.ndarray:
    if not free.any():
        return np.zeros(free.shape)
    return freeplane.distances(np.ones_like(free), ~free, edge).reshape(free.shape)


@metric("free2d_skeleton_p95", needs="reference")
def free2d_skeleton_p95(case: Case) -> Value:
    """95th percentile of the distance between the medial axes, both ways, m."""
    judged, reference = (freeplane.medial_axis(free) for free in whole(case)[:2])
    edge = plane(case).lattice.edge
    apart = [freeplane.distances(judged, reference, edge), freeplane.distances(reference, judged, edge)]
    return number(float(np.percentile(np.concatenate(apart), 95)), sum(map(len, apart)))


@metric("occ2d_unknown_frac", needs="hold")
def occ2d_unknown_frac(case: Case) -> Value:
    """Share of the candidate's free cells of which held-out beams say nothing."""
    return number(freeplane.unknown_share(case), int(plane(case).judged.sum()))
