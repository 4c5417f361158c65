"""What `python -m benchmarks.fidelity` can do; each command leaves files in `--out` that the others take up."""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from benchmarks.fidelity import inputs as given
from benchmarks.fidelity import judge, leaks, report, store, sweep
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.controls import runner, verdicts
from benchmarks.fidelity.controls.kept import Job
from benchmarks.fidelity.errors import FidelityError
from benchmarks.fidelity.evaluate import evaluate
from benchmarks.fidelity.inputs import Inputs
from benchmarks.fidelity.judge import Judgement
from benchmarks.fidelity.value import Value
from scene.files import require_input, require_output_folder

CONTROLS_SCHEMA = "subterra.fidelity-controls/1"
SWEEP_SCHEMA = "subterra.fidelity-sweep/1"
MIDDLING = (("N02", 2.0), ("N25", 30.0))  # corruptions that the sweep makes where `controls` has not left them


@dataclass(frozen=True)
class ControlsConfig(Inputs):
    """Which controls are run.

    Attributes:
        only: Their ids; all where empty.
        bold_only: Only the doses that must fail.
        processes: At a time.
        foreign: Scene folder of another tunnel of the same class, for N33; made where not given.
    """

    only: tuple[str, ...] = ()
    bold_only: bool = False
    processes: int = 2
    foreign: Path | None = None


@dataclass(frozen=True)
class SweepConfig(Inputs):
    """What is swept.

    Attributes:
        seeds: Of the runs that compute all geometry anew; empty for none.
        tolerances: Factors on the tolerances inside metrics; empty for none.
    """

    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    tolerances: tuple[float, ...] = (0.9, 1.1)


@dataclass(frozen=True)
class Opened:
    """A case with its judgement and where results go."""

    inputs: Inputs
    case: Case
    judgement: Judgement
    values: dict[str, dict[str, Value]] = field(default_factory=dict)


def open_case(inputs: Inputs) -> Opened:
    """Reads what was given and judges it without controls; values from an earlier command are taken up."""
    require_output_folder(inputs.out)
    resolved = given.completed(inputs)
    case = given.read(resolved)
    judgement = judge.judge(case, resolved.out, resolved.strict)
    return Opened(resolved, case, judgement, judgement.values)


def run(inputs: Inputs) -> None:
    """Scores a scene against its references and writes the report.

    Example: python -m benchmarks.fidelity run --scene build/tunnel --recording held.bag --trajectory poses.tum
    """
    opened = open_case(inputs)
    written = _report(opened)
    _say(written)


def run_controls(config: ControlsConfig) -> None:
    """Spoils the scene in 36 ways and changes nothing in 7, and says which were noticed.

    Example: python -m benchmarks.fidelity controls --bold-only --out out/fidelity
    """
    _check_controls(config)
    opened = open_case(config)
    foreign = config.foreign
    if foreign is None and (not config.only or "N33" in config.only):
        foreign = given.foreign(opened.case, config.out)
    bench = runner.Bench(opened.case, opened.values["base"], config.out / "controls", foreign)
    wanted = [
        job for job in runner.jobs(config.only, foreign is not None) if not config.bold_only or runner.is_bold(job)
    ]
    outcomes = runner.run(bench, wanted, config.processes)
    rows = verdicts.rows(outcomes, opened.judgement.base)
    content = {"schema": CONTROLS_SCHEMA, "key": store.case_hash(opened.case), "rows": rows}
    store.write_json(config.out / "controls.json", content)
    _say(_report(opened))


def _check_controls(config: ControlsConfig) -> None:
    """Refuses what cannot be run before the scene is judged, which takes minutes."""
    known = {job.control for job in runner.jobs()}
    if unknown := [name for name in config.only if name not in known]:
        raise FidelityError(f"no control {unknown[0]!r}; there are {', '.join(sorted(known))}")
    if config.processes < 1:
        raise FidelityError(f"processes must be at least 1, got {config.processes}")
    if config.foreign is not None:
        require_input(config.foreign / "manifest.json")


