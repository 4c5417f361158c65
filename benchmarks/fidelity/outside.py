"""Metrics from outside: a user's own file adds metrics to a category without a change in the package.

They are computed, scored and listed beside the 199 of the suite. The verdict stays the verdict of the suite alone.
"""

import json
import runpy
from collections.abc import Callable
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, get_args

from benchmarks.fidelity import table
from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.case import Case, case_hash
from benchmarks.fidelity.files import FidelityError, write_json
from benchmarks.fidelity.registry import Entry, Need, Value, compute_metric, dump_values, load_values, number
from benchmarks.fidelity.table import Metric, parse_map
from subterra_jax.host.loading import file_digest

SCHEMA = "subterra.fidelity-outside/1"
Compute = Callable[[Case], Value | float]
_EVIDENCE = {"hold": "H", "truth": "T", "reference": "HT", None: "S"}
_DIRECTION = {"D": "down", "U": "up", "B": "band", "P": "up", "-": "info"}


@dataclass(frozen=True)
class Outside:
    """A metric from outside.

    Attributes:
        row: Its row, numbered from 200 on.
        entry: Its function and the reference that it needs.
        source: Name of the file that registers it.
    """

    row: Metric
    entry: Entry
    source: str


_METRICS: dict[str, Outside] = {}
_FILES: dict[str, str] = {}  # SHA-256 of each loaded file by its name


def register(
    id: str,
    compute: Compute | None = None,
    *,
    category: str,
    definition: str,
    unit: str = "1",
    map: str = "-",
    needs: Need | None = None,
) -> Any:
    """Adds a metric to a category; as a decorator, or with the function as second argument.

    Args:
        id: Unique name.
        compute: Function from a `Case` to a `Value` or a float.
        category: Three letters of one of the 18 categories.
        definition: Definition in a sentence.
        unit: Unit of the value.
        map: Score map as in `metrics.csv`: `D(good,bad)`, `U(bad,good)`, `B(target;good,bad)`, `P`; `-` only lists it.
        needs: `hold`, `truth`, `reference` (either) or `None`.

    Raises:
        FidelityError: The category is unknown, the id is taken, the map or need is none, or `compute` is no function.
    """
    names = table.categories()
    if category not in names:
        raise FidelityError(f"metric {id!r}: unknown category {category!r}; choose one of {', '.join(names)}")
    if id in table.load():
        raise FidelityError(f"metric {id!r}: this id belongs to the suite, choose another")
    if id in _METRICS:
        raise FidelityError(f"metric {id!r}: this id is registered twice")
    if needs not in (None, *get_args(Need)):
        raise FidelityError(f"metric {id!r}: needs must be hold, truth, reference or None, got {needs!r}")
    try:
        score_map = parse_map(map)
    except ValueError as error:
        raise FidelityError(
            f"metric {id!r}: {error}, write D(good,bad), U(bad,good), B(target;good,bad), P or -"
        ) from None
    row = Metric(
        table.COUNT + len(_METRICS) + 1, category, names[category], id, definition, unit, _DIRECTION[score_map.kind],
        "L" if score_map.kind == "-" else "S", score_map, _EVIDENCE[needs], "",
    )  # fmt: skip

    def add(function: Compute) -> Compute:
        if not callable(function):
            raise FidelityError(f"metric {id!r}: compute must be a function of a Case, got {type(function).__name__}")
        _METRICS[id] = Outside(
            row, Entry(lambda case: _as_value(function(case)), needs), next(reversed(_FILES), "Python")
        )
        return function

    return add if compute is None else add(compute)


def _as_value(result: Value | float) -> Value:
    return result if isinstance(result, Value) else number(float(result))


def load_metrics(path: Path) -> None:
    """Runs a file that registers metrics; metrics of files loaded before are dropped.

    Raises:
        UserCodeError: The file cannot be read.
        FidelityError: The file cannot be run, or registers nothing.
    """
    clear()
    _FILES[path.name] = file_digest(path)
    try:
        runpy.run_path(str(path))
    except FidelityError as error:
        raise FidelityError(f"{path}: {error}") from error
    except Exception as error:  # anything may go wrong in a user's file
        raise FidelityError(f"{path}: cannot be run ({type(error).__name__}: {error})") from error
    if not _METRICS:
        raise FidelityError(f"{path}: registers no metric")


def clear() -> None:
    """Forgets all metrics from outside."""
    _METRICS.clear()
    _FILES.clear()


def metrics() -> dict[str, Outside]:
    """Return the metrics from outside by id, in the order of their registration."""
    return dict(_METRICS)


def files() -> dict[str, str]:
    """Return the SHA-256 of the file that they come from, by its name."""
    return dict(_FILES)


def rows() -> dict[str, Metric]:
    """Return the rows of suite and outside together, by id."""
    return table.load() | {id: one.row for id, one in _METRICS.items()}


def compute_values(
    case: Case, candidates: dict[str, Callable[[], Candidate]], folder: Path
) -> dict[str, dict[str, Value]]:
    """Return the values of all metrics from outside, by candidate and id; they are kept in `outside.json`.

    Args:
        case: Case of the reconstruction.
        candidates: Makers of the candidates by name.
        folder: Folder for `outside.json`.
    """
    if not _METRICS:
        return {}
    path, key = folder / "outside.json", sha256(f"{case_hash(case)} {sorted(_FILES.items())}".encode()).hexdigest()
    content = json.loads(path.read_text()) if path.exists() and _FILES else {}
    if content.get("schema") == SCHEMA and content.get("key") == key:
        return {name: load_values(values) for name, values in content["values"].items()}
    values: dict[str, dict[str, Value]] = {}
    for name, make in candidates.items():
        one = case if name == "base" else replace(case, candidate=make(), cache={})
        values[name] = {id: compute_metric(one, id, metric.entry) for id, metric in _METRICS.items()}
    dumped = {name: dump_values(entry) for name, entry in values.items()}
    write_json(path, {"schema": SCHEMA, "key": key, "values": dumped}, digits=17)
    return values
