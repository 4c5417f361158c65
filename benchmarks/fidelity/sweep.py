"""How much the verdict hangs on the thresholds, on the tolerances inside metrics, and on the seed."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.stats import kendalltau, qmc

from benchmarks.fidelity import scoring, table
from benchmarks.fidelity.controls import catalogue
from benchmarks.fidelity.controls.invariance import INVARIANCES
from benchmarks.fidelity.controls.kept import Job
from benchmarks.fidelity.scoring import Scored
from benchmarks.fidelity.table import Map
from benchmarks.fidelity.value import Value

FACTORS = (0.9, 1.1)
DRAWS = 128
COMMON_LIMIT = 2.5
COMMON_CATEGORY_LIMIT = 7.0
INDEPENDENT_LIMIT = 1.0
SEED_LIMIT = 0.2
SEED_CATEGORY_LIMIT = 1.0
TAU_LIMIT = 0.95

Maps = dict[str, Map]
Values = dict[str, Value]


def ranked(job: Job) -> bool:
    """Whether a control's outcome has a place in the order: invariances change nothing, and cheats no geometry."""
    return job.control not in INVARIANCES and bool(catalogue.load()[job.control].falls)


def threshold_maps(seed: int = 0) -> Iterator[tuple[str, str, Maps]]:
    """Every run of the sweep: kind, name, maps. Common mode, one category at a time, then independent draws."""
    rows = table.load()
    for factor in FACTORS:
        yield "common", f"x{factor}", {id: row.map.scaled(factor) for id, row in rows.items()}
    for name in table.categories():
        for factor in FACTORS:
            maps = {id: row.map.scaled(factor) for id, row in rows.items() if row.category == name}
            yield "category", f"{name} x{factor}", maps
    scored = [id for id, row in rows.items() if row.scored]
    draws = qmc.LatinHypercube(len(scored), seed=seed).random(DRAWS)
    for number, draw in enumerate(FACTORS[0] + (FACTORS[1] - FACTORS[0]) * draws):
        yield "independent", f"draw {number}", {id: rows[id].map.scaled(k) for id, k in zip(scored, draw, strict=True)}


def sweepable() -> float:
    """Share of the scored metrics whose map a factor moves at all."""
    rows = [row for row in table.load().values() if row.scored]
    return float(np.mean([row.map.scaled(1.1) != row.map for row in rows]))


def thresholds(candidates: dict[str, Values]) -> list[dict[str, Any]]:
    """Scores all candidates through every run's maps.

    Args:
        candidates: Raw values by name; the first is the reconstruction. Null tubes, and whatever else scores less
            save `ceiling`, must stay below it.
    """
    before = {name: scoring.score_all(values) for name, values in candidates.items()}
    return [
        _row(kind, name, before, {c: scoring.score_all(values, maps) for c, values in candidates.items()})
        for kind, name, maps in threshold_maps()
    ]


def others(kind: str, runs: dict[str, Values], base: Values) -> list[dict[str, Any]]:
    """Rows of runs that computed the reconstruction anew: other tolerances or seeds."""
    before = {"base": scoring.score_all(base)}
    return [_row(kind, name, before, {"base": scoring.score_all(values)}) for name, values in runs.items()]


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Largest moves by kind, and whether each keeps its limit."""
    found: dict[str, Any] = {"sweepable": sweepable()}
    for kind in ("common", "category", "independent", "tolerance", "seed"):
        own = [row for row in rows if row["kind"] == kind]
        if not own:
            continue
        moves, worst = [row["delta"] for row in own], max(row["category_delta"] for row in own)
        found[kind] = {
            "runs": len(own), "least": min(moves), "most": max(moves), "sd": float(np.std(moves)),
            "category": worst, "lower": own[0]["lower"], "order_kept": all(row["order_kept"] for row in own),
            "verdicts": sorted({row["meets"] for row in own}), "least_tau": min(row["tau"] for row in own),
        }  # fmt: skip
        found[kind]["within"] = _within(kind, own, moves, worst)
    return found


def _within(kind: str, own: list[dict[str, Any]], moves: list[float], worst: float) -> bool:
    kept = all(row["order_kept"] and row["tau"] >= TAU_LIMIT for row in own)
    if kind == "independent":
        return kept and max(moves) - min(moves) <= INDEPENDENT_LIMIT
    if kind == "seed":
        spread = max(np.std([row["categories"][c] or 0.0 for row in own]) for c in own[0]["categories"])
        return bool(np.std(moves) <= SEED_LIMIT and spread <= SEED_CATEGORY_LIMIT)
    return kept and max(map(abs, moves)) <= COMMON_LIMIT and worst <= COMMON_CATEGORY_LIMIT


def _row(kind: str, name: str, before: dict[str, Scored], after: dict[str, Scored]) -> dict[str, Any]:
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
        "meets": not scoring.reasons_against(new, after.get("null"), None, [], [], []),
        "order_kept": all((new.overall or 0.0) > (after[c].overall or 0.0) for c in lower), "lower": len(lower),
        "tau": float(kendalltau(*ranks).statistic) if len(before) > 2 else 1.0,
        "saturated": new.saturated, "others": {c: s.overall for c, s in after.items() if c != first},
    }  # fmt: skip
