"""Scores, categories, the global figure and the verdict."""

from dataclasses import dataclass

import numpy as np

from benchmarks.fidelity import table
from benchmarks.fidelity.registry import Value
from benchmarks.fidelity.table import Metric

GATE_FLOOR = 50.0  # points; a gate below it caps its category at it
MOST_MISSING = 0.30  # fraction of a category's metrics
PASS_GLOBAL = 90.0
PASS_CATEGORY = 70.0
PASS_LEAD = 10.0  # points above the null tube
PASS_SKILL = 0.3

Values = dict[str, Value]


@dataclass(frozen=True)
class Score:
    """The score of one metric."""

    metric: Metric  # Its row
    value: Value  # Its raw value
    score: float | None  # 0 to 100; `None` where logged or missing


@dataclass(frozen=True)
class Scored:
    """The scores of one candidate."""

    scores: dict[str, Score]  # Scores by id, in the order of the table
    categories: dict[str, float | None]  # Score by category; `None` where too much of it is missing
    failed_gates: tuple[str, ...]  # Ids of gates below 50
    overall: float | None  # Mean of the categories that have a score; `None` where none has
    saturated: float  # Fraction of scored metrics at exactly 100

    @property
    def evaluated(self) -> int:
        return sum(score is not None for score in self.categories.values())

    @property
    def evidence(self) -> float | None:
        """Mean of the categories with a metric that reads a held-out recording or a truth."""
        scores = [s for s in self.scores.values() if set(s.metric.evidence) & set("HT") and s.score is not None]
        values = [self.categories[name] for name in dict.fromkeys(s.metric.category for s in scores)]
        known = [value for value in values if value is not None]
        return float(np.mean(known)) if known else None


def score_one(metric: Metric, value: Value) -> Score:
    """Scores a value through its metric's map; a failed computation scores 0, a missing value has no score."""
    if not metric.scored:
        return Score(metric, value, None)
    if value.value is None:
        return Score(metric, value, 0.0 if value.failed else None)
    return Score(metric, value, metric.map.score(value.value))


def score_all(values: Values, rows: dict[str, Metric] | None = None) -> Scored:
    """Scores every metric and every category.

    Args:
        values: Raw values of all rows by id.
        rows: Rows in place of the table's, with metrics from outside.
    """
    rows = rows or table.load()
    scores = {id: score_one(rows[id], values[id]) for id in rows}
    categories = {
        name: _category_score([s for s in scores.values() if s.metric.category == name]) for name in table.CATEGORIES
    }
    gates = tuple(
        id for id, s in scores.items() if s.metric.role == "G" and s.score is not None and s.score < GATE_FLOOR
    )
    known = [value for value in categories.values() if value is not None]
    counted = [s.score for s in scores.values() if s.score is not None]
    overall = float(np.mean(known)) if known else None
    saturated = float(np.mean([score == 100.0 for score in counted])) if counted else 0.0
    return Scored(scores, categories, gates, overall, saturated)


def _category_score(scores: list[Score]) -> float | None:
    """Return the mean of the scored metrics, capped where a gate fails; `None` where over 30 % of them are missing."""
    scored = [s for s in scores if s.metric.scored]
    known = [(s.score, s.metric.role) for s in scored if s.score is not None]
    if len(known) < len(scored) * (1.0 - MOST_MISSING):
        return None
    mean = float(np.mean([score for score, _ in known]))
    gates = [score for score, role in known if role == "G"]
    return min(mean, GATE_FLOOR) if gates and min(gates) < GATE_FLOOR else mean


def skill(value: float | None, null: float | None, ceiling: float | None) -> float | None:
    """Return the way from the null tube (0) towards the truth (1); `None` where the two do not differ."""
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
    """Return the reasons for FAIL, in sentences; empty for PASS.

    `null` are the scores of the null tube on the same references, `undetected` and `loud` the controls that were not
    noticed or moved; both are empty where controls were not run.
    """
    reasons = []
    if scored.overall is None or scored.overall < PASS_GLOBAL:
        overall = scored.overall if scored.overall is None else round(scored.overall, 1)
        reasons.append(f"global {overall} is below {PASS_GLOBAL:g}")
    reasons += [
        f"category {name} is {value:.1f}, below {PASS_CATEGORY:g}"
        for name, value in scored.categories.items()
        if value is not None and value < PASS_CATEGORY
    ]
    reasons += [f"gate {id} failed with {scored.scores[id].value.value}" for id in scored.failed_gates]
    if null is not None and scored.overall is not None and null.overall is not None and scored.evidence is not None:
        lead = scored.overall - null.overall
        if lead < PASS_LEAD:
            reasons.append(f"only {lead:.1f} points above the null tube; {PASS_LEAD:g} are asked")
    if median_skill is not None and median_skill < PASS_SKILL:
        reasons.append(f"median skill over the null tube is {median_skill:.2f}, below {PASS_SKILL:g}")
    reasons += [f"negative control {id} was not detected" for id in undetected]
    reasons += [f"invariance control {id} moved the scores" for id in loud]
    return reasons + [f"leak: {leak}" for leak in leaks]
