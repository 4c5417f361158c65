"""Runs the whole judgement of a case: reconstruction, null tubes, ceiling, leaks, and the verdict over all of it."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.fidelity import leaks, scoring, store, table
from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.ceiling import truth_candidate
from benchmarks.fidelity.controls import verdicts
from benchmarks.fidelity.controls.verdicts import Base
from benchmarks.fidelity.evaluate import evaluate
from benchmarks.fidelity.memory import give_back
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
    """Raw values of the reconstruction, its null tubes and the ceiling.

    Each is kept in `values.json` when it is done, so that a run that was cut short goes on with the next.
    """
    path, key = folder / "values.json", store.case_hash(case)
    values = _kept(path, key)
    candidates = _candidates(case)
    with progress_bar() as progress:
        for name in [name for name in candidates if name not in values]:
            stage = progress.start(f"metrics of {name}", table.COUNT)
            one = replace(case, candidate=candidates[name](), cache={})
            chosen = None if name == "base" else geometry()
            values[name] = evaluate(one, chosen, values.get("base"), partial(_advance, stage))
            dumped = {name: store.dump_values(entry) for name, entry in values.items()}
            store.write_json(path, {"schema": SCHEMA, "key": key, "values": dumped}, digits=17)
            one.cache.clear()
            give_back()
    return values


def _candidates(case: Case) -> dict[str, Callable[[], Candidate]]:
    """What is scored of a case, the reconstruction first."""
    made: dict[str, Callable[[], Candidate]] = {
        "base": lambda: case.candidate,
        "null": lambda: null_tube(case.candidate),
        "null_bare": lambda: null_tube(case.candidate, False),
    }
    if (truth := case.truth) is not None:
        made["ceiling"] = lambda: truth_candidate(truth, case.candidate)
    return made


def _kept(path: Path, key: str) -> dict[str, dict[str, Value]]:
    """What an earlier run of the same case left; nothing where there is none."""
    content = json.loads(path.read_text()) if path.exists() else {}
    if content.get("schema") != SCHEMA or content.get("key") != key:
        return {}
    return {name: store.load_values(entry) for name, entry in content["values"].items()}


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
