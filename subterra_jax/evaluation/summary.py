"""What many records say: means, intervals, a score between dead reckoning and the truth, the area under faults."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from subterra_jax.evaluation.records import Records

N_RESAMPLES = 2000
_MEANS = (
    "coverage", "progress", "spl", "clearance", "offset", "lateral", "time", "jerk", "axial_rms", "drift",
    "time_to_lock", "cycle_slips", "crps", "nees",
)  # fmt: skip
_SIZES = ("goal_error", "axial_final")  # whose mean would hide it


def summary(records: Records, seed: int = 0) -> dict[str, Any]:
    """Scores of one agent on one task, as plain values; None where a quantity does not apply.

    Args:
        records: Its episodes.
        seed: Of the bootstrap.

    Returns:
        `episodes`; `success`, the mean; `success_iqm`, the inter-quartile mean over the groups of episodes; the ends
        `success_low` and `success_high` of the 95 % interval of the mean; `contacts_per_100m` over all episodes
        together; means of the rest of the record's quantities (of `goal_error` and `axial_final` the mean size), and of
        `nees` the median too; with several severities `success_by_severity` and `success_area` under it.
    """
    groups = grouped(records.success.astype(float), records.group)
    low, high = interval(groups, lambda scores: scores.mean(axis=(-2, -1)), seed)
    travelled = records.travelled.sum()
    found: dict[str, Any] = {
        "episodes": len(records),
        "success": float(records.success.mean()),
        "success_iqm": interquartile_mean(groups.mean(axis=1)),
        "success_low": low,
        "success_high": high,
        "contacts_per_100m": float(100.0 * records.contact.sum() / travelled) if travelled > 0.0 else None,
    }
    found |= {name: _mean(getattr(records, name)) for name in _MEANS}
    found |= {name: _mean(np.abs(getattr(records, name))) for name in _SIZES}
    found["nees_median"] = _mean(np.atleast_1d(np.median(records.nees)))
    severities = np.unique(records.severity)
    if len(severities) > 1:
        by_severity = [float(records.success[records.severity == s].mean()) for s in severities]
        found["success_by_severity"] = dict(zip(severities.tolist(), by_severity, strict=True))
        found["success_area"] = area(severities.astype(float), np.array(by_severity))
    return found


def _mean(values: Float[np.ndarray, " n"]) -> float | None:
    valid = values[~np.isnan(values)]
    return float(valid.mean()) if len(valid) else None


def grouped(values: Float[np.ndarray, " n"], group: Int[np.ndarray, " n"]) -> Float[np.ndarray, "groups size"]:
    """Values by group, one row each; groups larger than the smallest lose their last values."""
    rows = [values[group == g] for g in np.unique(group)]
    size = min(len(row) for row in rows)
    return np.stack([row[:size] for row in rows])


def interquartile_mean(scores: Float[np.ndarray, " n"]) -> float:
    """Mean of the middle half, the values on its borders counted in part.

    Source: Agarwal et al. 2021, Deep Reinforcement Learning at the Edge of the Statistical Precipice.
    """
    n = len(scores)
    # Value i covers the quantiles from i / n to (i + 1) / n.
    ends = np.clip(np.arange(n + 1) / n, 0.25, 0.75)
    return float(np.sum(np.sort(scores) * np.diff(ends)) / 0.5)


def interval(
    scores: Float[np.ndarray, "strata size"],
    statistic: Callable[[np.ndarray], np.ndarray],
    seed: int = 0,
    level: float = 0.95,
) -> tuple[float, float]:
    """Percentile interval of a statistic by the stratified bootstrap.

    Args:
        scores: Values, one row for each stratum; each row is drawn from by itself.
        statistic: From `(resamples, strata, size)` to `(resamples,)`.
        seed: Of the draws: the same scores give the same interval.
        level: Its confidence.

    Source: Agarwal et al. 2021, as `interquartile_mean`.
    """
    strata, size = scores.shape
    index = np.random.default_rng(seed).integers(size, size=(N_RESAMPLES, strata, size))
    drawn = statistic(scores[np.arange(strata)[None, :, None], index])
    low, high = np.quantile(drawn, [0.5 - level / 2.0, 0.5 + level / 2.0])
    return float(low), float(high)


def normalised(score: float, floor: float, ceiling: float) -> float | None:
    """0 for dead reckoning, 1 for the oracle; None where those two do not differ by a hundredth."""
    return None if ceiling - floor < 0.01 else (score - floor) / (ceiling - floor)


def area(severity: Float[np.ndarray, " n"], success: Float[np.ndarray, " n"]) -> float:
    """Area under success against severity, 0 to 1, by trapezia."""
    return float(np.trapezoid(success, severity) / (severity[-1] - severity[0]))
