"""Runs controls side by side, keeps what is done, and judges what each did to the scores."""

import multiprocessing
import re
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from hashlib import sha256
from pathlib import Path

import numpy as np

from benchmarks.fidelity import leaks, store, table
from benchmarks.fidelity.candidate import Candidate, load
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.controls import catalogue, kept
from benchmarks.fidelity.controls.catalogue import OUT_OF_SCENE, Setting
from benchmarks.fidelity.controls.invariance import INVARIANCES
from benchmarks.fidelity.controls.kept import Job, Outcome
from benchmarks.fidelity.evaluate import evaluate
from benchmarks.fidelity.memory import give_back
from benchmarks.fidelity.value import Value
from scene.cli import progress_bar

Evaluate = Callable[..., dict[str, Value]]


@dataclass(frozen=True)
class Bench:
    """What every control starts from.

    Attributes:
        case: The base case.
        base: Its values.
        folder: Where finished controls are kept; `None` keeps nothing.
        foreign: Scene folder of another tunnel, for N33.
        compute: `evaluate`, or a part of it in tests.
    """

    case: Case
    base: dict[str, Value]
    folder: Path | None = None
    foreign: Path | None = None
    compute: Evaluate = evaluate

    def key(self, job: Job) -> str:
        """Of base and code, for N33 of the foreign scene too: a kept result of others is not taken up."""
        other = "" if self.foreign is None or job.control != "N33" else store.candidate_hash(_foreign(self))
        return sha256(f"{self._own} {other}".encode()).hexdigest()

    @cached_property
    def _own(self) -> str:
        return f"{store.case_hash(self.case)} {store.controls_hash()}"

    def kept(self) -> list[Outcome]:
        """What earlier runs left of this base, in the order of `jobs`."""
        found = (kept.read(self.folder, job, self.key(job)) for job in jobs(foreign=self.foreign is not None))
        return [outcome for outcome in found if outcome is not None]


def jobs(only: tuple[str, ...] = (), foreign: bool = True) -> list[Job]:
    """Every control at every dose, then the invariances; N33 only where a foreign tunnel is at hand."""
    wanted = [
        Job(control.id, dose)
        for control in catalogue.load().values()
        for dose in control.doses
        if foreign or control.id != "N33"
    ] + [Job(id, 0.0) for id in INVARIANCES]
    return [job for job in wanted if not only or job.control in only]


def is_bold(job: Job) -> bool:
    """Whether this dose must be noticed; invariances always count."""
    return job.control in INVARIANCES or job.dose in catalogue.load()[job.control].bold


def run(bench: Bench, wanted: list[Job], processes: int = 2) -> list[Outcome]:
    """Does the jobs, in their order; those kept from an earlier run of the same base are read."""
    done: dict[Job, Outcome] = {}
    todo = []
    for job in wanted:
        known = kept.read(bench.folder, job, bench.key(job))
        if known is None:
            todo.append(job)
        else:
            done[job] = known
    with progress_bar() as progress:
        stage = progress.start("controls", len(wanted))
        if done:
            stage.resume(len(done))
        for outcome in _computed(bench, todo, processes):
            done[outcome.job] = outcome
            kept.write(bench.folder, outcome, bench.key(outcome.job))
            stage.advance()
    return [done[job] for job in wanted]


def one(bench: Bench, job: Job) -> Outcome:
    """One control at one dose."""
    rng = np.random.default_rng(np.random.SeedSequence(bench.case.seed, spawn_key=tuple(job.control.encode())))
    fresh = replace(bench.case, cache={})
    with tempfile.TemporaryDirectory() as scratch:
        if job.control in INVARIANCES:
            spoiled, evaluated = INVARIANCES[job.control].change(fresh, rng), OUT_OF_SCENE
        else:
            setting = Setting(rng, Path(scratch), partial(_foreign, bench))
            spoiled = catalogue.spoiled(fresh, job.control, job.dose, setting)
            evaluated = catalogue.load()[job.control].evaluated
        values = bench.compute(spoiled, _categories(evaluated), bench.base)
        recorded = None if bench.case.hold is None else bench.case.hold.hash
        return Outcome(job, values, leaks.find(spoiled, values, recorded))


def failures(reasons: list[str]) -> set[str]:
    """Reasons without their figures, so that two candidates' can be compared."""
    return {re.sub(r"(?<![\w.])-?\d[\d.e-]*(?!\w)", "#", reason) for reason in reasons}


def _categories(evaluated: str) -> tuple[str, ...] | None:
    if evaluated == "all":
        return None
    if evaluated == OUT_OF_SCENE:
        return tuple(name for name in table.categories() if name not in ("SCN", "PAR"))
    return tuple(evaluated.split())


def _foreign(bench: Bench) -> Candidate:
    assert bench.foreign is not None
    return load(bench.foreign)


_worker: dict[str, Bench] = {}


def _start(bench: Bench) -> None:
    _worker["bench"] = bench


def _in_worker(job: Job) -> Outcome:
    outcome = one(_worker["bench"], job)
    give_back()
    return outcome


def _computed(bench: Bench, todo: list[Job], processes: int) -> Iterator[Outcome]:
    if processes < 2 or len(todo) < 2:
        yield from (one(bench, job) for job in todo)
        return
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(processes, context, _start, (replace(bench, case=bench.case.fresh()),))
    try:
        yield from pool.map(_in_worker, todo)
    finally:
        pool.shutdown(cancel_futures=True)  # an interrupt waits for what is under way, not for all that was asked
