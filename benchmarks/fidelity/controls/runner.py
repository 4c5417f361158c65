"""Runs controls in parallel, keeps finished ones, and judges whether each was noticed."""

import multiprocessing
import re
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from benchmarks.fidelity import judge, scoring, table
from benchmarks.fidelity.candidate import Candidate, load_candidate
from benchmarks.fidelity.case import Case, candidate_hash, case_hash, controls_hash, release_memory
from benchmarks.fidelity.controls.catalogue import (
    GLOBAL_LIMIT,
    INVARIANCES,
    OUT_OF_SCENE,
    QUIET_LIMIT,
    THINNED_LIMIT,
    UNORDERED,
    Control,
    Setting,
    load_controls,
    spoil_case,
)
from benchmarks.fidelity.files import read_json, write_json
from benchmarks.fidelity.judge import Base
from benchmarks.fidelity.leaks import find_leaks
from benchmarks.fidelity.registry import Value, dump_values, evaluate, load_values
from scene.progress import Stages

OUTCOME_SCHEMA = "subterra.fidelity-control/1"


@dataclass(frozen=True)
class Job:
    """One control at one dose; an invariance has dose 0."""

    control: str
    dose: float

    @property
    def name(self) -> str:
        """Name for files."""
        return f"{self.control}-{self.dose:g}"


@dataclass(frozen=True)
class Outcome:
    """Result of a control.

    Attributes:
        job: Control and dose.
        values: Values of all 199 metrics.
        leaks: Findings of the leak detector.
    """

    job: Job
    values: dict[str, Value]
    leaks: list[str]


def read_outcome(folder: Path | None, job: Job, key: str) -> Outcome | None:
    """Return the kept outcome of a job for the same base; `None` where there is none."""
    path = None if folder is None else folder / f"{job.name}.json"
    if path is None or not path.exists():
        return None
    content = read_json(path, OUTCOME_SCHEMA)
    if content["key"] != key:
        return None
    return Outcome(job, load_values(content["values"]), content["leaks"])


def write_outcome(folder: Path | None, outcome: Outcome, key: str) -> None:
    """Keeps an outcome; without a folder nothing is kept."""
    if folder is not None:
        content = {"schema": OUTCOME_SCHEMA, "key": key, "values": dump_values(outcome.values), "leaks": outcome.leaks}
        write_json(folder / f"{outcome.job.name}.json", content, digits=17)


# The runner.

Evaluate = Callable[..., dict[str, Value]]


@dataclass(frozen=True)
class Bench:
    """Start of every control: the base case, its values and where results are kept.

    Attributes:
        case: The base case.
        base: Values of the base case.
        folder: Folder for finished controls; `None` keeps nothing.
        foreign: Scene folder of another tunnel, for N33.
        compute: `evaluate`, or a part of it in tests.
    """

    case: Case
    base: dict[str, Value]
    folder: Path | None = None
    foreign: Path | None = None
    compute: Evaluate = evaluate

    def key(self, job: Job) -> str:
        """Return the SHA-256 of base, code and, for N33, the foreign scene: a kept result of others is not read."""
        other = "" if self.foreign is None or job.control != "N33" else candidate_hash(_foreign_candidate(self))
        return sha256(f"{self._own} {other}".encode()).hexdigest()

    @cached_property
    def _own(self) -> str:
        return f"{case_hash(self.case)} {controls_hash()}"

    def kept(self) -> list[Outcome]:
        """Return the kept outcomes of this base, in the order of `list_jobs`."""
        outcomes = (
            read_outcome(self.folder, job, self.key(job)) for job in list_jobs(foreign=self.foreign is not None)
        )
        return [outcome for outcome in outcomes if outcome is not None]


