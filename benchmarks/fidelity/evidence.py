"""What `controls` left of simulated surveys, and how far a value lies from its metric's ideal."""

import csv
from dataclasses import dataclass, field, replace
from pathlib import Path

from benchmarks.fidelity import store, table
from benchmarks.fidelity.controls import runner
from benchmarks.fidelity.controls.invariance import INVARIANCES
from benchmarks.fidelity.controls.kept import SCHEMA
from benchmarks.fidelity.errors import FidelityError
from benchmarks.fidelity.table import Map, Metric
from benchmarks.fidelity.value import Value

DECISIONS = table.HERE / "decisions.csv"
Values = dict[str, Value]


@dataclass(frozen=True)
class Survey:
    """Values of one simulated survey.

    Attributes:
        name: Of its folder.
        base: Of the reconstruction.
        ceiling: Of the truth as candidate.
        null: Of the null tube.
        spoilt: By control and bold dose.
        same: By invariance control.
    """

    name: str
    base: Values
    ceiling: Values
    null: Values
    spoilt: dict[tuple[str, float], Values] = field(default_factory=dict)
    same: dict[str, Values] = field(default_factory=dict)


def load(folder: Path) -> Survey:
    """What `controls` left in a folder.

    Raises:
        FidelityError: Nothing, or without a truth.
    """
    values = store.read_json(folder / "values.json", store.SCHEMA)["values"]
    if "ceiling" not in values:
        raise FidelityError(f"{folder}: was judged without --truth, so it has no ceiling to calibrate by")
    base, ceiling, null = (store.load_values(values[name]) for name in ("base", "ceiling", "null"))
    found = Survey(folder.name, base, ceiling, null)
    for job in runner.jobs():
        path = folder / "controls" / f"{job.name}.json"
        if path.exists() and runner.is_bold(job):
            values = store.load_values(store.read_json(path, SCHEMA)["values"])
            if job.control in INVARIANCES:
                found.same[job.control] = values
            else:
                found.spoilt[job.control, job.dose] = values
    return found


def draft() -> dict[str, Metric]:
    """The table without any calibration."""
    with table.METRICS.open(newline="") as file:
        rows = {row["id"]: row for row in csv.DictReader(file)}
    return {
        id: replace(row, map=table.parse_map(rows[id]["map"]), role=rows[id]["role"])
        for id, row in table.load().items()
    }


def decided(rows: dict[str, Metric]) -> dict[str, tuple[Metric, str]]:
    """Rows that `decisions.csv` changes by hand, with its reasons."""
    with DECISIONS.open(newline="") as file:
        return {
            row["id"]: (replace(rows[row["id"]], role=row["role"], map=table.parse_map(row["map"])), row["reason"])
            for row in csv.DictReader(file)
        }


def distance(map: Map, value: float) -> float:
    """How far from the ideal: from 0 for D, from 1 (or the good end, if that is more) for U, from the target for B."""
    if map.kind == "U":
        return max(max(1.0, map.good) - value, 0.0)
    return abs(value - map.target) if map.kind == "B" else abs(value)


def ends(map: Map) -> tuple[float, float]:
    """Good and bad end as distances from the ideal."""
    if map.kind == "U":
        top = max(1.0, map.good)
        return top - map.good, top - map.bad
    return map.good, map.bad


def moved(map: Map, good: float, bad: float) -> Map:
    """The map with ends at distances from the ideal."""
    if map.kind == "U":
        top = max(1.0, map.good)
        return replace(map, good=round(top - good, 6), bad=round(top - bad, 6))
    return replace(map, good=good, bad=bad)


def rounded(value: float) -> float:
    """Two significant digits."""
    return float(f"{value:.2g}")


def distances(row: Metric, found: list[Values]) -> list[float]:
    """How far some candidates lie from the ideal, of those that have the metric."""
    known = [values[row.id].value for values in found]
    return [distance(row.map, value) for value in known if value is not None] if row.map.kind in "DUB" else []
