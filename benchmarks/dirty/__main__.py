"""Builds of clouds as scanners leave them, judged against truth.

Example: python -m benchmarks.dirty ../shared/data/dirty_clouds --out out/dirty
"""

import json
import multiprocessing
import shutil
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from benchmarks.command import require_least, run_main
from benchmarks.dirty.building import build_case, take_processor
from benchmarks.dirty.figures import judge_scene
from benchmarks.dirty.table import as_markdown
from benchmarks.dirty.truth import Case, find_cases, load_truth
from benchmarks.dirty.verdict import judge_row, list_faults
from benchmarks.results import environment_facts, write_file
from subterra_jax.host.files import require_folder

SCHEMA = "subterra.dirty/1"
_progress = Console(stderr=True, highlight=False)


@dataclass(frozen=True)
class JudgeConfig:
    """Builds each cloud of a folder and judges it by the truth beside it.

    Attributes:
        folder: Folder with inputs and their `NAME_truth.npz`.
        out: Folder for results and logs; cases with a result there are not built again.
        only: Beginnings of the names of the cases wanted; all if not given.
        fresh: Build cases again that have a result.
        keep: Keep the scenes in `OUT/scenes`.
        flags: Further words for the builder, in one string.
        limit: Longest time for a build, s.
        jobs: Cases judged at once. With more than one, each runs on one processor, so that times compare only with
            each other; with one, a build uses as many as it likes.
    """

    folder: Annotated[Path, tyro.conf.Positional]
    out: Path
    only: tuple[str, ...] = ()
    fresh: bool = False
    keep: bool = False
    flags: str = ""
    limit: float = 900.0
    jobs: int = 1


def judge_case(case: Case, config: JudgeConfig) -> dict[str, Any]:
    """Builds and judges one case; returns its row of results."""
    scene = config.out / "scenes" / case.name
    shutil.rmtree(scene, ignore_errors=True)
    built = build_case(case, scene, config.out / "logs" / f"{case.name}.txt", tuple(config.flags.split()), config.limit)
    truth = load_truth(case)
    row = {"name": case.name, "kind": case.kind, **asdict(built), "faults": []}
    if built.status == 0:
        row |= judge_scene(scene, truth)
        row["faults"] = list_faults(row, truth)
    row["verdict"] = judge_row(row, truth)
    if not config.keep:
        shutil.rmtree(scene, ignore_errors=True)
    return row


def _judge_once(case: Case, config: JudgeConfig) -> dict[str, Any]:
    """Return the row of a case, judged now or in an earlier run."""
    file = config.out / "rows" / f"{case.name}.json"
    if file.is_file() and not config.fresh:
        known: dict[str, Any] = json.loads(file.read_text())
        return known
    row = judge_case(case, config)
    write_file(file, (json.dumps(row, indent=1) + "\n").encode())
    return row


def _judge_all(cases: list[Case], config: JudgeConfig) -> Iterator[dict[str, Any]]:
    """Yield the rows of all cases: in their order with one job, else as they are done."""
    if config.jobs == 1:
        yield from (_judge_once(case, config) for case in cases)
        return
    context = multiprocessing.get_context("spawn")
    places = context.Queue()
    for place in range(config.jobs):
        places.put(place)
    pool = ProcessPoolExecutor(config.jobs, context, take_processor, (places,))
    try:
        for done in as_completed([pool.submit(_judge_once, case, config) for case in cases]):
            yield done.result()
    finally:
        pool.shutdown(cancel_futures=True)  # an interrupt waits for what is under way, not for all that was asked


def judge(config: JudgeConfig) -> None:
    """Judges all cases and writes `dirty.md` and `dirty.json` after each, with rows in the order of the names.

    Raises:
        BenchmarkError: The folder holds no cases, a truth is none, or `jobs` is below 1.
        OutputError: The folder for the results cannot be written.
    """
    require_least(config, jobs=1)
    require_folder(config.out)
    cases = find_cases(config.folder, config.only)
    done: dict[str, dict[str, Any]] = {}
    for row in _judge_all(cases, config):
        done[row["name"]] = row
        rows = [done[case.name] for case in cases if case.name in done]
        _progress.print(f"{row['name']}: {row['verdict']} {'; '.join(row['faults']) or row['message']}", markup=False)
        facts = {"schema": SCHEMA, **environment_facts(), "rows": rows}
        write_file(config.out / "dirty.json", (json.dumps(facts, indent=1, default=str) + "\n").encode())
        write_file(config.out / "dirty.md", as_markdown(rows).encode())
    print(as_markdown([done[case.name] for case in cases]))


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    again = "interrupted; the same command goes on"
    return run_main("dirty", JudgeConfig, judge, description=__doc__, words=words, interrupted=again)


if __name__ == "__main__":
    sys.exit(main())
