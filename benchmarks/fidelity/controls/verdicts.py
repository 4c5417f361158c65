"""What the outcomes of controls say: whether each was noticed, whether the rest stayed quiet."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from benchmarks.fidelity import scoring, table
from benchmarks.fidelity.controls import catalogue
from benchmarks.fidelity.controls.invariance import GLOBAL_LIMIT, INVARIANCES, THINNED_LIMIT
from benchmarks.fidelity.controls.kept import Outcome
from benchmarks.fidelity.controls.runner import failures
from benchmarks.fidelity.scoring import Scored
from benchmarks.fidelity.value import Value

QUIET = 2.0
MONOTONE = -0.9
KINDS = ("N20", "N26", "N32", "N34", "N35")  # their doses are kinds, not amounts


@dataclass(frozen=True)
class Base:
    """What controls are compared with.

    Attributes:
        scored: The reconstruction.
        null: The null tube.
        values: Raw, of reconstruction, null tube and ceiling.
        reasons: Why the reconstruction itself fails, if it does.
    """

    scored: Scored
    null: Scored | None
    values: dict[str, dict[str, Value]]
    reasons: list[str]


def rows(outcomes: list[Outcome], base: Base) -> list[dict[str, Any]]:
    """One row a control and dose, for `controls.csv` and the heat map.

    A control is *detected* where its bold doses fail for a reason that the reconstruction has not, and every category
    named for it falls by its points.
    """
    judged = [_row(outcome, base) for outcome in outcomes]
    for row in judged:
        control = catalogue.load().get(row["id"])
        row["spearman"] = _spearman([r for r in judged if r["id"] == row["id"]], control, base)
    return judged


def undetected(rows: list[dict[str, Any]]) -> list[str]:
    """Ids of negative controls that went unnoticed at a bold dose."""
    return sorted({row["id"] for row in rows if row["kind"] == "negative" and row["bold"] and not row["detected"]})


def loud(rows: list[dict[str, Any]]) -> list[str]:
    """Ids of invariance controls that moved the scores."""
    return sorted({row["id"] for row in rows if row["kind"] == "invariance" and not row["quiet"]})


def median_skill(values: dict[str, Value], base: dict[str, dict[str, Value]]) -> float | None:
    """Median skill over the null tube of the scored metrics with H or T evidence; `None` without a ceiling."""
    if "ceiling" not in base or "null" not in base:
        return None
    skills = []
    for id, metric in table.load().items():
        if metric.scored and set(metric.evidence) & set("HT"):
            x, null, ceiling = (_error(metric, v[id].value) for v in (values, base["null"], base["ceiling"]))
            skill = scoring.skill(x, null, ceiling)
            if skill is not None and null is not None and ceiling is not None and null > ceiling:
                skills.append(skill)
    return float(np.median(skills)) if skills else None


def _error(metric: table.Metric, value: float | None) -> float | None:
    """A value as something of which less is better."""
    if value is None:
        return None
    if metric.map.kind == "B":
        return abs(value - metric.map.target)
    return -value if metric.map.kind in "UP" else value


def _row(outcome: Outcome, base: Base) -> dict[str, Any]:
    scored = scoring.score_all(outcome.values)
    reasons = scoring.reasons_against(
        scored, base.null, median_skill(outcome.values, base.values), [], [], outcome.leaks
    )
    falls = {c: _fall(base.scored.categories[c], scored.categories[c]) for c in base.scored.categories}
    new = sorted(failures(reasons) - failures(base.reasons))
    row = {
        "id": outcome.job.control, "dose": outcome.job.dose, "overall": scored.overall,
        "verdict": "FAIL" if new else "PASS",
        "why": [reason for reason in reasons if failures([reason]) & set(new)], "falls": falls,
        "categories": scored.categories, "base": base.scored.overall,
    }  # fmt: skip
    return {**row, **(_invariance(row) if outcome.job.control in INVARIANCES else _negative(row))}


def _negative(row: dict[str, Any]) -> dict[str, Any]:
    control = catalogue.load()[row["id"]]
    bold = row["dose"] in control.bold
    short = {c: (row["falls"][c], asked) for c, asked in control.falls.items() if (row["falls"][c] or 0.0) < asked}
    moved = {c: row["falls"][c] for c in control.quiet if abs(row["falls"][c] or 0.0) > QUIET}
    return {
        "kind": "negative", "corruption": control.corruption, "bold": bold, "short": short if bold else {},
        "detected": row["verdict"] == "FAIL" and not short, "quiet": not moved, "moved": moved,
        "evaluated": control.evaluated,
    }  # fmt: skip


def _invariance(row: dict[str, Any]) -> dict[str, Any]:
    control = INVARIANCES[row["id"]]
    falls = {c: fall for c, fall in row["falls"].items() if c not in control.exempt and fall is not None}
    moved = {c: fall for c, fall in falls.items() if abs(fall) > control.category_limit}
    known = row["overall"] is not None and row["base"] is not None
    limit = GLOBAL_LIMIT if control.category_limit < THINNED_LIMIT else THINNED_LIMIT
    quiet = not moved and known and (bool(control.exempt) or abs(row["overall"] - row["base"]) <= limit)
    return {
        "kind": "invariance", "corruption": control.text, "bold": True, "short": {}, "detected": False,
        "quiet": quiet, "moved": moved, "evaluated": catalogue.OUT_OF_SCENE,
    }  # fmt: skip


def _fall(before: float | None, after: float | None) -> float | None:
    return None if before is None or after is None else before - after


def _spearman(same: list[dict[str, Any]], control: catalogue.Control | None, base: Base) -> float | None:
    """Rank correlation of dose and mean score of the named categories, the reconstruction itself being dose 0."""
    if control is None or len(same) < 2 or control.id in KINDS or not control.falls:
        return None
    order = sorted(same, key=lambda row: control.doses.index(row["dose"]))
    before = [base.scored.categories[c] or 0.0 for c in control.falls]
    scores = [np.mean(before)] + [np.mean([row["categories"][c] or 0.0 for c in control.falls]) for row in order]
    return float(spearmanr(range(len(scores)), scores).statistic)
