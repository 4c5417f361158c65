"""CEN, SEC and LIN: centreline, cross-sections, pockets and rings."""

from collections.abc import Callable

import numpy as np
import shapely
from scipy.spatial.transform import Rotation

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import axis, lining
from benchmarks.fidelity.derive.curve import interpolate_rows, truth_curve
from benchmarks.fidelity.derive.sections import dimensions, sections, variation
from benchmarks.fidelity.registry import (
    Samples,
    Value,
    estimate,
    mean,
    mean_absolute,
    mean_magnitude,
    missing,
    number,
    percentile,
    rms,
)
from benchmarks.fidelity.table import B, D, U, metric

_FEWEST_FEATURES = 10  # features that show a drift
_NO_VARIATION = 1e-3  # m; a section that varies by less is constant
_NO_GRID = 100.0  # %; error of a lining without any grid
_UNKNOWN_PHASE = 0.25  # fraction of a pitch; mean error of an unknown phase
_NO_POCKETS = "the reference shows no pockets"
_NO_MATCH = "no pocket of the candidate lies where the reference has one"
_POCKET_NEIGHBOURS = (0.10, 0.80)  # m of station between pockets that a nail joins
_SAME_ROW = 0.05  # rad


# CEN: the axis of the lining against the axis of the reference, sampled every metre.


@metric("cl_lateral_rmse", "CEN", D(0.00588, 0.099), "m", gate=True, needs="reference", of=rms)
def cl_lateral_rmse(case: Case) -> Samples:
    """Root mean square of the horizontal offset, m."""
    return Samples(axis.axis_pair(case).left, axis.axis_pair(case).station)


@metric("cl_lateral_p95", "CEN", D(0.0113, 0.4), "m", needs="reference", of=percentile(95))
def cl_lateral_p95(case: Case) -> Samples:
    """95th percentile of the horizontal offset, m."""
    both = axis.axis_pair(case)
    return Samples(np.abs(both.left), both.station)


@metric("cl_vertical_rmse", "CEN", D(0.00529, 0.2), "m", needs="reference", of=rms)
def cl_vertical_rmse(case: Case) -> Samples:
    """Root mean square of the vertical offset, m."""
    both = axis.axis_pair(case)
    return Samples(both.judged[:, 2] - both.reference[:, 2], both.station)


@metric("cl_length_rel_err", "CEN", D(0.0012, 5), "%", gate=True, needs="truth")
def cl_length_rel_err(case: Case) -> Value:
    """Error of the arc length from mouth to mouth, %."""
    true = truth_curve(case).length
    return number(100.0 * abs(axis.lining_curve(case).length - true) / true, 1)


@metric("cl_end_station_err", "CEN", D(6.17e-06, 3), "m", needs="truth")
def cl_end_station_err(case: Case) -> Value:
    """Larger axial error of the two mouths, m."""
    curve = truth_curve(case)
    low, high = axis.surface_extent(curve.local(np.asarray(case.candidate.lining.vertices)))
    return number(max(abs(low - curve.station[0]), abs(high - curve.station[-1])), 2)


@metric("cl_heading_rmse", "CEN", D(0.212, 3), "deg", needs="reference", of=rms)
def cl_heading_rmse(case: Case) -> Samples:
    """Root mean square of the heading error on a base of 2 m, degrees."""
    both = axis.axis_pair(case)
    gap = axis.chord_heading(both.judged) - axis.chord_heading(both.reference)
    gap = np.rad2deg((gap + np.pi) % (2 * np.pi) - np.pi)
    return Samples(gap, both.station[1:-1])


@metric(
    "cl_curvature_rmse", "CEN", D(0.000805, 0.005), "1/m", needs="reference", of=rms, args=(axis.plan_curvature, 1.0)
)
@metric("cl_grade_rmse", "CEN", D(0.144, 2), "%", needs="reference", of=rms, args=(axis.longitudinal_slope, 100.0))
def axis_shape_error(case: Case, quantity: Callable[[np.ndarray], np.ndarray], factor: float) -> Samples:
    """Root mean square error of curvature (1/m) or longitudinal slope (%), each over 10 m."""
    both = axis.axis_pair(case)
    difference = quantity(both.judged) - quantity(both.reference)
    trim = (len(both.station) - len(difference)) // 2
    return Samples(factor * difference, both.station[trim : len(both.station) - trim])


