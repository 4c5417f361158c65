"""Runs controls in parallel and judges whether each was noticed; finds the smallest faults that are."""

import multiprocessing
import re
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.stats import spearmanr

from benchmarks.fidelity import judge, outside, scoring, table
from benchmarks.fidelity.candidate import Candidate, load_candidate
from benchmarks.fidelity.case import Case, candidate_hash, case_hash, release_memory
from benchmarks.fidelity.faults import KINDS, Fault, Site, kinds, put_in
from benchmarks.fidelity.faults.kinds import asked_faults, local_site
from benchmarks.fidelity.files import FidelityError, read_kept, write_json
from benchmarks.fidelity.judge import Judgement
from benchmarks.fidelity.leaks import find_leaks
from benchmarks.fidelity.registry import Value, dump_values, evaluate, load_values
from benchmarks.fidelity.windows.judge import Worst, noticed_by, worst_windows
from scene.progress import Stages

OUTCOME_SCHEMA = "subterra.fidelity-control/1"


@dataclass(frozen=True)
class Job:
    """One control at one dose; an invariance has dose 0."""

    control: str
    dose: float

    @property
    def name(self) -> str:
        return f"{self.control}-{self.dose:g}"


@dataclass(frozen=True)
class Outcome:
    """Result of a control."""

    job: Job  # Control and dose
    values: dict[str, Value]  # Values of all 199 metrics
    leaks: list[str]  # Findings of the leak detector


Evaluate = Callable[..., dict[str, Value]]


@dataclass(frozen=True)
class Bench:
    """Start of every control: the base case, its values and where results are kept."""

    case: Case  # The base case
    base: dict[str, Value]  # Values of the base case
    folder: Path | None = None  # Folder for finished controls; `None` keeps nothing
    foreign: Path | None = None  # Scene folder of another tunnel, for N33
    compute: Evaluate = evaluate  # `evaluate`, or a part of it in tests
    more: Path | None = None  # File of a user's own metrics and faults, which every process reads

    def key(self, job: Job) -> str:
        """Return the SHA-256 of base, code and, for N33, the foreign scene: a kept result of others is not read."""
        other = "" if self.foreign is None or job.control != "N33" else candidate_hash(_foreign_candidate(self))
        if kinds.load_controls()[job.control].kind == "outside":
            other = str(outside.files())
        return sha256(f"{self.own} {other}".encode()).hexdigest()

    @cached_property
    def own(self) -> str:
        return case_hash(self.case)


def list_jobs(only: tuple[str, ...] = (), foreign: bool = True) -> list[Job]:
    """Return every control at every dose; N33 only where a foreign tunnel is at hand."""
    every = [Job(control.id, dose) for control in kinds.load_controls().values() for dose in control.faults]
    return [job for job in every if (foreign or job.control != "N33") and (not only or job.control in only)]


def is_bold(job: Job) -> bool:
    """Return True for a dose that must be noticed; invariances always count."""
    return job.dose in kinds.load_controls()[job.control].bold


def run_jobs(bench: Bench, jobs: list[Job], processes: int = 2) -> list[Outcome]:
    """Does the jobs, in their order; those kept from an earlier run of the same base are read."""
    done: dict[Job, Outcome] = {}
    for job in jobs:
        path = None if bench.folder is None else bench.folder / f"{job.name}.json"
        if path is not None and (kept := read_kept(path, OUTCOME_SCHEMA, bench.key(job))):
            done[job] = Outcome(job, load_values(kept["values"]), kept["leaks"])
    todo = [job for job in jobs if job not in done]
    with Stages() as progress:
        stage = progress.start("controls", len(jobs))
        if done:
            stage.resume(len(done))
        for outcome in _compute_outcomes(bench, todo, processes):
            done[outcome.job] = outcome
            if bench.folder is not None:
                content = {"schema": OUTCOME_SCHEMA, "key": bench.key(outcome.job), "leaks": outcome.leaks,
                           "values": dump_values(outcome.values)}  # fmt: skip
                write_json(bench.folder / f"{outcome.job.name}.json", content, digits=17)
            stage.advance()
    return [done[job] for job in jobs]


def run_control(bench: Bench, job: Job) -> Outcome:
    rng = np.random.default_rng(np.random.SeedSequence(bench.case.seed, spawn_key=tuple(job.control.encode())))
    control = kinds.load_controls()[job.control]
    with tempfile.TemporaryDirectory() as scratch:
        site = Site(replace(bench.case, cache={}), rng, Path(scratch), partial(_foreign_candidate, bench))
        corrupted = put_in(site, control.faults[job.dose])
        known = {"all": None, kinds.OUT_OF_SCENE: judge.geometry_categories()}
        chosen = known.get(control.evaluated, tuple(control.evaluated.split()))
        values = bench.compute(corrupted, chosen, bench.base)
        recorded = None if bench.case.hold is None else bench.case.hold.hash
        return Outcome(job, values, find_leaks(corrupted, values, recorded))


