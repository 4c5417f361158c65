"""The judgement of a case: values of reconstruction, null tube and truth, and the verdict."""

import gc
import json
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fidelity import outside, scoring, table
from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.case import Case, case_hash, release_memory
from benchmarks.fidelity.faults import kinds as faults
from benchmarks.fidelity.files import read_kept, write_json
from benchmarks.fidelity.impostors import null_tube, truth_candidate
from benchmarks.fidelity.leaks import MEDIAN_FLOOR, NOISE_BAND, find_leaks
from benchmarks.fidelity.registry import Value, dump_values, evaluate, load_values, missing
from benchmarks.fidelity.scoring import Scored
from benchmarks.fidelity.table import Metric
from benchmarks.fidelity.windows import judge as windows_of
from benchmarks.fidelity.windows.judge import Windows, dump_windows, judge_windows, load_windows
from scene.progress import Stages

VALUES_SCHEMA = "subterra.fidelity-values/1"
WINDOWS_SCHEMA = "subterra.fidelity-windows/1"

NOT_COMPUTED = missing("taken from another candidate")  # in the categories in which both are the same

Values = dict[str, Value]


@dataclass(frozen=True)
class Judgement:
    """The result of a run."""

    values: dict[str, Values]  # Raw values of `base`, `null`, and `ceiling` where there is a truth
    scored: dict[str, Scored]  # Their scores
    skill: float | None  # Median skill over the null tube
    leaks: list[str]  # Findings of the leak detector
    reasons: list[str]  # Reasons for FAIL; empty for PASS
    # Scores of suite and metrics from outside together, by candidate; empty without such metrics. The verdict does not
    # read them
    outside: dict[str, Scored] = field(default_factory=dict)
    windows: Windows = field(default_factory=Windows)  # The worst windows, and the stated faults that they must notice

    @property
    def verdict(self) -> str:
        """`PASS` or `FAIL`, by suite and windows alone."""
        return "FAIL" if self.reasons else "PASS"


def judge_case(case: Case, folder: Path, processes: int = 1) -> Judgement:
    """Computes values, windows, leaks and the verdict without the controls of `controls`."""
    with open_values(case, folder, processes) as values:
        leaks, windows = find_leaks(case, values["base"]), compute_windows(case, folder)
    return make_judgement(values, leaks, None, windows)


def compute_windows(case: Case, folder: Path) -> Windows:
    """Return the worst windows and the stated faults; those of an earlier run of the same case are read again."""
    path, key = folder / "windows.json", case_hash(case)
    if content := read_kept(path, WINDOWS_SCHEMA, key):
        return load_windows(content)
    found = judge_windows(replace(case, cache={}))
    write_json(path, {"schema": WINDOWS_SCHEMA, "key": key, **dump_windows(found)}, digits=17)
    release_memory()
    return found


@contextmanager
def open_values(case: Case, folder: Path, processes: int = 1) -> Iterator[dict[str, Values]]:
    """Yields the values of the reconstruction; those of tube and truth are there by the end of the block.

    Each is kept in `values.json` when it is done, so that a run that was cut short goes on with the next. With 2 or
    more processes, a second one computes half of the categories of every candidate. So what is derived from a reference
    serves all candidates, and is mostly derived in one of the processes alone.
    """
    path, key = folder / "values.json", case_hash(case)
    values = {name: load_values(kept) for name, kept in read_kept(path, VALUES_SCHEMA, key).get("values", {}).items()}
    gc.freeze()  # what was imported stays: memory is released after every category, and to walk all of it takes long
    names = [name for name in make_candidates(case) if name not in values]
    mine: dict[str, Values] = {}
    theirs: dict[str, Future[Values]] = {}

    def keep(wait: tuple[str, ...] = ()) -> None:
        for name in names:
            if name in values:
                continue
            if name not in mine or (name in theirs and name not in wait and not theirs[name].done()):
                return
            found, half = mine[name], theirs[name].result() if name in theirs else {}
            found |= {id: half[id] for id, row in table.load().items() if half and row.category in SECOND_HALF}
            chosen = _what_differs(name)
            values[name] = {
                id: found[id] if row.category in chosen else values["base"][id] for id, row in table.load().items()
            }
            dumped = {one: dump_values(values[one]) for one in make_candidates(case) if one in values}
            write_json(path, {"schema": VALUES_SCHEMA, "key": key, "values": dumped}, digits=17)

    with Stages() as progress, ExitStack() as second:
        stages = {name: progress.start(f"metrics of {name}", len(table.load())) for name in names}
        if processes > 1 and names:
            context = multiprocessing.get_context("spawn")
            pool = second.enter_context(
                ProcessPoolExecutor(1, context, _start_second, (replace(case.fresh(), fit=None),))
            )
            second.callback(pool.shutdown, cancel_futures=True)  # an interrupt waits for what is under way alone
            theirs = {name: pool.submit(_value_in_second, name) for name in names}
            pool.shutdown(wait=False)  # it ends, and its memory with it, when these are done
        own = FIRST_HALF if theirs else tuple(table.CATEGORIES)
        for name in names:
            stage = stages[name]
            mine[name] = _value_candidate(case, name, own, lambda id, stage=stage: stage.advance())  # type: ignore[misc]
            keep()
        case.forget(next(reversed(table.CATEGORIES)))  # what only metrics need makes room for the windows
        release_memory()
        keep(("base",))
        yield values
        keep(tuple(names))


