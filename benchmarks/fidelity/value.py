"""What a metric returns."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

BLOCK = 10.0  # m of chainage; points nearer than this are not independent
RESAMPLES = 200


@dataclass(frozen=True)
class Value:
    """A raw value with what is known about it.

    Attributes:
        value: In the table's unit; `None` where it cannot be had.
        interval: 95 % block-bootstrap interval.
        n: Samples behind it.
        reason: Why there is none, or what limits it.
        failed: The computation broke on this candidate; scores 0 instead of being left out.
    """

    value: float | None
    interval: tuple[float, float] | None = None
    n: int = 0
    reason: str = ""
    failed: bool = False


def number(value: float, n: int = 0, reason: str = "") -> Value:
    """A value without an interval; one that is not finite becomes `None` and counts as failed."""
    if not np.isfinite(value):
        return Value(None, None, n, reason or "not a finite number", failed=True)
    return Value(float(value), None, n, reason)


def passed(condition: bool, reason: str = "") -> Value:
    """1 or 0."""
    return Value(float(bool(condition)), None, 1, reason)


def missing(reason: str) -> Value:
    """No reference for it: left out of every mean, never taken for good."""
    return Value(None, None, 0, reason)


def estimate(
    statistic: Callable[[Float[np.ndarray, " k"]], float],
    samples: Float[np.ndarray, " n"],
    station: Float[np.ndarray, " n"],
    rng: np.random.Generator,
    most: int = 200_000,
) -> Value:
    """A statistic of samples along the tunnel with its block-bootstrap interval.

    Args:
        statistic: Of any subset of the samples.
        samples: One number each.
        station: Where along the tunnel each lies, m; blocks are `BLOCK` long.
        rng: Draws the blocks.
        most: Samples used for the interval at most; the value itself uses all.
    """
    keep = np.isfinite(samples)
    samples, station = samples[keep], station[keep]
    if not len(samples):
        return Value(None, None, 0, "no samples", failed=True)
    value = float(statistic(samples))
    if not np.isfinite(value):
        return Value(None, None, len(samples), "not a finite number", failed=True)
    stride = max(1, len(samples) // most)
    order = np.argsort(station[::stride] // BLOCK, kind="stable")
    thin, block = samples[::stride][order], (station[::stride] // BLOCK)[order]
    groups = np.split(thin, np.flatnonzero(np.diff(block)) + 1)
    if len(groups) < 3:
        return Value(value, None, len(samples), "too short for an interval")
    draws = rng.integers(0, len(groups), (RESAMPLES, len(groups)))
    spread = [statistic(np.concatenate([groups[i] for i in draw])) for draw in draws]
    low, high = np.nanpercentile(spread, [2.5, 97.5])
    return Value(value, (float(low), float(high)), len(samples))