def without_figures(reasons: list[str]) -> set[str]:
    """Return reasons without their figures, so that those of two candidates can be compared."""
    return {re.sub(r"(?<![\w.])-?\d[\d.e-]*(?!\w)", "#", reason) for reason in reasons}


def _foreign_candidate(bench: Bench) -> Candidate:
    assert bench.foreign is not None
    return load_candidate(bench.foreign)


_worker: dict[str, Bench] = {}


def _start_worker(bench: Bench) -> None:
    if bench.more is not None:
        outside.load_file(bench.more)
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


def judge_outcomes(outcomes: list[Outcome], base: Judgement) -> list[dict[str, Any]]:
    """Return a row per control and dose, for `controls.csv` and the heat map.

    A control is *detected* where its bold doses fail for a reason that the reconstruction has not, and every category
    named for it falls by its points, or to the cap of a gate of its own that the control made fail: deeper it need not.
    """
    judged = [_outcome_row(outcome, base) for outcome in outcomes]
    for row in judged:
        same = [other for other in judged if other["id"] == row["id"]]
        row["spearman"] = _spearman(same, kinds.load_controls()[row["id"]], base)
    return judged


def _outcome_row(outcome: Outcome, base: Judgement) -> dict[str, Any]:
    scored = scoring.score_all(outcome.values)
    reasons = scoring.reasons_against(
        scored, base.scored["null"], judge.median_skill(outcome.values, base.values), [], [], outcome.leaks
    )
    pairs = {c: (before, scored.categories[c]) for c, before in base.scored["base"].categories.items()}
    falls = {c: None if a is None or b is None else a - b for c, (a, b) in pairs.items()}
    new = sorted(without_figures(reasons) - without_figures(base.reasons))
    gates = set(scored.failed_gates) - set(base.scored["base"].failed_gates)
    row = {
        "id": outcome.job.control, "dose": outcome.job.dose, "overall": scored.overall,
        "verdict": "FAIL" if new else "PASS",
        "why": [reason for reason in reasons if without_figures([reason]) & set(new)], "falls": falls,
        "categories": scored.categories, "base": base.scored["base"].overall,
        "capped": sorted({table.load()[id].category for id in gates}),
    }  # fmt: skip
    control = kinds.load_controls()[outcome.job.control]
    named = {"kind": control.kind, "corruption": control.corruption, "evaluated": control.evaluated}
    return row | named | (_negative_row(row, control) if control.limit is None else _invariance_row(row, control))


def _negative_row(row: dict[str, Any], control: kinds.Control) -> dict[str, Any]:
    bold = row["dose"] in control.bold
    short = {
        c: (row["falls"][c], asked) for c, asked in control.falls.items()
        if (row["falls"][c] or 0.0) < asked and c not in row["capped"]
    }  # fmt: skip
    moved = {c: row["falls"][c] for c in control.quiet if abs(row["falls"][c] or 0.0) > kinds.QUIET_LIMIT}
    detected = row["verdict"] == "FAIL" and not short
    return {"bold": bold, "short": short if bold else {}, "detected": detected, "quiet": not moved, "moved": moved}


def _invariance_row(row: dict[str, Any], control: kinds.Control) -> dict[str, Any]:
    assert control.limit is not None
    falls = {c: fall for c, fall in row["falls"].items() if c not in control.exempt and fall is not None}
    moved = {c: fall for c, fall in falls.items() if abs(fall) > control.limit}
    known = row["overall"] is not None and row["base"] is not None
    limit = kinds.GLOBAL_LIMIT if control.limit < kinds.THINNED_LIMIT else kinds.THINNED_LIMIT
    quiet = not moved and known and (bool(control.exempt) or abs(row["overall"] - row["base"]) <= limit)
    return {"bold": True, "short": {}, "detected": False, "quiet": quiet, "moved": moved}


def _spearman(same: list[dict[str, Any]], control: kinds.Control, base: Judgement) -> float | None:
    """Return the rank correlation of dose and mean score of the named categories; the reconstruction is dose 0."""
    if len(same) < 2 or control.id in kinds.UNORDERED or not control.falls:
        return None
    order = sorted(same, key=lambda row: list(control.faults).index(row["dose"]))
    before = [base.scored["base"].categories[c] or 0.0 for c in control.falls]
    scores = [np.mean(before)] + [np.mean([row["categories"][c] or 0.0 for c in control.falls]) for row in order]
    return float(spearmanr(range(len(scores)), scores).statistic)


# The ladder: smallest faults noticed, sizes halved in on at each of many places.

