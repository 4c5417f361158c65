"""Runs the whole judgement of a case: reconstruction, null tubes, ceiling, leaks, and the verdict over all of it."""

import gc
import json
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.fidelity import leaks, scoring, store, table
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.ceiling import truth_candidate
from benchmarks.fidelity.controls import verdicts
from benchmarks.fidelity.controls.verdicts import Base
from benchmarks.fidelity.evaluate import evaluate
from benchmarks.fidelity.null import null_tube
from benchmarks.fidelity.scoring import Scored
from benchmarks.fidelity.value import Value
from scene.cli import Stage, progress_bar

SCHEMA = "subterra.fidelity-values/1"


@dataclass(frozen=True)
class Judgement:
    """Everything known after a run.

    Attributes:
        values: Raw values of `base`, `null`, `null_bare`, and `ceiling` where there is a truth.
        scored: Their scores.
        skill: Median skill over the null tube.
        leaks: What the leak detector said.
        reasons: Why the verdict is FAIL; empty for PASS.
    """

    values: dict[str, dict[str, Value]]
    scored: dict[str, Scored]
    skill: float | None
    leaks: list[str]
    reasons: list[str]

    @property
    def verdict(self) -> str:
        """`PASS` or `FAIL`."""
        return "FAIL" if self.reasons else "PASS"

    @property
    def base(self) -> Base:
        """For controls."""
        return Base(self.scored["base"], self.scored["null"], self.values, self.reasons)


def geometry() -> tuple[str, ...]:
    """The categories that do not read the compiled scene."""
    return tuple(name for name in table.categories() if name not in ("SCN", "PAR"))


def values_of(case: Case, folder: Path) -> dict[str, dict[str, Value]]:
    """Raw values of the reconstruction, its null tubes and the ceiling; kept in `values.json` and taken up again."""
    path, key = folder / "values.json", store.case_hash(case)
    if path.exists():
        content = json.loads(path.read_text())
        if content.get("schema") == SCHEMA and content.get("key") == key:
            return {name: store.load_values(entry) for name, entry in content["values"].items()}
    candidates = {
        "base": case.candidate,
        "null": null_tube(case.candidate),
        "null_bare": null_tube(case.candidate, False),
    }
    if case.truth is not None:
        candidates["ceiling"] = truth_candidate(case.truth, case.candidate)
    values: dict[str, dict[str, Value]] = {}
    with progress_bar() as progress:
        for name, candidate in candidates.items():
            stage = progress.start(f"metrics of {name}", table.COUNT)
            one = replace(case, candidate=candidate, cache={})
            chosen = None if name == "base" else geometry()
            values[name] = evaluate(one, chosen, values.get("base"), partial(_advance, stage))
            one.cache.clear()
            gc.collect()  # meshes and their rays refer to each other
    dumped = {name: store.dump_values(entry) for name, entry in values.items()}
    store.write_json(path, {"schema": SCHEMA, "key": key, "values": dumped}, digits=17)
    return values


def _advance(stage: Stage, id: str) -> None:
    stage.advance()


def judged(
    values: dict[str, dict[str, Value]],
    found: list[str],
    controls: list[dict[str, Any]] | None = None,
    strict: bool = False,
) -> Judgement:
    """The verdict over values, leaks and, where they were run, controls."""
    scored = {name: scoring.score_all(entry, strict=strict) for name, entry in values.items()}
    skill = verdicts.median_skill(values["base"], values)
    rows = controls or []
    reasons = scoring.reasons_against(
        scored["base"], scored["null"], skill, verdicts.undetected(rows), verdicts.loud(rows), found
    )
    return Judgement(values, scored, skill, found, reasons)


def judge(case: Case, folder: Path, strict: bool = False) -> Judgement:
    """Values, leaks and the verdict without controls."""
    values = values_of(case, folder)
    return judged(values, leaks.find(case, values["base"]), None, strict)
