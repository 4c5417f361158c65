"""LIN: pockets and ring grid on the unrolled lining."""

from collections.abc import Callable

import numpy as np

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import ringgrid
from benchmarks.fidelity.derive.pockets import judged_pockets, matched, reference_arc, reference_pockets
from benchmarks.fidelity.derive.unrolled import both_maps, correlated
from benchmarks.fidelity.registry import metric
from benchmarks.fidelity.value import Value, estimate, missing, number

_NOTHING = 100.0  # %; of a lining without any grid
_UNIFORM = 0.25  # share of a pitch; mean of a phase that knows nothing
_NO_POCKETS = "the reference shows no pockets"
_NO_MATCH = "no pocket of the candidate lies where the reference has one"
_NEIGHBOURS = (0.10, 0.80)  # m of chainage between pockets that a nail joins
_SAME_ROW = 0.05  # rad


def mean(values: np.ndarray) -> float:
    """Arithmetic mean."""
    return float(np.mean(values))


@metric("lin_depth_map_ncc", needs="hold")
def lin_depth_map_ncc(case: Case) -> Value:
    """Correlation of the unrolled depths with the held-out recording's, smooth section removed."""
    station, judged, hold = correlated(case)
    if judged.std() < 1e-4:
        return number(0.0, len(judged), "the lining is smooth")

    def correlation(index: np.ndarray) -> float:
        chosen = index.astype(int)
        return float(np.corrcoef(judged[chosen], hold[chosen])[0, 1])

    return estimate(correlation, np.arange(len(judged), dtype=float), station, case.rng("lin_depth_map_ncc"))


@metric("lin_pocket_f1", needs="reference")
def lin_pocket_f1(case: Case) -> Value:
    """F1 of the pockets, matched within 15 cm on the unrolled wall."""
    judged, reference = judged_pockets(case), reference_pockets(case)
    if not len(reference):
        return missing(_NO_POCKETS)
    return number(2.0 * len(matched(case)) / (len(judged) + len(reference)), len(reference))


@metric("lin_pocket_count_rel_err", needs="reference")
def lin_pocket_count_rel_err(case: Case) -> Value:
    """Relative error of the number of pockets, %."""
    judged, reference = judged_pockets(case), reference_pockets(case)
    if not len(reference):
        return missing(_NO_POCKETS)
    return number(100.0 * abs(len(judged) / len(reference) - 1.0), len(reference))


def _of_matched(case: Case, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray] | Value:
    """Stations, and a size of judged and reference pockets that match."""
    if not len(reference_pockets(case)):
        return missing(_NO_POCKETS)
    pairs = matched(case)
    if not len(pairs):
        return Value(None, None, 0, _NO_MATCH, failed=True)
    judged, reference = judged_pockets(case), reference_pockets(case)
    return reference.station[pairs[:, 1]], getattr(judged, name)[pairs[:, 0]], getattr(reference, name)[pairs[:, 1]]


def _over_matched(
    case: Case, id: str, name: str, error: Callable[..., np.ndarray], statistic: Callable[[np.ndarray], float]
) -> Value:
    """A statistic of the error of one property of the matched pockets."""
    found = _of_matched(case, name)
    if isinstance(found, Value):
        return found
    station, judged, reference = found
    return estimate(statistic, error(judged, reference), station, case.rng(id))


@metric("lin_pocket_depth_bias", needs="reference")
def lin_pocket_depth_bias(case: Case) -> Value:
    """Mean error of the depth of matched pockets, m, absolute."""
    return _over_matched(case, "lin_pocket_depth_bias", "depth", np.subtract, lambda e: abs(mean(e)))


@metric("lin_pocket_depth_mae", needs="reference")
def lin_pocket_depth_mae(case: Case) -> Value:
    """Mean absolute error of the same, m."""
    return _over_matched(case, "lin_pocket_depth_mae", "depth", lambda judged, true: np.abs(judged - true), mean)


@metric("lin_pocket_area_rel_err", needs="reference")
def lin_pocket_area_rel_err(case: Case) -> Value:
    """Median relative error of the area of matched pockets, %."""
    share = lambda judged, true: 100.0 * np.abs(judged / true - 1.0)  # noqa: E731
    return _over_matched(case, "lin_pocket_area_rel_err", "area", share, lambda e: float(np.median(e)))


def _reference_pitch(case: Case) -> float | None:
    reference = both_maps(case)[1]
    coarse = ringgrid.coarse_pitch(ringgrid.along(reference))
    return None if coarse is None else ringgrid.pitch(reference, coarse, 0.1)


@metric("lin_axial_pitch_err", needs="reference")
def lin_axial_pitch_err(case: Case) -> Value:
    """Relative error of the pitch of the rings along the tunnel, %."""
    reference = _reference_pitch(case)
    if reference is None:
        return missing(_NO_POCKETS)
    judged = ringgrid.pitch(both_maps(case)[0], reference, ringgrid.BAND)
    if judged is None:
        return number(_NOTHING, 0, "the lining has no relief")
    return number(100.0 * abs(judged / reference - 1.0), 1, f"{judged:.4f} m against {reference:.4f} m")


@metric("lin_circ_pitch_err", needs="reference")
def lin_circ_pitch_err(case: Case) -> Value:
    """Relative error of the median distance between rows of pockets around the section, %."""
    judged, reference = (np.diff(ringgrid.rows(side, reference_arc(case))) for side in both_maps(case))
    if not len(reference):
        return missing(_NO_POCKETS)
    if not len(judged):
        return number(_NOTHING, 0, "the lining has no rows of pockets")
    return number(100.0 * abs(float(np.median(judged) / np.median(reference)) - 1.0), len(reference))


@metric("lin_ring_phase_err", needs="reference")
def lin_ring_phase_err(case: Case) -> Value:
    """Mean absolute error of the grid's phase in windows of four pitches, share of a pitch."""
    length = _reference_pitch(case)
    if length is None:
        return missing(_NO_POCKETS)
    judged, reference = (ringgrid.phases(side, length) for side in both_maps(case))
    count = min(len(judged), len(reference))
    gap = np.abs((judged[:count] - reference[:count] + np.pi) % (2 * np.pi) - np.pi) / (2 * np.pi)
    share = np.where(np.isnan(judged[:count]), _UNIFORM, gap)
    centre = length * ringgrid.PITCHES / 2 * (1 + np.arange(count))
    return estimate(mean, share, centre, case.rng("lin_ring_phase_err"))


@metric("lin_nail_count_ratio")
def lin_nail_count_ratio(case: Case) -> Value:
    """Connecting nails of the candidate over its pairs of neighbouring pockets in a row."""
    pocket = case.candidate.bore.pocket
    order = np.lexsort((pocket["station"], np.round(pocket["angle"] / _SAME_ROW)))
    gap, turn = np.diff(pocket["station"][order]), np.abs(np.diff(pocket["angle"][order]))
    pairs = int(((gap > _NEIGHBOURS[0]) & (gap < _NEIGHBOURS[1]) & (turn < _SAME_ROW)).sum())
    if not pairs:
        return missing("the candidate has no neighbouring pockets")
    return number(case.candidate.manifest.get("count", {}).get("nails", 0) / pairs, pairs)
