"""Cases judged one after another, or several at once in processes of their own.

No part of `__main__`: a process that is started afresh cannot read the functions of a package's `__main__`.
"""

import json
import multiprocessing
import shutil
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from benchmarks.dirty.building import build_case, take_processor
from benchmarks.dirty.figures import judge_scene
from benchmarks.dirty.truth import Case, load_truth
from benchmarks.dirty.verdict import judge_row, list_faults, untold_faults
from benchmarks.results import write_file


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
        row["untold"] = untold_faults(row, truth)
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


def judge_all(cases: list[Case], config: JudgeConfig) -> Iterator[dict[str, Any]]:
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