@metric("cl_axial_drift_slope", "CEN", D(1e-06, 3), "m/100 m", needs="truth")
def cl_axial_drift_slope(case: Case) -> Value:
    """Drift of the ring joints along the true axis, of the sleepers where there are no joints, m per 100 m."""
    assert case.truth is not None
    curve, bore, furniture = truth_curve(case), case.candidate.bore, case.truth.furniture
    joints = interpolate_rows(bore.ring_station, bore.station, bore.position)
    pairs = [
        (joints, np.asarray(furniture.get("rings", {}).get("station", ()), float)),
        (case.candidate.track.sleeper, np.asarray(furniture.get("sleepers", {}).get("station", ()), float)),
    ]
    for points, true in pairs:
        if min(len(points), len(true)) >= _FEWEST_FEATURES:
            judged = np.sort(curve.local(points)[:, 0])
            return number(100.0 * abs(axis.drift_slope(judged, true)), len(judged))
    return missing("neither ring joints nor sleepers to follow along the tunnel")


@metric("cl_icp_rotation", "CEN", D(0.0416, 1.5), "deg", needs="hold")
def cl_icp_rotation(case: Case) -> Value:
    """Angle of the best rigid motion onto the held-out cloud, degrees; the motion is not applied."""
    return number(np.rad2deg(Rotation.from_matrix(axis.registration(case)[:3, :3]).magnitude()), 1)


@metric("cl_icp_translation", "CEN", unit="m", needs="hold")
def cl_icp_translation(case: Case) -> Value:
    """Shift of that motion at the middle of the cloud, m."""
    return number(float(np.linalg.norm(axis.registration(case)[:3, 3])), 1)


# SEC: size and shape of the sections, every metre, pockets left out.


@metric("sec_width_bias", "SEC", D(1e-06, 0.25), "m", needs="reference", of=mean_magnitude, args=("width",))
@metric("sec_width_rmse", "SEC", D(1e-06, 0.066), "m", needs="reference", of=rms, args=("width",))
@metric("sec_height_bias", "SEC", D(1e-06, 0.25), "m", needs="reference", of=mean_magnitude, args=("height",))
@metric("sec_height_rmse", "SEC", D(1e-06, 0.057), "m", needs="reference", of=rms, args=("height",))
def size_error(case: Case, name: str) -> Samples:
    """Error of the width 1.2 m above the floor, or of the height on the axis, m."""
    judged, reference = dimensions(case)[name]
    return Samples(judged - reference, sections(case).station)


@metric("sec_area_rel_err_mean", "SEC", D(1e-06, 0.91), "%", needs="reference", of=mean)
@metric("sec_area_rel_err_p95", "SEC", D(1e-06, 2), "%", needs="reference", of=percentile(95))
def area_error(case: Case) -> Samples:
    """Relative error of the area, %."""
    judged, reference = dimensions(case)["area"]
    return Samples(100.0 * np.abs(judged / reference - 1.0), sections(case).station)


@metric("sec_iou_mean", "SEC", U(0.85, 0.999999), gate=True, needs="reference", of=mean)
@metric("sec_iou_p05", "SEC", U(0.967, 0.999999), needs="reference", of=percentile(5))
def outline_overlap(case: Case) -> Samples:
    """Intersection over union of the outlines."""
    cut = sections(case)
    union = shapely.area(shapely.union(cut.judged_outline, cut.reference_outline))
    return Samples(shapely.area(cut.common) / union, cut.station)


