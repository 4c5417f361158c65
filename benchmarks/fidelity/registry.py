"""Values, and the computation of all metrics."""

from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from benchmarks.fidelity import table
from benchmarks.fidelity.case import Case, release_memory
from benchmarks.fidelity.table import Metric

BLOCK = 10.0  # m along the tunnel; points nearer than this are not independent
RESAMPLES = 200

Statistic = Callable[[Float[np.ndarray, " k"]], float]
_ABSENT = {
    "hold": "no held-out recording",
    "truth": "no truth and no control that the builder had not seen",
    "reference": "neither a held-out recording nor a truth",
}


@dataclass(frozen=True)
class Value:
    """A raw value of a metric."""

    value: float | None  # Number in the unit of the table; `None` where there is none
    interval: tuple[float, float] | None = None  # 95 % block-bootstrap interval
    n: int = 0  # Number of samples
    reason: str = ""  # Cause of a missing value, or remark on the value
    failed: bool = False  # The computation broke on this candidate; it scores 0 instead of being left out


class Samples(NamedTuple):
    """Samples along the tunnel, of which a metric's decorator names the statistic."""

    values: Float[np.ndarray, " n"]  # one number each
    station: Float[np.ndarray, " n"]  # m
    most: int = 200_000  # largest number of samples for the interval; the value itself uses all


def number(value: float, n: int = 0, reason: str = "") -> Value:
    """Return a value without an interval; one that is not finite becomes `None` and counts as failed."""
    if not np.isfinite(value):
        return Value(None, None, n, reason or "not a finite number", failed=True)
    return Value(float(value), None, n, reason)


def pass_or_fail(condition: bool, reason: str = "") -> Value:
    return Value(float(bool(condition)), None, 1, reason)


def missing(reason: str) -> Value:
    """Return a value without reference: it is left out of every mean and never counts as good."""
    return Value(None, None, 0, reason)


def mean(values: np.ndarray) -> float:
    return float(np.mean(values))


def mean_absolute(values: np.ndarray) -> float:
    return float(np.mean(np.abs(values)))


def mean_magnitude(values: np.ndarray) -> float:
    return abs(mean(values))


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def percentile(percent: float) -> Statistic:
    return lambda values: float(np.percentile(values, percent))


def estimate(
    statistic: Statistic,
    samples: Float[np.ndarray, " n"],
    station: Float[np.ndarray, " n"],
    rng: np.random.Generator,
    most: int = 200_000,
) -> Value:
    """Return a statistic of samples along the tunnel, see `Samples`, with its interval by bootstrap of blocks.

    Blocks are `BLOCK` long, and `rng` draws them.
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


def compute_metric(case: Case, row: Metric) -> Value:
    """Return the value of one metric; a computation that breaks counts as failed, with its reason."""
    if row.needs is not None and not case.has(row.needs):
        return missing(_ABSENT[row.needs])
    try:
        found = row.compute(case)
        if isinstance(found, Samples) and row.of is not None:
            return estimate(row.of, found.values, found.station, case.rng(row.id), found.most)
        return found if isinstance(found, Value) else number(float(found))
    except ImportError as error:
        return missing(f"{error.name} is not installed")
    except Exception as error:  # a corrupted candidate may break any library
        return Value(None, None, 0, f"{type(error).__name__}: {error}"[:200], failed=True)


def evaluate(
    case: Case,
    categories: Collection[str] | None = None,
    reuse: dict[str, Value] | None = None,
    advance: Callable[[str], None] = lambda id: None,
) -> dict[str, Value]:
    """Return the raw values of the suite by id, in the order of the table.

    Categories that are not asked for come from `reuse`, values of a case that differs in nothing that they read.
    """
    values: dict[str, Value] = {}
    last = ""
    for id, row in table.load().items():
        category = row.category
        if reuse is not None and categories is not None and category not in categories:
            values[id] = reuse[id]
        else:
            if category != last:
                case.forget(last)
                release_memory()
            values[id], last = compute_metric(case, row), category
        advance(id)
    return values


def dump_values(values: dict[str, Value]) -> dict[str, Any]:
    return {id: asdict(value) for id, value in values.items()}


def load_values(content: dict[str, Any]) -> dict[str, Value]:
    pairs = {id: tuple(entry["interval"]) if entry["interval"] else None for id, entry in content.items()}
    return {id: Value(**{**entry, "interval": pairs[id]}) for id, entry in content.items()}
