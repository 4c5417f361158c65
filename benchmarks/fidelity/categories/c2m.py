"""C2M, surface accuracy: held-out points to the candidate, without any registration."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.change import significance
from benchmarks.fidelity.derive.distances import BOOTSTRAP, mean_distance, to_mesh
from benchmarks.fidelity.derive.extent import bins
from benchmarks.fidelity.derive.noise import real_planes
from benchmarks.fidelity.registry import metric
from benchmarks.fidelity.value import Value, estimate, missing, number

_FEWEST = 50  # points in a bin that counts


def _distance(case: Case, id: str, statistic: Callable[[Float[np.ndarray, " k"]], float]) -> Value:
    return estimate(statistic, to_mesh(case).distance, to_mesh(case).station, case.rng(id), BOOTSTRAP)


@metric("c2m_mean", needs="hold")
def c2m_mean(case: Case) -> Value:
    """Mean distance, m."""
    return _distance(case, "c2m_mean", np.mean)


@metric("c2m_median", needs="hold")
def c2m_median(case: Case) -> Value:
    """Median distance, m."""
    return _distance(case, "c2m_median", np.median)


@metric("c2m_rmse", needs="hold")
def c2m_rmse(case: Case) -> Value:
    """Root of the mean squared distance, m."""
    return _distance(case, "c2m_rmse", lambda d: float(np.sqrt(np.mean(d**2))))


@metric("c2m_p95", needs="hold")
def c2m_p95(case: Case) -> Value:
    """95th percentile, m."""
    return _distance(case, "c2m_p95", lambda d: float(np.percentile(d, 95)))


@metric("c2m_p99", needs="hold")
def c2m_p99(case: Case) -> Value:
    """99th percentile, m."""
    return _distance(case, "c2m_p99", lambda d: float(np.percentile(d, 99)))


@metric("c2m_within_5cm", needs="hold")
def c2m_within_5cm(case: Case) -> Value:
    """Share within 5 cm."""
    return _distance(case, "c2m_within_5cm", lambda d: float(np.mean(d <= 0.05 * case.tolerance)))


@metric("c2m_within_10cm", needs="hold")
def c2m_within_10cm(case: Case) -> Value:
    """Share within 10 cm, the paper's figure on points that the builder never saw."""
    return _distance(case, "c2m_within_10cm", lambda d: float(np.mean(d <= 0.10 * case.tolerance)))


@metric("c2m_signed_bias", needs="hold")
def c2m_signed_bias(case: Case) -> Value:
    """Mean of the distance signed by the side of the sensor, without its sign, m."""
    found = to_mesh(case)
    return estimate(
        lambda d: float(abs(np.mean(d))), found.signed, found.station, case.rng("c2m_signed_bias"), BOOTSTRAP
    )


@metric("c2m_chainage_worst", needs="hold")
def c2m_chainage_worst(case: Case) -> Value:
    """Largest mean of a bin of about 10 m, m."""
    return _worst(to_mesh(case).distance, bins(case, to_mesh(case).station))


@metric("c2m_sector_worst", needs="hold")
def c2m_sector_worst(case: Case) -> Value:
    """Largest mean of eight sectors about the axis, m."""
    return _worst(to_mesh(case).distance, to_mesh(case).sector)


@metric("c2m_noise_ratio", needs="hold")
def c2m_noise_ratio(case: Case) -> Value:
    """Median distance over the median residual of the held-out points from their own local planes."""
    return number(float(np.median(to_mesh(case).distance) / np.median(real_planes(case).residual)))


@metric("c2m_fit_hold_gap", needs="hold")
def c2m_fit_hold_gap(case: Case) -> Value:
    """How much farther held-out points lie than those that the builder read, m; 0 where they do not."""
    if case.fit is None:
        return missing("the recording that the builder read is not at hand")
    gap = float(np.mean(to_mesh(case).distance)) - mean_distance(case, case.fit)
    return number(max(gap, 0.0), len(to_mesh(case).distance))


@metric("m3c2_signif_frac", needs="hold")
def m3c2_signif_frac(case: Case) -> Value:
    """Share of core points whose M3C2 distance exceeds its level of detection."""
    found = significance(case)
    return estimate(np.mean, found.significant, found.station, case.rng("m3c2_signif_frac"), BOOTSTRAP)


def _worst(distance: np.ndarray, group: np.ndarray) -> Value:
    count = np.bincount(group)
    mean = np.bincount(group, distance) / np.maximum(count, 1)
    full = count >= min(_FEWEST, count.max())
    return number(float(mean[full].max()), len(distance))