def list_jobs(only: tuple[str, ...] = (), foreign: bool = True) -> list[Job]:
    """Return every control at every dose, then the invariances; N33 only where a foreign tunnel is at hand."""
    jobs = [
        Job(control.id, dose)
        for control in load_controls().values()
        for dose in control.doses
        if foreign or control.id != "N33"
    ] + [Job(id, 0.0) for id in INVARIANCES]
    return [job for job in jobs if not only or job.control in only]


def is_bold(job: Job) -> bool:
    """Return True for a dose that must be noticed; invariances always count."""
    return job.control in INVARIANCES or job.dose in load_controls()[job.control].bold


def run_jobs(bench: Bench, jobs: list[Job], processes: int = 2) -> list[Outcome]:
    """Does the jobs, in their order; those kept from an earlier run of the same base are read."""
    done: dict[Job, Outcome] = {}
    todo = []
    for job in jobs:
        known = read_outcome(bench.folder, job, bench.key(job))
        if known is None:
            todo.append(job)
        else:
            done[job] = known
    with Stages() as progress:
        stage = progress.start("controls", len(jobs))
        if done:
            stage.resume(len(done))
        for outcome in _compute_outcomes(bench, todo, processes):
            done[outcome.job] = outcome
            write_outcome(bench.folder, outcome, bench.key(outcome.job))
            stage.advance()
    return [done[job] for job in jobs]


def run_control(bench: Bench, job: Job) -> Outcome:
    """Computes one control at one dose."""
    rng = np.random.default_rng(np.random.SeedSequence(bench.case.seed, spawn_key=tuple(job.control.encode())))
    fresh = replace(bench.case, cache={})
    with tempfile.TemporaryDirectory() as scratch:
        if job.control in INVARIANCES:
            spoiled, evaluated = INVARIANCES[job.control].change(fresh, rng), OUT_OF_SCENE
        else:
            setting = Setting(rng, Path(scratch), partial(_foreign_candidate, bench))
            spoiled = spoil_case(fresh, job.control, job.dose, setting)
            evaluated = load_controls()[job.control].evaluated
        values = bench.compute(spoiled, _evaluated_categories(evaluated), bench.base)
        recorded = None if bench.case.hold is None else bench.case.hold.hash
        return Outcome(job, values, find_leaks(spoiled, values, recorded))


def without_figures(reasons: list[str]) -> set[str]:
    """Return reasons without their figures, so that those of two candidates can be compared."""
    return {re.sub(r"(?<![\w.])-?\d[\d.e-]*(?!\w)", "#", reason) for reason in reasons}


def _evaluated_categories(evaluated: str) -> tuple[str, ...] | None:
    if evaluated == "all":
        return None
    if evaluated == OUT_OF_SCENE:
        return tuple(name for name in table.categories() if name not in ("SCN", "PAR"))
    return tuple(evaluated.split())


def _foreign_candidate(bench: Bench) -> Candidate:
    assert bench.foreign is not None
    return load_candidate(bench.foreign)


_worker: dict[str, Bench] = {}


def _start_worker(bench: Bench) -> None:
    _worker["bench"] = bench


def _run_in_worker(job: Job) -> Outcome:
    outcome = run_control(_worker["bench"], job)
    release_memory()
    return outcome


def _compute_outcomes(bench: Bench, todo: list[Job], processes: int) -> Iterator[Outcome]:
    if processes < 2 or len(todo) < 2:
        yield from (run_control(bench, job) for job in todo)
        return
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(processes, context, _start_worker, (replace(bench, case=bench.case.fresh()),))
    try:
        yield from pool.map(_run_in_worker, todo)
    finally:
        pool.shutdown(cancel_futures=True)  # an interrupt waits for what is under way, not for all that was asked


# The judgement: whether each control was noticed, and whether the rest stayed quiet.


