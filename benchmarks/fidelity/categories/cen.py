"""CEN: the axis of the lining against the reference's."""

from collections.abc import Callable

import numpy as np

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import alignment
from benchmarks.fidelity.derive.alignment import pair
from benchmarks.fidelity.derive.curve import truth_curve
from benchmarks.fidelity.derive.reference_axis import lining_curve, mouths
from benchmarks.fidelity.registry import metric
from benchmarks.fidelity.value import Value, estimate, missing, number

_FEWEST = 10  # features that a drift can be read from


def rms(values: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def _of_both(case: Case, id: str, quantity: Callable[[np.ndarray], np.ndarray], factor: float = 1.0) -> Value:
    both = pair(case)
    difference = quantity(both.judged) - quantity(both.reference)
    trim = (len(both.station) - len(difference)) // 2
    station = both.station[trim : len(both.station) - trim]
    return estimate(rms, factor * difference, station, case.rng(id))


@metric("cl_lateral_rmse", needs="reference")
def cl_lateral_rmse(case: Case) -> Value:
    """Root mean square of the horizontal offset, m."""
    return estimate(rms, pair(case).left, pair(case).station, case.rng("cl_lateral_rmse"))


@metric("cl_lateral_p95", needs="reference")
def cl_lateral_p95(case: Case) -> Value:
    """95th percentile of the horizontal offset, m."""
    both = pair(case)
    return estimate(lambda v: float(np.percentile(v, 95)), np.abs(both.left), both.station, case.rng("cl_lateral_p95"))


@metric("cl_vertical_rmse", needs="reference")
def cl_vertical_rmse(case: Case) -> Value:
    """Root mean square of the vertical offset, m."""
    both = pair(case)
    return estimate(rms, both.judged[:, 2] - both.reference[:, 2], both.station, case.rng("cl_vertical_rmse"))


@metric("cl_length_rel_err", needs="truth")
def cl_length_rel_err(case: Case) -> Value:
    """Arc length of the lining's axis, mouth to mouth, against the truth's, %."""
    true = truth_curve(case).length
    return number(100.0 * abs(lining_curve(case).length - true) / true, 1)


@metric("cl_end_station_err", needs="truth")
def cl_end_station_err(case: Case) -> Value:
    """Larger of the axial errors of the two mouths, m."""
    curve = truth_curve(case)
    low, high = mouths(case)
    return number(max(abs(low - curve.station[0]), abs(high - curve.station[-1])), 2)


@metric("cl_heading_rmse", needs="reference")
def cl_heading_rmse(case: Case) -> Value:
    """Root mean square of the heading's error on a base of 2 m, degrees."""
    both = pair(case)
    gap = alignment.heading(both.judged) - alignment.heading(both.reference)
    gap = np.rad2deg((gap + np.pi) % (2 * np.pi) - np.pi)
    return estimate(rms, gap, both.station[1:-1], case.rng("cl_heading_rmse"))


@metric("cl_curvature_rmse", needs="reference")
def cl_curvature_rmse(case: Case) -> Value:
    """Root mean square of the error of plan curvature over 10 m, 1/m."""
    return _of_both(case, "cl_curvature_rmse", alignment.curvature)


@metric("cl_grade_rmse", needs="reference")
def cl_grade_rmse(case: Case) -> Value:
    """Root mean square of the error of longitudinal slope over 10 m, %."""
    return _of_both(case, "cl_grade_rmse", alignment.grade, 100.0)


@metric("cl_axial_drift_slope", needs="truth")
def cl_axial_drift_slope(case: Case) -> Value:
    """Drift of the ring joints, of the sleepers where there are none, along the true axis, m per 100 m."""
    assert case.truth is not None
    curve, bore, furniture = truth_curve(case), case.candidate.bore, case.truth.furniture
    joints = np.stack([np.interp(bore.ring_station, bore.station, axis) for axis in bore.position.T], axis=1)
    pairs = [
        (joints, np.asarray(furniture.get("rings", {}).get("station", ()), float)),
        (case.candidate.track.sleeper, np.asarray(furniture.get("sleepers", {}).get("station", ()), float)),
    ]
    for points, true in pairs:
        if min(len(points), len(true)) >= _FEWEST:
            judged = np.sort(curve.local(points)[:, 0])
            return number(100.0 * abs(alignment.drift_slope(judged, true)), len(judged))
    return missing("neither ring joints nor sleepers to follow along the tunnel")


@metric("cl_icp_rotation", needs="hold")
def cl_icp_rotation(case: Case) -> Value:
    """Turn of the best rigid motion onto the held-out cloud, degrees; it is not applied."""
    return number(alignment.turned(alignment.registration(case)), 1)


@metric("cl_icp_translation", needs="hold")
def cl_icp_translation(case: Case) -> Value:
    """Shift of the same motion at the middle of the cloud, m."""
    return number(float(np.linalg.norm(alignment.registration(case)[:3, 3])), 1)