# Halves of about the same time, with the stated faults that the first process puts in as well: what beams and sections
# derive serves the first, what meshes and ground derive the second. The first alone has the builder's recording.
FIRST_HALF = ("CEN", "SEC", "C2M", "CMP", "BEA", "DIS", "OCC", "LIN", "SCN", "PAR", "DEG")
SECOND_HALF = tuple(name for name in table.CATEGORIES if name not in FIRST_HALF)


def _value_candidate(
    case: Case, name: str, categories: tuple[str, ...], advance: Callable[[str], None] = lambda id: None
) -> Values:
    """Return the values of a candidate in those of some categories in which it differs from another."""
    one = replace(case, candidate=make_candidates(case)[name](), cache={})
    chosen = [category for category in _what_differs(name) if category in categories]
    found = evaluate(one, chosen, dict.fromkeys(table.load(), NOT_COMPUTED), advance)
    one.cache.clear()
    release_memory()
    return found


_second: dict[str, Case] = {}


def _start_second(case: Case) -> None:
    gc.freeze()
    _second["case"] = case


def _value_in_second(name: str) -> Values:
    return _value_candidate(_second["case"], name, SECOND_HALF)


def make_candidates(case: Case) -> dict[str, Callable[[], Candidate]]:
    """Return the makers of the candidates to score by name, the reconstruction first."""
    makers: dict[str, Callable[[], Candidate]] = {
        "base": lambda: case.candidate,
        "null": lambda: null_tube(case.candidate),
    }
    if (truth := case.truth) is not None:
        makers["ceiling"] = lambda: truth_candidate(truth, case.candidate)
    return makers


def _what_differs(name: str) -> tuple[str, ...]:
    """Return the categories to compute for a candidate; the others are those of the reconstruction."""
    return tuple(table.CATEGORIES) if name == "base" else geometry_categories()


def geometry_categories() -> tuple[str, ...]:
    """Return the categories that do not read the compiled scene."""
    return tuple(name for name in table.CATEGORIES if name not in ("SCN", "PAR"))


def make_judgement(
    values: dict[str, Values],
    leaks: list[str],
    controls: list[dict[str, Any]] | None = None,
    windows: Windows | None = None,
) -> Judgement:
    """Return the verdict over values, leaks, windows and, where they were run, controls."""
    scored = {name: scoring.score_all(entry) for name, entry in values.items()}
    skill = median_skill(values["base"], values)
    rows = controls or []
    reasons = scoring.reasons_against(scored["base"], scored["null"], skill, undetected(rows), loud(rows), leaks)
    found = windows or Windows()
    return Judgement(values, scored, skill, leaks, found.reasons() + reasons, windows=found)


def add_outside(judgement: Judgement, case: Case) -> Judgement:
    """Return the judgement with the metrics from outside computed and scored; its verdict stays the suite's."""
    more = outside.compute_values(case, make_candidates(case))
    scored = {
        name: scoring.score_all(judgement.values[name] | values, table.load_all()) for name, values in more.items()
    }
    return replace(judgement, outside=scored)


def median_skill(values: Values, base: dict[str, Values]) -> float | None:
    """Return the median skill over the null tube of the scored metrics with H or T evidence; `None` without a truth."""
    if "ceiling" not in base or "null" not in base:
        return None
    skills = []
    for id, metric in table.load().items():
        if metric.scored and set(metric.evidence) & set("HT"):
            x, null, ceiling = (_signed_error(metric, v[id].value) for v in (values, base["null"], base["ceiling"]))
            skill = scoring.skill(x, null, ceiling)
            if skill is not None and null is not None and ceiling is not None and null > ceiling:
                skills.append(skill)
    return float(np.median(skills)) if skills else None


def _signed_error(metric: Metric, value: float | None) -> float | None:
    if value is None:
        return None
    if metric.map.kind == "B":
        return abs(value - metric.map.target)
    return -value if metric.map.kind in "UP" else value


def undetected(rows: list[dict[str, Any]]) -> list[str]:
    """Return the ids of negative controls that went unnoticed at a bold dose."""
    return sorted({row["id"] for row in rows if row["kind"] == "negative" and row["bold"] and not row["detected"]})


def loud(rows: list[dict[str, Any]]) -> list[str]:
    """Return the ids of invariance controls that moved the scores."""
    return sorted({row["id"] for row in rows if row["kind"] == "invariance" and not row["quiet"]})


# Everything frozen that a verdict depends on.


def constants() -> dict[str, Any]:
    """Return everything frozen that a verdict depends on: metrics, gates, limits, controls, leaks, windows."""
    return {
        "metrics": [row.as_row() for row in table.load().values()],
        "scoring": {name: value for name, value in vars(scoring).items() if name.isupper()},
        "controls": [asdict(control) for control in faults.suite_controls().values()],
        "quiet": [faults.GLOBAL_LIMIT, faults.THINNED_LIMIT, faults.QUIET_LIMIT, faults.MONOTONE, faults.UNORDERED],
        "leaks": [list(NOISE_BAND), MEDIAN_FLOOR],
        "windows": {sensor: windows_of.limits(sensor) for sensor in windows_of.SENSORS},
        "faults": {name: asdict(one) for name, one in faults.stated_faults(100.0).items()},
    }  # fmt: skip


def constants_digest() -> str:
    """Return the SHA-256 of `constants` as canonical JSON; a report with another digest was judged by other rules."""
    text = json.dumps(constants(), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return sha256(text.encode()).hexdigest()