def judge_outcomes(outcomes: list[Outcome], base: Base) -> list[dict[str, Any]]:
    """Return a row per control and dose, for `controls.csv` and the heat map.

    A control is *detected* where its bold doses fail for a reason that the reconstruction has not, and every category
    named for it falls by its points, or to the cap of a gate of its own that the control made fail: deeper it need not.
    """
    judged = [_outcome_row(outcome, base) for outcome in outcomes]
    for row in judged:
        control = load_controls().get(row["id"])
        row["spearman"] = _spearman([r for r in judged if r["id"] == row["id"]], control, base)
    return judged


def _outcome_row(outcome: Outcome, base: Base) -> dict[str, Any]:
    scored = scoring.score_all(outcome.values)
    reasons = scoring.reasons_against(
        scored, base.null, judge.median_skill(outcome.values, base.values), [], [], outcome.leaks
    )
    falls = {c: _fall(base.scored.categories[c], scored.categories[c]) for c in base.scored.categories}
    new = sorted(without_figures(reasons) - without_figures(base.reasons))
    gates = set(scored.failed_gates) - set(base.scored.failed_gates)
    row = {
        "id": outcome.job.control, "dose": outcome.job.dose, "overall": scored.overall,
        "verdict": "FAIL" if new else "PASS",
        "why": [reason for reason in reasons if without_figures([reason]) & set(new)], "falls": falls,
        "categories": scored.categories, "base": base.scored.overall,
        "capped": sorted({table.load()[id].category for id in gates}),
    }  # fmt: skip
    return {**row, **(_invariance_row(row) if outcome.job.control in INVARIANCES else _negative_row(row))}


def _negative_row(row: dict[str, Any]) -> dict[str, Any]:
    control = load_controls()[row["id"]]
    bold = row["dose"] in control.bold
    short = {
        c: (row["falls"][c], asked) for c, asked in control.falls.items()
        if (row["falls"][c] or 0.0) < asked and c not in row["capped"]
    }  # fmt: skip
    moved = {c: row["falls"][c] for c in control.quiet if abs(row["falls"][c] or 0.0) > QUIET_LIMIT}
    return {
        "kind": "negative", "corruption": control.corruption, "bold": bold, "short": short if bold else {},
        "detected": row["verdict"] == "FAIL" and not short, "quiet": not moved, "moved": moved,
        "evaluated": control.evaluated,
    }  # fmt: skip


def _invariance_row(row: dict[str, Any]) -> dict[str, Any]:
    control = INVARIANCES[row["id"]]
    falls = {c: fall for c, fall in row["falls"].items() if c not in control.exempt and fall is not None}
    moved = {c: fall for c, fall in falls.items() if abs(fall) > control.category_limit}
    known = row["overall"] is not None and row["base"] is not None
    limit = GLOBAL_LIMIT if control.category_limit < THINNED_LIMIT else THINNED_LIMIT
    quiet = not moved and known and (bool(control.exempt) or abs(row["overall"] - row["base"]) <= limit)
    return {
        "kind": "invariance", "corruption": control.text, "bold": True, "short": {}, "detected": False,
        "quiet": quiet, "moved": moved, "evaluated": OUT_OF_SCENE,
    }  # fmt: skip


def _fall(before: float | None, after: float | None) -> float | None:
    return None if before is None or after is None else before - after


def _spearman(same: list[dict[str, Any]], control: Control | None, base: Base) -> float | None:
    """Return the rank correlation of dose and mean score of the named categories; the reconstruction is dose 0."""
    if control is None or len(same) < 2 or control.id in UNORDERED or not control.falls:
        return None
    order = sorted(same, key=lambda row: control.doses.index(row["dose"]))
    before = [base.scored.categories[c] or 0.0 for c in control.falls]
    scores = [np.mean(before)] + [np.mean([row["categories"][c] or 0.0 for c in control.falls]) for row in order]
    return float(spearmanr(range(len(scores)), scores).statistic)


def is_ranked(job: Job) -> bool:
    """Return True where an outcome has a place in the order: invariances change nothing, cheats no geometry."""
    return job.control not in INVARIANCES and bool(load_controls()[job.control].falls)