LADDER_SCHEMA = "subterra.fidelity-ladder/1"
SHARE = 0.95
_RUNG = 2.0 ** (1.0 / 3.0)  # of a size over the next smaller one
_BELOW, _ABOVE = 12, 3  # rungs below and above the size asked for
_EDGE = 4.0  # m that a fault keeps from the mouths: what is squeezed before it lies inside


def check_ladder(kinds: tuple[str, ...], places: int, draw: int = 0) -> None:
    if places < 1:
        raise FidelityError(f"places must be at least 1, got {places}")
    if draw < 0:
        raise FidelityError(f"draw must not be negative, got {draw}")
    if unknown := [name for name in kinds if name not in asked_faults()]:
        raise FidelityError(f"no size of {unknown[0]!r} is asked for; a ladder has {', '.join(asked_faults())}")


def rungs(kind: str) -> Float[np.ndarray, " r"]:
    return asked_faults()[kind].size * _RUNG ** np.arange(-_BELOW, _ABOVE + 1)


def draw_place(kind: str, draw: int, number: int, length: float) -> Fault:
    """Draws place, direction and side of a fault of the size asked for, in a tunnel of `length` m."""
    every, one = asked_faults(), KINDS[kind]
    asked, place = every[kind], (list(every).index(kind), number)
    rng = np.random.default_rng(np.random.SeedSequence(draw, spawn_key=place))
    start = float(rng.uniform(_EDGE, length - _EDGE - asked.length))
    sign = float(rng.choice([-1.0, 1.0])) if one.signed else 1.0
    return replace(asked, start=start, size=asked.size * sign, side=float(rng.choice(one.sides)))


def climb_ladders(case: Case, kinds: tuple[str, ...], places: int, draw: int, folder: Path) -> list[dict[str, Any]]:
    """Finds the smallest noticed size at each place; places kept from an earlier run are not done again."""
    kinds, length = kinds or tuple(asked_faults()), case.candidate.length
    least = max(asked_faults()[name].length for name in kinds) + 2.0 * _EDGE + 1.0
    if length < least:
        raise FidelityError(f"a ladder of these faults needs {least:g} m of tunnel, this one has {length:.1f} m")
    key = sha256(f"{case_hash(case)} {draw}".encode()).hexdigest()
    path = folder / "ladder.json"
    done = {(row["kind"], row["number"]): row for row in read_kept(path, LADDER_SCHEMA, key).get("rows", [])}
    needed = [(kind, number) for number in range(places) for kind in kinds]
    site = local_site(case)
    before = worst_windows(case)
    with Stages() as progress:
        stage = progress.start("places", len(needed))
        if known := sum(one in done for one in needed):
            stage.resume(known)
        for kind, number in needed:
            if (kind, number) in done:
                continue
            fault = draw_place(kind, draw, number, length)
            done[kind, number] = _climb(site, before, fault) | {"number": number}
            write_json(path, {"schema": LADDER_SCHEMA, "key": key, "rows": list(done.values())})
            release_memory()
            stage.advance()
    return [done[one] for one in needed]


def _climb(site: Site, before: list[Worst], fault: Fault) -> dict[str, Any]:
    """Return a row of one place: the sizes tried and the window that noticed each, and the smallest rung noticed.

    The size asked for is tried first, then the rungs above or below it, as if whatever is noticed were noticed at every
    larger size too.
    """
    sizes, tried = rungs(fault.kind), dict[int, tuple[str, ...]]()
    low, high, rung = -1, len(sizes), _BELOW  # the smallest noticed rung lies above `low`, and is `high` or below
    while high - low > 1:
        one = replace(fault, size=float(np.sign(fault.size) * sizes[rung]))
        by = tried[rung] = noticed_by(put_in(site, one), before)
        low, high = (low, rung) if by else (rung, high)
        rung = (low + high) // 2
    return {**asdict(fault), "scene": site.candidate.name, "rung": high,
            "tried": [{"size": float(sizes[k]), "by": list(by)} for k, by in tried.items()]}  # fmt: skip


def sum_up(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row per kind: the smallest sizes that half and 95 % of the places notice; infinite where no size is."""
    table = []
    for kind, asked in asked_faults().items():
        rung = np.array([row["rung"] for row in rows if row["kind"] == kind])
        if not len(rung):
            continue
        sizes = np.append(rungs(kind), np.inf)
        half, most = (float(sizes[np.quantile(rung, fraction, method="higher")]) for fraction in (0.5, SHARE))
        table.append({
            "kind": kind, "words": KINDS[kind].words, "unit": KINDS[kind].unit, "length": asked.length,
            "places": len(rung), "asked": asked.size, "noticed_at_asked": int((rung <= _BELOW).sum()),
            "size_50": half, "size_95": most,
        })  # fmt: skip
    return table
