"""TRK: sleepers and rails against those of truth or recording, and against the bore that they lie in."""

import numpy as np
from jaxtyping import Int
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import track
from benchmarks.fidelity.derive.scene import fastening_sets, seat_mismatches
from benchmarks.fidelity.registry import Samples, Statistic, Value, missing, number, rms
from benchmarks.fidelity.table import B, D, U, metric

_SLEEPER_MATCH = 0.15  # m
_BORE_MARGIN = 0.02  # m between a sleeper and the wall
_TWIST_BASE = 3.0  # m
_NO_SLEEPERS = "the reference shows no sleepers"
_NO_RAILS = "the reference shows no rails"
_NO_TRACK = "the candidate has no track"


@metric("trk_sleeper_f1", "TRK", U(0.7, 0.999999), gate=True, needs="reference")
def trk_sleeper_f1(case: Case) -> Value:
    """F1 of sleepers that are each other's nearest within 0.15 m; 0 where the truth has none but the candidate."""
    real, judged = track.reference_sleepers(track.reference_railway(case)), track.candidate_sleepers(case)
    if not len(real) and (case.truth is None or not len(judged)):
        return missing(_NO_SLEEPERS)
    if not len(real) or not len(judged):
        return number(0.0, len(real) + len(judged))
    gap, nearest = cKDTree(real).query(judged)
    back: Int[np.ndarray, " r"] = cKDTree(judged).query(real)[1]
    matched = (back[nearest] == np.arange(len(judged))) & (gap <= _SLEEPER_MATCH * case.tolerance)
    return number(2.0 * matched.sum() / (len(real) + len(judged)), len(real) + len(judged))


@metric("trk_sleeper_count_rel_err", "TRK", D(1e-06, 8), "%", needs="reference")
def trk_sleeper_count_rel_err(case: Case) -> Value:
    """Relative difference of counts, %."""
    real, judged = track.reference_sleepers(track.reference_railway(case)), track.candidate_sleepers(case)
    if not len(real):
        return missing(_NO_SLEEPERS)
    return number(100.0 * abs(len(judged) - len(real)) / len(real), len(real))


@metric("trk_sleeper_spacing_err", "TRK", D(1e-06, 0.03), "m", needs="reference", evidence="HTK", args=(np.mean,))
@metric("trk_sleeper_spacing_std_err", "TRK", D(1e-06, 0.06), "m", needs="reference", args=(np.std,))
def spacing_error(case: Case, statistic: Statistic) -> Value:
    """Difference of mean or standard deviation of the spacings, missing sleepers left out, m."""
    real = track.sleeper_spacings(track.reference_sleepers(track.reference_railway(case)))
    judged = track.sleeper_spacings(track.candidate_sleepers(case))
    if not len(real):
        return missing(_NO_SLEEPERS)
    if not len(judged):
        return number(float("nan"), 0, "the candidate has no two sleepers side by side")
    return number(abs(float(statistic(judged)) - float(statistic(real))), len(judged))


@metric("trk_sleeper_in_bore", "TRK", U(0.98, 1))
def trk_sleeper_in_bore(case: Case) -> Value:
    """Share of sleepers whose top keeps 2 cm from the wall of the local section."""
    if not len(case.candidate.track.sleeper):
        return missing(_NO_TRACK)
    fits = track.sleepers_fit(case, _BORE_MARGIN)
    return number(float(np.mean(fits)), len(fits))


def _reference_gauge(case: Case) -> tuple[float | None, str]:
    """Return the gauge to be met and its source; `None` where the reference shows no rails."""
    reference = track.reference_railway(case)
    if not reference.rail.shape[1]:
        return None, _NO_RAILS
    if reference.gauge is not None:
        return reference.gauge, "against the truth's own rails"
    return track.STANDARD_GAUGE, "K: against the standard gauge, held-out returns being too coarse for millimetres"


@metric("trk_gauge_mean_err", "TRK", D(1e-06, 10), "mm", gate=True, needs="reference", evidence="HTK")
def trk_gauge_mean_err(case: Case) -> Value:
    """Error of the mean gauge of the exported rails, mm."""
    asked, reason = _reference_gauge(case)
    if asked is None:
        return missing(reason)
    return number(1e3 * abs(track.candidate_gauge(case).mean() - asked), len(track.candidate_gauge(case)), reason)


@metric("trk_gauge_p95_dev", "TRK", D(0.000524, 10), "mm", needs="reference", evidence="HTK")
def trk_gauge_p95_dev(case: Case) -> Value:
    """95th percentile of the deviation of the gauge along the track, mm."""
    asked, reason = _reference_gauge(case)
    if asked is None:
        return missing(reason)
    gauge = track.candidate_gauge(case)
    return number(1e3 * np.percentile(np.abs(gauge - asked), 95), len(gauge), reason)


@metric("trk_rail_lateral_rmse", "TRK", D(2.78e-06, 0.1), "m", needs="reference", of=rms, args=(1,))
@metric("trk_rail_height_rmse", "TRK", D(1e-06, 0.12), "m", needs="reference", of=rms, args=(2,))
def rail_offset(case: Case, column: int) -> Value | Samples:
    """Root mean square offset of the track's middle (1 lateral, 2 in height), m."""
    if not track.reference_railway(case).rail.shape[1]:
        return missing(_NO_RAILS)
    offsets = track.rail_offsets(case)
    return Samples(offsets[:, column], offsets[:, 0])


@metric("trk_rail_gap_max", "TRK", D(0.02, 0.5), "m")
def trk_rail_gap_max(case: Case) -> Value:
    """Longest stretch between the first and the last sleeper that a rail leaves out, m."""
    if not len(case.candidate.track.sleeper):
        return missing(_NO_TRACK)
    return number(max(track.rail_gaps(case)), 2)


@metric("trk_twist_p95", "TRK", unit="mm/m", evidence="K")
def trk_twist_p95(case: Case) -> Value:
    """95th percentile of the change of the rails' difference in height over 3 m, mm/m."""
    twist = 1e3 * np.abs(track.rail_twist(case, _TWIST_BASE))
    if not len(twist):
        return missing(_NO_TRACK)
    return number(np.percentile(twist, 95), len(twist), "K: railway practice judges twist on a base of 3 m")


@metric("trk_fastener_ratio", "TRK", B(1, 0.005, 0.1), evidence="K")
def trk_fastener_ratio(case: Case) -> Value:
    """Fastenings over rail seats, two to a sleeper."""
    count = 2 * len(case.candidate.track.sleeper)
    if not count:
        return missing(_NO_TRACK)
    return number(len(fastening_sets(case)) / count, count, "K: one fastening to a seat")


@metric("trk_asset_penetration_max", "TRK", D(0.005, 0.05), "m")
def trk_asset_penetration_max(case: Case) -> Value:
    """Largest overlap or gap of rail, pad, sleeper and bed, m."""
    if not len(case.candidate.track.sleeper):
        return missing(_NO_TRACK)
    mismatches = seat_mismatches(case)
    return number(np.abs(mismatches).max(), len(mismatches))
