"""Scores, categories, the global figure and the verdict; and how far they depend on thresholds and seed."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import kendalltau, qmc

from benchmarks.fidelity import table
from benchmarks.fidelity.registry import Value
from benchmarks.fidelity.table import Map, Metric

GATE_FLOOR = 50.0  # points; a gate below it caps its category at it
MOST_MISSING = 0.30  # share of a category's metrics
PASS_GLOBAL = 90.0
PASS_CATEGORY = 70.0
PASS_LEAD = 10.0  # points above the null tube
PASS_SKILL = 0.3
FACTORS = (0.9, 1.1)  # of the thresholds in the sweep
DRAWS = 128
COMMON_LIMIT = 2.5  # points
COMMON_CATEGORY_LIMIT = 7.0
INDEPENDENT_LIMIT = 1.0
SEED_LIMIT = 0.2
SEED_CATEGORY_LIMIT = 1.0
TAU_LIMIT = 0.95

Maps = dict[str, Map]
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
    saturated: float  # Share of scored metrics at exactly 100

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


def score_one(metric: Metric, value: Value, map: Map | None = None) -> Score:
    """Scores a value through its map; a failed computation scores 0, a missing value has no score."""
    if not metric.scored:
        return Score(metric, value, None)
    if value.value is None:
        return Score(metric, value, 0.0 if value.failed else None)
    return Score(metric, value, (map or metric.map).score(value.value))


def score_all(
    values: Values, maps: Maps | None = None, strict: bool = False, rows: dict[str, Metric] | None = None
) -> Scored:
    """Scores every metric and every category.

    Args:
        values: Raw values of all rows by id.
        maps: Maps in place of the table's, for the sweep.
        strict: Count missing values as 0.
        rows: Rows in place of the table: of a calibration, or with metrics from outside.
    """
    rows = rows or table.load()
    scores = {id: score_one(rows[id], values[id], (maps or {}).get(id)) for id in rows}
    categories = {
        name: _category_score([s for s in scores.values() if s.metric.category == name], strict)
        for name in table.CATEGORIES
    }
    gates = tuple(
        id for id, s in scores.items() if s.metric.role == "G" and s.score is not None and s.score < GATE_FLOOR
    )
    known = [value for value in categories.values() if value is not None]
    counted = [s.score for s in scores.values() if s.score is not None]
    overall = float(np.mean(known)) if known else None
    saturated = float(np.mean([score == 100.0 for score in counted])) if counted else 0.0
    return Scored(scores, categories, gates, overall, saturated)


def _category_score(scores: list[Score], strict: bool) -> float | None:
    """Return the mean of the scored metrics, capped where a gate fails; `None` where over 30 % of them are missing."""
    scored = [s for s in scores if s.metric.scored]
    known = scored if strict else [s for s in scored if s.score is not None]
    if len(known) < len(scored) * (1.0 - MOST_MISSING):
        return None
    mean = float(np.mean([s.score or 0.0 for s in known]))
    gates = [s.score or 0.0 for s in known if s.metric.role == "G"]
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

    Args:
        scored: Scores of the candidate.
        null: Scores of the null tube on the same references; it is not read where there are none.
        median_skill: Median skill over the metrics with H or T evidence.
        undetected: Negative controls that were not detected; empty also where controls were not run.
        loud: Invariance controls that moved.
        leaks: Findings of the leak detector.
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


# The sweep: other thresholds and seeds.


def threshold_maps(seed: int = 0) -> Iterator[tuple[str, str, Maps]]:
    """Yields kind, name and maps of every run: common mode, one category at a time, then independent draws."""
    rows = table.load()
    for factor in FACTORS:
        yield "common", f"x{factor}", {id: row.map.scaled(factor) for id, row in rows.items()}
    for name in table.CATEGORIES:
        for factor in FACTORS:
            maps = {id: row.map.scaled(factor) for id, row in rows.items() if row.category == name}
            yield "category", f"{name} x{factor}", maps
    scored = [id for id, row in rows.items() if row.scored]
    draws = qmc.LatinHypercube(len(scored), seed=seed).random(DRAWS)
    for number, draw in enumerate(FACTORS[0] + (FACTORS[1] - FACTORS[0]) * draws):
        yield "independent", f"draw {number}", {id: rows[id].map.scaled(k) for id, k in zip(scored, draw, strict=True)}


def sweep_thresholds(candidates: dict[str, Values]) -> list[dict[str, Any]]:
    """Scores all candidates through every run's maps.

    Args:
        candidates: Raw values by name; the first is the reconstruction. Null tubes, and whatever else scores less
            save `ceiling`, must stay below it.
    """
    before = {name: score_all(values) for name, values in candidates.items()}
    return [
        _sweep_row(kind, name, before, {c: score_all(values, maps) for c, values in candidates.items()})
        for kind, name, maps in threshold_maps()
    ]


def compare_seeds(runs: dict[str, Values], base: Values) -> list[dict[str, Any]]:
    """Return the rows of runs that computed the reconstruction anew with other seeds."""
    before = {"base": score_all(base)}
    return [_sweep_row("seed", name, before, {"base": score_all(values)}) for name, values in runs.items()]


def summarise(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the largest moves by kind, and whether each keeps its limit; `sweepable` scored metrics move at all."""
    maps = [row.map for row in table.load().values() if row.scored]
    kinds: dict[str, Any] = {"sweepable": float(np.mean([map.scaled(1.1) != map for map in maps]))}
    for kind in ("common", "category", "independent", "seed"):
        own = [row for row in rows if row["kind"] == kind]
        if not own:
            continue
        moves, worst = [row["delta"] for row in own], max(row["category_delta"] for row in own)
        kinds[kind] = {
            "runs": len(own), "least": min(moves), "most": max(moves), "sd": float(np.std(moves)),
            "category": worst, "lower": own[0]["lower"], "order_kept": all(row["order_kept"] for row in own),
            "verdicts": sorted({row["meets"] for row in own}), "least_tau": min(row["tau"] for row in own),
            "within": _within_limits(kind, own, moves, worst),
        }  # fmt: skip
    return kinds