@metric("sec_overbreak_vol", "SEC", D(1e-06, 0.99), "%", needs="reference", of=mean, args=(0,))
@metric("sec_underbreak_vol", "SEC", D(1e-06, 1.1), "%", needs="reference", of=mean, args=(1,))
def outside_volume(case: Case, side: int) -> Samples:
    """Volume of one side (0 lining, 1 reference) outside the other, % of the reference's volume."""
    area = dimensions(case)["area"]
    outside = area[side] - shapely.area(sections(case).common)
    return Samples(100.0 * outside / area[1].mean(), sections(case).station)


@metric("sec_radial_rmse", "SEC", D(1e-06, 0.04), "m", needs="reference", of=rms)
def sec_radial_rmse(case: Case) -> Samples:
    """Root mean square error of the radius about the reference axis, where the reference is known, m."""
    cut = sections(case)
    error = (cut.judged - cut.reference).ravel()
    return Samples(error, np.repeat(cut.station, len(cut.angle)))


@metric("sec_variation_corr", "SEC", U(0.3, 0.999999), needs="reference")
def sec_variation_corr(case: Case) -> Value:
    """Correlation of width and height, trends removed; 0 for a constant section."""
    judged, reference = variation(case)
    if judged.std() < _NO_VARIATION:
        return number(0.0, judged.size, "the lining's section does not vary")
    return _correlate(judged, reference, sections(case).station, case.rng("sec_variation_corr"))


def _correlate(judged: np.ndarray, reference: np.ndarray, station: np.ndarray, rng: np.random.Generator) -> Value:
    """Return the correlation of two rows of numbers along the tunnel, with its interval."""

    def correlation(index: np.ndarray) -> float:
        rows = index.astype(int)
        return float(np.corrcoef(judged[rows].ravel(), reference[rows].ravel())[0, 1])

    return estimate(correlation, np.arange(len(judged), dtype=float), station, rng)


@metric("sec_variation_ratio", "SEC", B(1, 1e-06, 1), needs="reference")
def sec_variation_ratio(case: Case) -> Value:
    """Standard deviation of that variation in the lining over the one in the reference."""
    judged, reference = variation(case)

    def ratio(index: np.ndarray) -> float:
        row = index.astype(int)
        return float(judged[row].std() / max(reference[row].std(), 1e-12))

    index = np.arange(len(judged), dtype=float)
    return estimate(ratio, index, sections(case).station, case.rng("sec_variation_ratio"))


# LIN: pockets and ring grid on the unrolled lining.


@metric("lin_depth_map_ncc", "LIN", U(0.15, 0.7), gate=True, needs="hold")
def lin_depth_map_ncc(case: Case) -> Value:
    """Correlation of the unrolled depths with those of the held-out recording, smooth section removed."""
    station, judged, hold = lining.paired_depths(case)
    if judged.std() < 1e-4:
        return number(0.0, len(judged), "the lining is smooth")
    return _correlate(judged, hold, station, case.rng("lin_depth_map_ncc"))


@metric("lin_pocket_f1", "LIN", U(0.3, 0.99715), gate=True, needs="reference")
def lin_pocket_f1(case: Case) -> Value:
    """F1 of the pockets, matched within 15 cm on the unrolled wall."""
    judged, reference = lining.judged_pockets(case), lining.reference_pockets(case)
    if not len(reference):
        return missing(_NO_POCKETS)
    return number(2.0 * len(lining.matched_pockets(case)) / (len(judged) + len(reference)), len(reference))


@metric("lin_pocket_count_rel_err", "LIN", D(0.567, 40), "%", needs="reference")
def lin_pocket_count_rel_err(case: Case) -> Value:
    """Relative error of the number of pockets, %."""
    judged, reference = lining.judged_pockets(case), lining.reference_pockets(case)
    if not len(reference):
        return missing(_NO_POCKETS)
    return number(100.0 * abs(len(judged) / len(reference) - 1.0), len(reference))


@metric("lin_pocket_depth_bias", "LIN", D(0.00262, 0.08), "m", needs="reference", of=mean_magnitude, args=("depth",))
@metric("lin_pocket_depth_mae", "LIN", D(0.00324, 0.08), "m", gate=True, needs="reference",
        of=mean_absolute, args=("depth",))  # fmt: skip
