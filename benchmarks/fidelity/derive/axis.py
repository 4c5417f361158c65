"""The axes of reference and lining, and the offset between them."""

from dataclasses import dataclass

import numpy as np
import small_gicp
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.signal import savgol_filter
from scipy.stats import theilslopes

from benchmarks.fidelity.case import Case, kept_until, per_case, per_hold
from benchmarks.fidelity.derive import curve as curves
from benchmarks.fidelity.derive.beams import returns
from benchmarks.fidelity.derive.surface import Caster, sample_surface, visible_surface

_SEED_APART = 0.9  # m between the sensor positions that begin the axis: a second pass adds none
_AXIS_SMOOTH = 3.0  # m
_SEED_CALM = 8.0  # m
_ROUNDS = 3
_MOST_POINTS = 400_000
_KNOWN_SHARE = 0.6  # fraction of the sectors that makes a slice count


def reference_curve(case: Case) -> curves.Curve:
    """Return the generator's axis where there is a truth, otherwise the held-out recording's."""
    return curves.truth_curve(case) if case.truth is not None else hold_curve(case)


@per_hold
def hold_points(case: Case) -> Float[np.ndarray, "k 3"]:
    """Return the points of the held-out recording, at most about 400,000, m."""
    points = returns(case).points  # in an order that does not hang on the file's
    return points[:: max(1, -(-len(points) // _MOST_POINTS))]


@per_hold
def seed_path(case: Case) -> curves.Curve:
    """Return the path of the sensor, each place once."""
    assert case.hold is not None
    first = np.unique(case.hold.scan, return_index=True)[1]
    kept: list[np.ndarray] = []
    for here in case.hold.origin[np.sort(first)]:
        if all(np.linalg.norm(here - there) > _SEED_APART for there in kept):
            kept.append(here)
    if len(kept) < 4:
        raise ValueError("the held-out recording moves too little to show an axis")
    path = curves.Curve.through(np.array(kept))
    station = np.linspace(0.0, path.length, max(int(path.length), 4) + 1)
    even = path.frames(station)[0]
    # A vehicle sways; frames that sway with it would cut the bore askew.
    return curves.Curve.through(curves.smooth_along(even, station[1], _SEED_CALM))


@per_hold
def hold_curve(case: Case) -> curves.Curve:
    """Estimates the axis of the held-out recording: the middle of width and height, by medians of polar radii.

    Method: 0.5 m slices across the sensor's path, median radius of each 5 degree sector, their middle by mirrored
    sectors, repeated about the new axis; a track is cut away from the floor once the floor is known. No code of the
    builder takes part.
    """
    curve, points, floor = seed_path(case), hold_points(case), None
    angle = curves.section_angles(round(2 * np.pi / curves.SECTOR))
    for _ in range(_ROUNDS):
        local = curve.local(points)
        low, high = np.percentile(local[:, 0], [0.5, 99.5])
        station = np.arange(low, high, curves.SLICE)
        profile = curves.running_median(curves.point_profile(local, station, floor), curves.SLICE)
        complete = np.isfinite(profile).mean(axis=1) > _KNOWN_SHARE
        if complete.sum() < 4:
            raise ValueError("the held-out recording shows too little of the section")
        keep = slice(np.flatnonzero(complete)[0], np.flatnonzero(complete)[-1] + 1)
        offset = curves.smooth_along(curves.section_middle(profile[keep], angle), curves.SLICE, _AXIS_SMOOTH)
        floor = float(np.nanmedian(curves.crown_and_floor(profile[keep], angle)[1])) - float(np.median(offset[:, 1]))
        curve = curves.Curve.through(curve.point(np.column_stack([station[keep], offset])))
    return curve


@per_hold
def hold_local(case: Case) -> Float[np.ndarray, "k 3"]:
    """Return `hold_points` as station, left and up about the recording's own axis, m."""
    return hold_curve(case).local(hold_points(case))


@kept_until("LIN", per_case)
def lining_caster(case: Case) -> Caster:
    return Caster(case.candidate.lining)


def surface_extent(local: Float[np.ndarray, "k 3"]) -> tuple[float, float]:
    """Return the first and last station of a surface, m, each the median over 16 sectors."""
    sector = np.minimum(((np.arctan2(local[:, 2], local[:, 1]) + np.pi) / (np.pi / 8)).astype(int), 15)
    low, high = np.full(16, np.inf), np.full(16, -np.inf)
    np.minimum.at(low, sector, local[:, 0])
    np.maximum.at(high, sector, local[:, 0])
    known = np.isfinite(low)
    return float(np.median(low[known])), float(np.median(high[known]))


@per_case
def lining_curve(case: Case) -> curves.Curve:
    """Estimates the axis of the lining itself: the middle of width and height of its sections, mouth to mouth.

    The declared centreline only says from where the sections are looked at.
    """
    declared, angle = curves.candidate_curve(case), curves.section_angles(120)
    low, high = surface_extent(declared.local(np.asarray(case.candidate.lining.vertices)))
    station = np.linspace(low, high, max(round((high - low) / curves.ROW_STEP), 4) + 1)
    step = station[1] - station[0]
    inner = station.copy()
    inner[0], inner[-1] = station[0] + 0.01, station[-1] - 0.01  # a ray in the very plane of the mouth may miss
    profile = curves.running_median(curves.cast_profile(lining_caster(case), declared, inner, angle), step)
    offset = curves.smooth_along(curves.section_middle(profile, angle), step, _AXIS_SMOOTH / 2)
    return curves.Curve.through(declared.point(np.column_stack([station, offset])))


# Offset and registration between the two axes, and drift of features along them.

PAIR_STEP = 1.0  # m
_ICP_SPACING = 0.15  # m between the points that are registered
_ICP_REACH = 0.5  # m; correspondences farther apart are none


@dataclass(frozen=True)
class AxisPair:
    """Two axes at the same reference stations."""

    station: Float[np.ndarray, " n"]  # Stations on the reference axis, every metre
    left: Float[np.ndarray, " n"]  # left, up: Offset of the lining's axis, m
    up: Float[np.ndarray, " n"]
    judged: Float[np.ndarray, "n 3"]  # Points of the lining's axis, m
    reference: Float[np.ndarray, "n 3"]  # Points of the reference axis, m


@per_case
def axis_pair(case: Case) -> AxisPair:
    reference, axis = reference_curve(case), lining_curve(case)
    fine = axis.frames(np.linspace(0.0, axis.length, int(axis.length / 0.25) + 2))[0]
    local = reference.local(fine)
    local = local[np.argsort(local[:, 0], kind="stable")]
    local = local[np.concatenate([[True], np.diff(local[:, 0]) > 1e-6])]
    low, high = max(reference.station[0], local[0, 0]), min(reference.station[-1], local[-1, 0])
    if high - low < 5.0:
        raise ValueError("lining and reference share less than 5 m of chainage")
    station = np.arange(low, high, PAIR_STEP)
    offset = CubicSpline(local[:, 0], local[:, 1:])(station)
    judged = reference.point(np.column_stack([station, offset]))
    return AxisPair(station, offset[:, 0], offset[:, 1], judged, reference.frames(station)[0])


def chord_heading(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " m"]:
    chord = points[2:] - points[:-2]
    return np.arctan2(chord[:, 1], chord[:, 0])


def plan_curvature(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Return the curvature of the plan by a local parabola over 10 m, 1/m."""
    first, second = (_derivative(points[:, :2], order) for order in (1, 2))
    across = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return across / np.linalg.norm(first, axis=1) ** 3


def longitudinal_slope(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Return the longitudinal slope by a local parabola over 10 m, 1."""
    first = _derivative(points, 1)
    return first[:, 2] / np.linalg.norm(first[:, :2], axis=1)


def _derivative(values: np.ndarray, order: int) -> np.ndarray:
    window = min(11, len(values) - 1 + len(values) % 2)
    return savgol_filter(values, window, 2, deriv=order, delta=PAIR_STEP, axis=0)


def drift_slope(judged: Float[np.ndarray, " k"], true: Float[np.ndarray, " t"]) -> float:
    """Estimates the slope of the axial residual of a sequence of features, m/m.

    Features are matched in order: each to the true one nearest to where the drift so far puts it, so that a drift of
    more than half a spacing is followed, and a constant offset does not count.

    Args:
        judged: Stations of the reconstructed features on the reference axis, m.
        true: Stations of the true features, m.
    """
    reach = 0.5 * float(np.median(np.diff(true)))
    drift, residual = 0.0, np.full(len(judged), np.nan)
    for i, station in enumerate(judged):
        gap = station - drift - true[np.argmin(np.abs(true - (station - drift)))]
        if abs(gap) < 0.8 * reach:
            drift += gap
            residual[i] = drift
    matched = np.isfinite(residual)
    if matched.sum() < 5:
        raise ValueError("fewer than five features match")
    return float(theilslopes(residual[matched], (judged - residual)[matched]).slope)


@per_case
def registration(case: Case) -> Float[np.ndarray, "4 4"]:
    """Estimates the rigid motion of the visible surface onto the held-out cloud, about the middle of the cloud."""
    target = hold_points(case)
    centre = np.round(target.mean(axis=0))
    source, _ = sample_surface(visible_surface(case), 2 * _ICP_SPACING)
    low, high = target.min(axis=0) - _ICP_REACH, target.max(axis=0) + _ICP_REACH
    source = source[((source > low) & (source < high)).all(axis=1)]
    result = small_gicp.align(
        target - centre, source - centre, registration_type="PLANE_ICP",
        downsampling_resolution=_ICP_SPACING, max_correspondence_distance=_ICP_REACH, num_threads=1,
    )  # fmt: skip
    return np.asarray(result.T_target_source)
