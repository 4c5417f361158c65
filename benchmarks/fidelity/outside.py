"""Metrics and faults from outside: a user's own file adds them without a change in the package.

Metrics are computed, scored and listed beside the 199 of the suite. The verdict stays the verdict of the suite alone.
"""

import runpy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from benchmarks.fidelity import faults, table
from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.files import FidelityError
from benchmarks.fidelity.registry import Value, compute_metric
from benchmarks.fidelity.table import Metric
from subterra_jax.host.loading import file_digest

_LOADED: set[str] = set()  # metrics and kinds of fault of the file
_FILES: dict[str, str] = {}  # its SHA-256 by its name


def load_file(path: Path) -> None:
    """Runs a file that registers metrics or faults; those of a file loaded before are dropped.

    Raises:
        UserCodeError: The file cannot be read.
        FidelityError: The file cannot be run, or registers nothing.
    """
    clear()
    _FILES[path.name] = file_digest(path)
    before = {*table.load_all(), *faults.KINDS}
    try:
        runpy.run_path(str(path))
    except FidelityError as error:
        raise FidelityError(f"{path}: {error}") from error
    except (Exception, SystemExit) as error:  # anything may go wrong in a user's file
        raise FidelityError(f"{path}: cannot be run ({type(error).__name__}: {error})") from error
    finally:
        _LOADED.update({*table.load_all(), *faults.KINDS} - before)
    if not _LOADED:
        raise FidelityError(f"{path}: registers neither a metric nor a fault")


def clear() -> None:
    table.forget(set(metrics()))
    for name in _LOADED & set(faults.KINDS):
        del faults.KINDS[name]
    _LOADED.clear()
    _FILES.clear()


def metrics() -> dict[str, Metric]:
    """Return the metrics from outside by id, in the order of their registration."""
    return {id: row for id, row in table.load_all().items() if id not in table.load()}


def files() -> dict[str, str]:
    return dict(_FILES)


def compute_values(case: Case, candidates: dict[str, Callable[[], Candidate]]) -> dict[str, dict[str, Value]]:
    """Return the values of all metrics from outside, by candidate and id; none without such metrics."""
    rows, values = metrics(), dict[str, dict[str, Value]]()
    for name, make in (candidates if rows else {}).items():
        one = case if name == "base" else replace(case, candidate=make(), cache={})
        values[name] = {id: compute_metric(one, row) for id, row in rows.items()}
    return values