def _within_limits(kind: str, own: list[dict[str, Any]], moves: list[float], worst: float) -> bool:
    kept = all(row["order_kept"] and row["tau"] >= TAU_LIMIT for row in own)
    if kind == "independent":
        return kept and max(moves) - min(moves) <= INDEPENDENT_LIMIT
    if kind == "seed":
        spread = max(np.std([row["categories"][c] or 0.0 for row in own]) for c in own[0]["categories"])
        return bool(np.std(moves) <= SEED_LIMIT and spread <= SEED_CATEGORY_LIMIT)
    return kept and max(map(abs, moves)) <= COMMON_LIMIT and worst <= COMMON_CATEGORY_LIMIT


def _sweep_row(kind: str, name: str, before: dict[str, Scored], after: dict[str, Scored]) -> dict[str, Any]:
    first = next(iter(before))
    old, new = before[first], after[first]
    moved = {c: (new.categories[c] or 0.0) - (v or 0.0) for c, v in old.categories.items()}
    worst = max(moved, key=lambda c: abs(moved[c]))
    others = {c: s.overall or 0.0 for c, s in before.items() if c not in (first, "ceiling")}
    lower = [c for c, score in others.items() if c.startswith("null") or score < (old.overall or 0.0)]
    ranks = [[s.overall or 0.0 for s in scored.values()] for scored in (before, after)]
    return {
        "kind": kind, "run": name, "global": new.overall, "delta": (new.overall or 0.0) - (old.overall or 0.0),
        "category_delta": abs(moved[worst]), "category": worst, "categories": new.categories,
        "meets": not reasons_against(new, after.get("null"), None, [], [], []),
        "order_kept": all((new.overall or 0.0) > (after[c].overall or 0.0) for c in lower), "lower": len(lower),
        "tau": float(kendalltau(*ranks).statistic) if len(before) > 2 else 1.0,
        "saturated": new.saturated, "others": {c: s.overall for c, s in after.items() if c != first},
    }  # fmt: skip
