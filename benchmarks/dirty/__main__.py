"""Builds of clouds as scanners leave them, judged against truth.

Example: python -m benchmarks.dirty ../shared/data/dirty_clouds --out out/dirty
"""

import json
import shutil
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from benchmarks.command import run_main
from benchmarks.dirty.building import build_case
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
    """

    folder: Annotated[Path, tyro.conf.Positional]
    out: Path
    only: tuple[str, ...] = ()
    fresh: bool = False
    keep: bool = False
    flags: str = ""
    limit: float = 900.0


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


def judge(config: JudgeConfig) -> None:
    """Judges all cases, one at a time, and writes `dirty.md` and `dirty.json` after each.

    Raises:
        BenchmarkError: The folder holds no cases, or a truth is none.
        OutputError: The folder for the results cannot be written.
    """
    require_folder(config.out)
    cases = find_cases(config.folder, config.only)
    rows = []
    for case in cases:
        file = config.out / "rows" / f"{case.name}.json"
        known = file.is_file() and not config.fresh
        row = json.loads(file.read_text()) if known else judge_case(case, config)
        if not known:
            write_file(file, (json.dumps(row, indent=1) + "\n").encode())
        rows.append(row)
        _progress.print(f"{row['name']}: {row['verdict']} {'; '.join(row['faults']) or row['message']}", markup=False)
        facts = {"schema": SCHEMA, **environment_facts(), "rows": rows}
        write_file(config.out / "dirty.json", (json.dumps(facts, indent=1, default=str) + "\n").encode())
        write_file(config.out / "dirty.md", as_markdown(rows).encode())
    print(as_markdown(rows))


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    again = "interrupted; the same command goes on"
    return run_main("dirty", JudgeConfig, judge, description=__doc__, words=words, interrupted=again)


if __name__ == "__main__":
    sys.exit(main())
