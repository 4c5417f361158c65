"""TRK: sleepers and rails against those of truth or held-out recording, and against the bore that they lie in."""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import inventory, seats, tracks
from benchmarks.fidelity.derive.railway import STANDARD_GAUGE, railway
from benchmarks.fidelity.registry import metric
from benchmarks.fidelity.value import Value, estimate, missing, number

_MATCH = 0.15  # m
_MARGIN = 0.02  # m between a sleeper and the wall
_BASE = 3.0  # m; of the twist
_NO_SLEEPERS = "the reference shows no sleepers"
_NO_RAILS = "the reference shows no rails"
_NO_TRACK = "the candidate has no track"


@metric("trk_sleeper_f1", needs="reference")
def trk_sleeper_f1(case: Case) -> Value:
    """F1 of sleepers that are each other's nearest and within 0.15 m; 0 where the truth has none but the candidate."""
    real, made = tracks.sleepers(railway(case)), tracks.in_reach(case)
    if not len(real) and (case.truth is None or not len(made)):
        return missing(_NO_SLEEPERS)
    if not len(real) or not len(made):
        return number(0.0, len(real) + len(made))
    gap, nearest = cKDTree(real).query(made)
    back: Int[np.ndarray, " r"] = cKDTree(made).query(real)[1]
    matched = (back[nearest] == np.arange(len(made))) & (gap <= _MATCH * case.tolerance)
    return number(2.0 * matched.sum() / (len(real) + len(made)), len(real) + len(made))


@metric("trk_sleeper_count_rel_err", needs="reference")
def trk_sleeper_count_rel_err(case: Case) -> Value:
    """Relative difference of counts, %."""
    real, made = tracks.sleepers(railway(case)), tracks.in_reach(case)
    if not len(real):
        return missing(_NO_SLEEPERS)
    return number(100.0 * abs(len(made) - len(real)) / len(real), len(real))


@metric("trk_sleeper_spacing_err", needs="reference")
def trk_sleeper_spacing_err(case: Case) -> Value:
    """Difference of mean spacings, missing sleepers left out, m."""
    return _of_spacings(case, np.mean)


@metric("trk_sleeper_spacing_std_err", needs="reference")
def trk_sleeper_spacing_std_err(case: Case) -> Value:
    """Difference of the spacings' standard deviations, m."""
    return _of_spacings(case, np.std)


def _of_spacings(case: Case, statistic) -> Value:
    real, made = tracks.spacings(tracks.sleepers(railway(case))), tracks.spacings(tracks.in_reach(case))
    if not len(real):
        return missing(_NO_SLEEPERS)
    if not len(made):
        return number(float("nan"), 0, "the candidate has no two sleepers side by side")
    return number(abs(float(statistic(made)) - float(statistic(real))), len(made))


@metric("trk_sleeper_in_bore")
def trk_sleeper_in_bore(case: Case) -> Value:
    """Share of sleepers whose top keeps 2 cm from the wall of the local section."""
    if not len(case.candidate.track.sleeper):
        return missing(_NO_TRACK)
    fits = tracks.sleepers_fit(case, _MARGIN)
    return number(float(np.mean(fits)), len(fits))


def _asked_gauge(case: Case) -> tuple[float | None, str]:
    """The gauge to be met and where it is from; `None` where the reference shows no rails."""
    reference = railway(case)
    if not reference.rail.shape[1]:
        return None, _NO_RAILS
    if reference.gauge is not None:
        return reference.gauge, "against the truth's own rails"
    return STANDARD_GAUGE, "K: against the standard gauge, held-out returns being too coarse for millimetres"


@metric("trk_gauge_mean_err", needs="reference")
def trk_gauge_mean_err(case: Case) -> Value:
    """Mean gauge of the exported rails against the reference's, mm."""
    asked, reason = _asked_gauge(case)
    if asked is None:
        return missing(reason)
    return number(1e3 * abs(tracks.gauges(case).mean() - asked), len(tracks.gauges(case)), reason)


@metric("trk_gauge_p95_dev", needs="reference")
def trk_gauge_p95_dev(case: Case) -> Value:
    """95th percentile of the deviation along the track, mm."""
    asked, reason = _asked_gauge(case)
    if asked is None:
        return missing(reason)
    return number(1e3 * np.percentile(np.abs(tracks.gauges(case) - asked), 95), len(tracks.gauges(case)), reason)


@metric("trk_rail_lateral_rmse", needs="reference")
def trk_rail_lateral_rmse(case: Case) -> Value:
    """Lateral offset of the track's middle, m."""
    return _offset(case, 1, "trk_rail_lateral_rmse")


@metric("trk_rail_height_rmse", needs="reference")
def trk_rail_height_rmse(case: Case) -> Value:
    """Offset of the rails' tops in height, m."""
    return _offset(case, 2, "trk_rail_height_rmse")


def _offset(case: Case, column: int, id: str) -> Value:
    if not railway(case).rail.shape[1]:
        return missing(_NO_RAILS)
    offsets = tracks.rail_offsets(case)
    return estimate(_rms, offsets[:, column], offsets[:, 0], case.rng(id))


def _rms(values: Float[np.ndarray, " k"]) -> float:
    return float(np.sqrt(np.mean(values**2)))


@metric("trk_rail_gap_max")
def trk_rail_gap_max(case: Case) -> Value:
    """Longest stretch between the first and the last sleeper that a rail leaves out, m."""
    if not len(case.candidate.track.sleeper):
        return missing(_NO_TRACK)
    return number(max(tracks.rail_gaps(case)), 2)


@metric("trk_twist_p95")
def trk_twist_p95(case: Case) -> Value:
    """Change of the rails' difference in height over 3 m, mm/m."""
    twist = 1e3 * np.abs(tracks.twist(case, _BASE))
    if not len(twist):
        return missing(_NO_TRACK)
    return number(np.percentile(twist, 95), len(twist), "K: railway practice judges twist on a base of 3 m")


@metric("trk_fastener_ratio")
def trk_fastener_ratio(case: Case) -> Value:
    """Fastenings over rail seats, two to a sleeper."""
    count = 2 * len(case.candidate.track.sleeper)
    if not count:
        return missing(_NO_TRACK)
    return number(len(inventory.fastening_sets(case)) / count, count, "K: one fastening to a seat")


@metric("trk_asset_penetration_max")
def trk_asset_penetration_max(case: Case) -> Value:
    """Largest overlap or gap of rail, pad, sleeper and bed, m."""
    if not len(case.candidate.track.sleeper):
        return missing(_NO_TRACK)
    found = seats.mismatches(case)
    return number(np.abs(found).max(), len(found))
