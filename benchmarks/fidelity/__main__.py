"""Scores a reconstruction in 18 categories.

Example: python -m benchmarks.fidelity run --scene build/tunnel --recording held_out.bag --trajectory poses.tum
"""

import functools
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import tyro

from benchmarks.fidelity import judge, outside
from benchmarks.fidelity.case import Case, case_hash
from benchmarks.fidelity.faults import runner
from benchmarks.fidelity.faults.runner import Bench, is_bold, judge_outcomes, list_jobs, run_jobs
from benchmarks.fidelity.files import FidelityError, read_kept, write_csv, write_json
from benchmarks.fidelity.inputs import Inputs, SplitConfig, complete_inputs, foreign_scene, read_case, split_recording
from benchmarks.fidelity.judge import Judgement
from benchmarks.fidelity.report import write_report
from scene.errors import require_input
from subterra_jax.host.command import parse, run_command
from subterra_jax.host.files import require_folder

CONTROLS_SCHEMA = "subterra.fidelity-controls/1"
_PROG = "python -m benchmarks.fidelity"


@dataclass(frozen=True)
class RunConfig(Inputs):
    """Run of the suite."""

    processes: int = 2  # With 2, half of the categories are scored in a second process.


@dataclass(frozen=True)
class ControlsConfig(Inputs):
    """Controls to run."""

    only: tuple[str, ...] = ()  # Ids of the controls; all where empty.
    bold_only: bool = False  # Run only the doses that must fail.
    processes: int = 2  # Number of controls at a time.
    foreign: Path | None = None  # Scene folder of another tunnel of the same class, for N33; made where not given.


@dataclass(frozen=True)
class FaultsConfig(Inputs):
    """Faults to draw."""

    draw: int = 0  # Seed that draws their places.
    kinds: tuple[str, ...] = ()  # Kinds to put in; all that a size is asked of where empty.
    places: int = 6  # Number of places of each kind.


@dataclass(frozen=True)
class SplitCommand:
    """Cut a recording into fit, val and hold by blocks of time."""

    recording: tyro.conf.Positional[Path]  # Bag to cut.
    out: Path  # Folder to write.
    rule: SplitConfig = field(default_factory=SplitConfig)  # Rule of the cut.


class OpenCase(NamedTuple):
    """A case with its inputs, and its judgement without controls."""

    inputs: Inputs
    case: Case
    judgement: Judgement


def load_outside(inputs: Inputs) -> None:
    """Registers the metrics and faults of a user's file, and nothing else from outside."""
    outside.clear()
    if inputs.metrics is not None:
        outside.load_file(inputs.metrics)


def open_case(inputs: Inputs, processes: int = 1) -> OpenCase:
    """Reads the inputs and judges the case without controls; values of an earlier command are read again."""
    _check_processes(processes)
    require_folder(inputs.out)
    load_outside(inputs)
    resolved = complete_inputs(inputs)
    case = read_case(resolved, processes)
    return OpenCase(resolved, case, judge.judge_case(case, resolved.out, processes))


def run(config: RunConfig) -> None:
    """Scores a scene against its references and writes the report.

    Example: python -m benchmarks.fidelity run --scene build/tunnel --recording held.bag --trajectory poses.tum
    """
    _print_summary(_write_report(open_case(config, config.processes)))


def run_controls(config: ControlsConfig) -> None:
    """Spoils the scene in 36 ways and changes nothing in 7, and says which were noticed.

    Example: python -m benchmarks.fidelity controls --bold-only --out out/fidelity
    """
    _check_controls(config)
    opened = open_case(config, config.processes)
    foreign = config.foreign
    if foreign is None and (not config.only or "N33" in config.only):
        foreign = foreign_scene(opened.case, config.out)
    bench = Bench(
        opened.case, opened.judgement.values["base"], config.out / "controls", foreign, more=opened.inputs.metrics
    )
    jobs = [job for job in list_jobs(config.only, foreign is not None) if not config.bold_only or is_bold(job)]
    outcomes = run_jobs(bench, jobs, config.processes)
    rows = judge_outcomes(outcomes, opened.judgement)
    content = {"schema": CONTROLS_SCHEMA, "key": case_hash(opened.case), "rows": rows}
    write_json(config.out / "controls.json", content)
    _print_summary(_write_report(opened))


def _check_processes(count: int) -> None:
    if count < 1:
        raise FidelityError(f"processes must be at least 1, got {count}")


def _check_controls(config: ControlsConfig) -> None:
    """Refuses wrong controls before the scene is judged, which takes minutes."""
    load_outside(config)
    known = {job.control for job in list_jobs()}
    if unknown := [name for name in config.only if name not in known]:
        raise FidelityError(f"no control {unknown[0]!r}; there are {', '.join(sorted(known))}")
    _check_processes(config.processes)
    if config.foreign is not None:
        require_input(config.foreign / "manifest.json")