@metric("lin_pocket_area_rel_err", "LIN", D(12.2, 60), "%", needs="reference",
        of=lambda errors: float(np.median(np.abs(errors))), args=("area",))  # fmt: skip
def matched_pocket_error(case: Case, name: str) -> Value | Samples:
    """Error of depth (m) or area (%) of the matched pockets."""
    if not len(lining.reference_pockets(case)):
        return missing(_NO_POCKETS)
    pairs = lining.matched_pockets(case)
    if not len(pairs):
        return Value(None, None, 0, _NO_MATCH, failed=True)
    judged, reference = lining.judged_pockets(case), lining.reference_pockets(case)
    size, real = getattr(judged, name)[pairs[:, 0]], getattr(reference, name)[pairs[:, 1]]
    error = size - real if name == "depth" else 100.0 * (size / real - 1.0)
    return Samples(error, reference.station[pairs[:, 1]])


@metric("lin_axial_pitch_err", "LIN", D(1e-06, 10), "%", needs="reference")
def lin_axial_pitch_err(case: Case) -> Value:
    """Relative error of the pitch of the rings along the tunnel, %."""
    reference = lining.reference_pitch(case)
    if reference is None:
        return missing(_NO_POCKETS)
    judged = lining.ring_pitch(lining.both_maps(case)[0], reference, lining.RING_BAND)
    if judged is None:
        return number(_NO_GRID, 0, "the lining has no relief")
    return number(100.0 * abs(judged / reference - 1.0), 1, f"{judged:.4f} m against {reference:.4f} m")


@metric("lin_circ_pitch_err", "LIN", D(1e-06, 15), "%", needs="reference")
def lin_circ_pitch_err(case: Case) -> Value:
    """Relative error of the median distance between rows of pockets around the section, %."""
    arc = lining.reference_arc(case)
    judged, reference = (np.diff(lining.pocket_rows(side, arc)) for side in lining.both_maps(case))
    if not len(reference):
        return missing(_NO_POCKETS)
    if not len(judged):
        return number(_NO_GRID, 0, "the lining has no rows of pockets")
    return number(100.0 * abs(float(np.median(judged) / np.median(reference)) - 1.0), len(reference))


@metric("lin_ring_phase_err", "LIN", D(1e-06, 0.25), needs="reference", of=mean)
def lin_ring_phase_err(case: Case) -> Value | Samples:
    """Mean absolute error of the grid's phase in windows of four pitches, fraction of a pitch."""
    length = lining.reference_pitch(case)
    if length is None:
        return missing(_NO_POCKETS)
    judged, reference = (lining.ring_phases(side, length) for side in lining.both_maps(case))
    count = min(len(judged), len(reference))
    gap = np.abs((judged[:count] - reference[:count] + np.pi) % (2 * np.pi) - np.pi) / (2 * np.pi)
    centre = length * lining.PHASE_PITCHES / 2 * (1 + np.arange(count))
    return Samples(np.where(np.isnan(judged[:count]), _UNKNOWN_PHASE, gap), centre)


@metric("lin_nail_count_ratio", "LIN")
def lin_nail_count_ratio(case: Case) -> Value:
    """Connecting nails of the candidate over its pairs of neighbouring pockets in a row."""
    pocket = case.candidate.bore.pocket
    order = np.lexsort((pocket["station"], np.round(pocket["angle"] / _SAME_ROW)))
    gap, turn = np.diff(pocket["station"][order]), np.abs(np.diff(pocket["angle"][order]))
    pairs = int(((gap > _POCKET_NEIGHBOURS[0]) & (gap < _POCKET_NEIGHBOURS[1]) & (turn < _SAME_ROW)).sum())
    if not pairs:
        return missing("the candidate has no neighbouring pockets")
    return number(case.candidate.manifest.get("count", {}).get("nails", 0) / pairs, pairs)
