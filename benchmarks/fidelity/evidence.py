"""What simulated surveys say about each threshold, and the two rules that may move one.

- *Good end*: the truth itself, scored as a candidate, does not reach 100; it moves to 1.5 times what the truth reaches.
- *Bad end*: a control's bold dose lowers a category by less than it must; it moves, in the metrics of that category
  that plainly see the control, to what the control reaches.
"""

import csv
from dataclasses import dataclass, field, replace
from pathlib import Path

from benchmarks.fidelity import scoring, store, table
from benchmarks.fidelity.controls import catalogue
from benchmarks.fidelity.controls.kept import SCHEMA
from benchmarks.fidelity.errors import FidelityError
from benchmarks.fidelity.table import Map, Metric
from benchmarks.fidelity.value import Value

WIDEN = 1.5
PLAIN = 2.0  # times the distance of reconstruction and truth at which a control is plainly seen
Values = dict[str, Value]


@dataclass(frozen=True)
class Survey:
    """Values of one simulated survey.

    Attributes:
        name: Of its folder.
        base: Of the reconstruction.
        ceiling: Of the truth as candidate.
        spoilt: By control and bold dose.
    """

    name: str
    base: Values
    ceiling: Values
    spoilt: dict[tuple[str, float], Values] = field(default_factory=dict)


def load(folder: Path) -> Survey:
    """What `controls` left in a folder.

    Raises:
        FidelityError: Nothing, or without a truth.
    """
    values = store.read_json(folder / "values.json", store.SCHEMA)["values"]
    if "ceiling" not in values:
        raise FidelityError(f"{folder}: was judged without --truth, so it has no ceiling to calibrate by")
    found = Survey(folder.name, store.load_values(values["base"]), store.load_values(values["ceiling"]))
    for control in catalogue.load().values():
        for dose in control.bold:
            path = folder / "controls" / f"{control.id}-{dose:g}.json"
            if path.exists():
                found.spoilt[control.id, dose] = store.load_values(store.read_json(path, SCHEMA)["values"])
    return found


def draft() -> dict[str, Metric]:
    """The table without any calibration."""
    with table.METRICS.open(newline="") as file:
        maps = {row["id"]: table.parse_map(row["map"]) for row in csv.DictReader(file)}
    return {id: replace(row, map=maps[id]) for id, row in table.load().items()}


def good_end(row: Metric, surveys: list[Survey]) -> tuple[float, str] | None:
    """Where the good end belongs and why; `None` where the truth reaches it."""
    if row.map.kind not in "DUB" or not set(row.evidence) & set("HT"):
        return None
    values = [v for survey in surveys if (v := survey.ceiling[row.id].value) is not None]
    worst = max((distance(row.map, v) for v in values), default=0.0)
    if worst <= ends(row.map)[0]:
        return None
    return rounded(WIDEN * worst), f"the truth itself comes no nearer than {worst:.3g}; 1.5 times that"


def bad_ends(rows: dict[str, Metric], surveys: list[Survey]) -> dict[str, tuple[float, str]]:
    """Where bad ends belong and why, by metric, for every control that lowers a category too little."""
    found: dict[str, tuple[float, str]] = {}
    maps = {id: row.map for id, row in rows.items()}
    for survey in surveys:
        before = scoring.score_all(survey.base, maps).categories
        for (control, dose), values in survey.spoilt.items():
            after = scoring.score_all(values, maps).categories
            for category, asked in catalogue.load()[control].falls.items():
                if (before[category] or 0.0) - (after[category] or 0.0) >= asked:
                    continue
                reason = f"{control} at {dose:g} must lower {category} by {asked:g}"
                for row in rows.values():
                    if row.category == category and (end := _seen(row, survey, values)) is not None:
                        least = min(end, found.get(row.id, (end, ""))[0])
                        found[row.id] = (least, f"{reason}; this is what it reaches on {survey.name}")
    return found


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


def _seen(row: Metric, survey: Survey, spoilt: Values) -> float | None:
    """The distance that a control reaches on a metric that plainly sees it and does not yet score 0 for it."""
    values = [v[row.id].value for v in (survey.base, survey.ceiling, spoilt)]
    if row.map.kind not in "DUB" or not row.scored or any(v is None for v in values):
        return None
    base, ceiling, reached = (distance(row.map, v) for v in values if v is not None)
    good, bad = ends(row.map)
    if reached < PLAIN * max(base, ceiling) or not WIDEN * good < reached < bad:
        return None
    return rounded(reached)
