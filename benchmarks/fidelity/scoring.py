"""From raw values to scores, categories, the global figure and the verdict."""

from dataclasses import dataclass

import numpy as np

from benchmarks.fidelity import table
from benchmarks.fidelity.table import Map, Metric
from benchmarks.fidelity.value import Value

GATE_FLOOR = 50.0
MOST_MISSING = 0.30
PASS_GLOBAL = 90.0
PASS_CATEGORY = 70.0
PASS_LEAD = 10.0  # points above the null tube
PASS_SKILL = 0.3


@dataclass(frozen=True)
class Score:
    """One metric, scored.

    Attributes:
        metric: Its row.
        value: Its raw value.
        score: 0 to 100; `None` where logged or missing.
    """

    metric: Metric
    value: Value
    score: float | None


@dataclass(frozen=True)
class Scored:
    """All metrics of one candidate.

    Attributes:
        scores: By id, in the order of the table.
        categories: Score by category; `None` where too much of it is missing.
        failed_gates: Ids of gates below 50.
        overall: Mean of the categories that have a score; `None` where none has.
        saturated: Share of scored metrics at exactly 100.
    """

    scores: dict[str, Score]
    categories: dict[str, float | None]
    failed_gates: tuple[str, ...]
    overall: float | None
    saturated: float

    @property
    def evaluated(self) -> int:
        """Categories with a score."""
        return sum(score is not None for score in self.categories.values())

    @property
    def evidence(self) -> float | None:
        """Mean of the categories in which a held-out recording or a truth has a say."""
        heard = [
            s.metric.category
            for s in self.scores.values()
            if set(s.metric.evidence) & set("HT") and s.score is not None
        ]
        values = [self.categories[c] for c in dict.fromkeys(heard) if self.categories[c] is not None]
        return float(np.mean([v for v in values if v is not None])) if values else None


def score_one(metric: Metric, value: Value, map: Map | None = None) -> Score:
    """A value through its map; a failed computation scores 0, a missing one nothing."""
    if not metric.scored:
        return Score(metric, value, None)
    if value.value is None:
        return Score(metric, value, 0.0 if value.failed else None)
    return Score(metric, value, (map or metric.map).score(value.value))


def score_all(
    values: dict[str, Value],
    maps: dict[str, Map] | None = None,
    strict: bool = False,
    rows: dict[str, Metric] | None = None,
) -> Scored:
    """Scores every metric and every category.

    Args:
        values: By id; all 199.
        maps: In place of the table's, for the sweep.
        strict: Count what is missing as 0.
        rows: In place of the table, for calibration.
    """
    rows = rows or table.load()
    scores = {id: score_one(rows[id], values[id], (maps or {}).get(id)) for id in rows}
    categories = {
        name: _category([s for s in scores.values() if s.metric.category == name], strict)
        for name in table.categories()
    }
    gates = tuple(
        id for id, s in scores.items() if s.metric.role == "G" and s.score is not None and s.score < GATE_FLOOR
    )
    known = [value for value in categories.values() if value is not None]
    counted = [s.score for s in scores.values() if s.score is not None]
    return Scored(
        scores,
        categories,
        gates,
        float(np.mean(known)) if known else None,
        float(np.mean([score == 100.0 for score in counted])) if counted else 0.0,
    )


def _category(scores: list[Score], strict: bool) -> float | None:
    """Mean of the scored metrics, capped where a gate fails; `None` where over 30 % of them are missing."""
    scored = [s for s in scores if s.metric.scored]
    known = [s for s in scored if s.score is not None]
    if strict:
        return _capped(scored)
    if len(known) < len(scored) * (1.0 - MOST_MISSING):
        return None
    return _capped(known)


def _capped(scores: list[Score]) -> float:
    mean = float(np.mean([s.score or 0.0 for s in scores]))
    gates = [s.score or 0.0 for s in scores if s.metric.role == "G"]
    return min(mean, GATE_FLOOR) if gates and min(gates) < GATE_FLOOR else mean


def skill(value: float | None, null: float | None, ceiling: float | None) -> float | None:
    """How far from the null tube towards the ceiling: 0 at the one, 1 at the other; `None` where they do not differ."""
    if value is None or null is None or ceiling is None or abs(null - ceiling) < 1e-12:
        return None
    return (value - null) / (ceiling - null)


def reasons_against(
    scored: Scored,
    null: Scored | None,
    median_skill: float | None,
    undetected: list[str],
    loud: list[str],
    leaks: list[str],
) -> list[str]:
    """Why the verdict is FAIL, in sentences; empty for PASS.

    Args:
        scored: The candidate.
        null: The null tube on the same references; without any there is nothing that it could be told apart by.
        median_skill: Over the metrics with H or T evidence.
        undetected: Negative controls that were not detected; empty also where controls were not run.
        loud: Invariance controls that moved.
        leaks: What the leak detector found.
    """
    found = []
    if scored.overall is None or scored.overall < PASS_GLOBAL:
        found.append(
            f"global {scored.overall if scored.overall is None else round(scored.overall, 1)} is below {PASS_GLOBAL:g}"
        )
    found += [
        f"category {name} is {value:.1f}, below {PASS_CATEGORY:g}"
        for name, value in scored.categories.items()
        if value is not None and value < PASS_CATEGORY
    ]
    found += [f"gate {id} failed with {scored.scores[id].value.value}" for id in scored.failed_gates]
    if null is not None and scored.overall is not None and null.overall is not None and scored.evidence is not None:
        lead = scored.overall - null.overall
        if lead < PASS_LEAD:
            found.append(f"only {lead:.1f} points above the null tube; {PASS_LEAD:g} are asked")
    if median_skill is not None and median_skill < PASS_SKILL:
        found.append(f"median skill over the null tube is {median_skill:.2f}, below {PASS_SKILL:g}")
    found += [f"negative control {id} was not detected" for id in undetected]
    found += [f"invariance control {id} moved the scores" for id in loud]
    return found + [f"leak: {leak}" for leak in leaks]