def run_sweep(config: SweepConfig) -> None:
    """Moves thresholds, tolerances and seeds, and says how far the scores follow.

    Whatever `controls` has left in `--out` takes part in the order that must be kept.

    Example: python -m benchmarks.fidelity sweep --seeds 0 1 2 --out out/fidelity
    """
    for name, values, least in (("seeds", config.seeds, 0.0), ("tolerances", config.tolerances, 1e-6)):
        for value in values:
            if not least <= value < math.inf:
                raise FidelityError(f"{name} must be {'positive' if least else 'at least 0'}, got {value}")
    opened = open_case(config)
    candidates = dict(opened.values)
    foreign = config.out / given.FOREIGN
    known = foreign if foreign.exists() else None
    bench = runner.Bench(opened.case, candidates["base"], config.out / "controls", known)
    runner.run(bench, [Job(*one) for one in MIDDLING], processes=1)
    candidates |= {outcome.job.name: outcome.values for outcome in bench.kept() if sweep.ranked(outcome.job)}
    rows = sweep.thresholds(candidates)
    for kind, runs in _recomputed(opened, config).items():
        rows += sweep.others(kind, runs, candidates["base"])
    content = {
        "schema": SWEEP_SCHEMA,
        "key": store.case_hash(opened.case),
        "rows": rows,
        "summary": sweep.summary(rows),
    }
    store.write_json(config.out / "sweep.json", content)
    _say(_report(opened))


def run_report(inputs: Inputs) -> None:
    """Writes the report of what earlier commands left in `--out`.

    Example: python -m benchmarks.fidelity report --out out/fidelity
    """
    resolved = given.completed(inputs)
    if not (resolved.out / "values.json").exists():
        raise FidelityError(f"{resolved.out}: holds no values.json; run the suite first")
    run(inputs)


def _recomputed(opened: Opened, config: SweepConfig) -> dict[str, dict[str, dict[str, Value]]]:
    base = opened.values["base"]
    found: dict[str, dict[str, dict[str, Value]]] = {"tolerance": {}, "seed": {}}
    for kind, name, fresh in _variants(opened.case, config):
        same = kind == "seed" and fresh.seed == opened.case.seed
        found[kind][name] = base if same else evaluate(fresh, judge.geometry(), base)
        print(f"{kind} {name}: done", flush=True)
    return found


def _variants(case: Case, config: SweepConfig) -> Iterator[tuple[str, str, Case]]:
    """The case with other tolerances and seeds, nothing of it computed."""
    for factor in config.tolerances:
        yield "tolerance", f"x{factor}", replace(case.fresh(), tolerance=factor)
    for seed in config.seeds:
        yield "seed", str(seed), replace(case.fresh(), seed=seed)


def _report(opened: Opened) -> dict[str, Any]:
    """Report and verdict over everything that there is for this case in `--out`."""
    folder = opened.inputs.out
    controls = _kept(folder / "controls.json", opened.case)
    swept = _kept(folder / "sweep.json", opened.case)
    rows = controls["rows"] if controls else None
    found = leaks.find(opened.case, opened.values["base"])
    judgement = judge.judged(opened.values, found, rows, opened.inputs.strict)
    return report.write(folder, opened.case, opened.inputs, judgement, rows, swept)


def _kept(path: Path, case: Case) -> dict[str, Any] | None:
    """What an earlier command left for the same case, else nothing."""
    if not path.exists():
        return None
    content = json.loads(path.read_text())
    return content if content.get("key") == store.case_hash(case) else None


def _say(written: dict[str, Any]) -> None:
    overall = written["global"]
    text = "none" if overall is None else f"{overall:.1f} %"
    print(f"{written['title']} of {written['name']}: {written['verdict']}, global {text} "
          f"over {written['categories_evaluated']} of {len(written['categories'])} categories")  # fmt: skip
    for reason in written["reasons"]:
        print(f"  {reason}")
