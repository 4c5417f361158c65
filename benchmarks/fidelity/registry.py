"""Every metric once: the decorator that registers one, and the check that all 199 are there."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from benchmarks.fidelity import table
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.value import Value, missing

Need = Literal["hold", "truth", "reference"]
_ABSENT = {
    "hold": "no held-out recording",
    "truth": "no truth and no control that the builder had not seen",
    "reference": "neither a held-out recording nor a truth",
}


@dataclass(frozen=True)
class Registered:
    """A metric's function and what it cannot do without."""

    compute: Callable[[Case], Value]
    needs: Need | None


_REGISTRY: dict[str, Registered] = {}


def metric(id: str, needs: Need | None = None) -> Callable[[Callable[[Case], Value]], Callable[[Case], Value]]:
    """Registers the function that computes a metric of the table.

    Args:
        id: Its id in `metrics.csv`.
        needs: `hold` a held-out recording; `truth` the generator's truth or unseen control; `reference` either.

    Raises:
        ValueError: Not in the table, or registered before.
    """
    if id not in table.load():
        raise ValueError(f"{id} is not in {table.METRICS.name}")
    if id in _REGISTRY:
        raise ValueError(f"{id} is registered twice")

    def register(function: Callable[[Case], Value]) -> Callable[[Case], Value]:
        _REGISTRY[id] = Registered(function, needs)
        return function

    return register


def registered() -> dict[str, Registered]:
    """All metrics, in the order of the table.

    Raises:
        ValueError: Some of the table are not computed by anything.
    """
    import benchmarks.fidelity.categories  # noqa: F401  (registers them)

    absent = [id for id in table.load() if id not in _REGISTRY]
    if absent:
        raise ValueError(f"{len(absent)} of {table.COUNT} metrics are computed by nothing: {', '.join(absent)}")
    return {id: _REGISTRY[id] for id in table.load()}


def compute(case: Case, id: str, entry: Registered) -> Value:
    """The value of one metric; a computation that breaks counts as failed, with its reason."""
    present = {
        "hold": case.hold is not None,
        "truth": case.truth is not None,
        "reference": case.truth is not None or case.hold is not None,
    }
    if entry.needs is not None and not present[entry.needs]:
        return missing(_ABSENT[entry.needs])
    try:
        return entry.compute(case)
    except ImportError as error:
        return missing(f"{error.name} is not installed")
    except Exception as error:  # a spoilt candidate may break any library
        return Value(None, None, 0, f"{type(error).__name__}: {error}"[:200], failed=True)