def run_windows(inputs: Inputs) -> None:
    """Judges a scene by its worst windows alone, in seconds.

    Example: python -m benchmarks.fidelity windows --scene build/tunnel --recording held.bag --trajectory poses.tum
    """
    require_folder(inputs.out)
    case = read_case(complete_inputs(inputs))
    if not case.has("reference"):
        raise FidelityError("windows need a reference: give --recording with --trajectory, or --truth")
    reasons = judge.compute_windows(case, inputs.out).reasons()
    print(f"windows of {case.candidate.name}: {'FAIL' if reasons else 'PASS'}")
    for reason in reasons:
        print(f"  {reason}")


def run_faults(config: FaultsConfig) -> None:
    """Finds the smallest fault noticed, of each of six kinds at random places; goes on where it was cut short.

    Example: python -m benchmarks.fidelity faults --places 6 --scene build/tunnel --truth build/survey
    """
    require_folder(config.out)
    load_outside(config)
    runner.check_ladder(config.kinds, config.places, config.draw)
    case = read_case(complete_inputs(config))
    if not case.has("reference"):
        raise FidelityError("faults need a reference: give --recording with --trajectory, or --truth")
    rows = runner.climb_ladders(case, config.kinds, config.places, config.draw, config.out)
    where = f"{config.places} places; {config.out / 'ladder.csv'}"
    print(f"{case.candidate.name}: smallest sizes noticed at 95 % of {where}")
    table = runner.sum_up(rows)
    write_csv(config.out / "ladder.csv", tuple(table[0]), table)
    for one in table:
        usual = {"m": (100.0, "cm")}.get(one["unit"], (1.0, one["unit"]))
        factor, unit = (1000.0, "mm") if one["kind"] == "gauge" else usual
        print(f"  {one['kind']} over {one['length']:g} m: {factor * one['size_95']:.2g} {unit}; "
              f"{factor * one['asked']:g} {unit} noticed at {one['noticed_at_asked']} of {one['places']}")  # fmt: skip


def run_split(config: SplitCommand) -> None:
    """Cut a recording into fit, val and hold by blocks of time.

    Example: python -m benchmarks.fidelity split recording.bag --out build/parts
    """
    facts = split_recording(config.recording, config.out, config.rule)
    print(", ".join(f"{name} {count} messages" for name, count in facts["messages"].items()))


def _write_report(opened: OpenCase) -> dict[str, Any]:
    inputs, folder = opened.inputs, opened.inputs.out
    key = case_hash(opened.case)
    rows = read_kept(folder / "controls.json", CONTROLS_SCHEMA, key).get("rows")
    judged = opened.judgement
    judgement = judge.make_judgement(judged.values, judged.leaks, rows, judged.windows)
    return write_report(folder, opened.case, inputs, judge.add_outside(judgement, opened.case), rows)


def _print_summary(report: dict[str, Any]) -> None:
    text = _percent(report["global"])
    print(f"{report['title']} of {report['name']}: {report['verdict']}, global {text} "
          f"over {report['categories_evaluated']} of {len(report['categories'])} categories")  # fmt: skip
    for reason in report["reasons"]:
        print(f"  {reason}")
    if (more := report["outside"]) is not None:
        print(f"  {more['count']} of {more['count_with_suite']} metrics from outside ({', '.join(more['files'])}): "
              f"global with them {_percent(more['global'])}; the verdict is that of the suite alone")  # fmt: skip


def _percent(value: float | None) -> str:
    return "none" if value is None else f"{value:.1f} %"


def main() -> int:
    """Runs one command; a user's mistake is one sentence and status 2."""
    if len(sys.argv) == 1:
        sys.argv.append("run")
    actions: dict[str, Callable[[Any], None]] = {
        "run": run, "controls": run_controls, "split": run_split, "windows": run_windows, "faults": run_faults,
    }  # fmt: skip
    commands = {name: _without_prefix(action) for name, action in actions.items()}

    act = parse(
        lambda words: tyro.extras.subcommand_cli_from_dict(commands, args=words, prog=_PROG, description=__doc__),
        groups=("config options",),
    )
    return run_command(act, "interrupted; the output is as it was, and the same command goes on from here")


def _without_prefix(action: Callable[[Any], None]) -> Callable[[Any], Callable[[], None]]:
    """Return an action, still to be run, whose configuration's fields are flags without a prefix."""
    (name,) = [key for key in action.__annotations__ if key != "return"]

    @functools.wraps(action)
    def later(config: Any) -> Callable[[], None]:
        return lambda: action(config)

    later.__annotations__ = {"config": Annotated[action.__annotations__[name], tyro.conf.OmitArgPrefixes]}
    del later.__wrapped__  # else its signature would be the action's
    return later


if __name__ == "__main__":
    sys.exit(main())
