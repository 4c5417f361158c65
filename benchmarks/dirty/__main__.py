"""Builds of clouds as scanners leave them, judged against truth.

Example: python -m benchmarks.dirty ../shared/data/dirty_clouds --out out/dirty
"""

import json
import math
import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from benchmarks.command import run_main, run_module
from benchmarks.dirty.figures import judge_scene
from benchmarks.dirty.truth import Case, find_cases, load_truth
from benchmarks.dirty.verdict import judge_build, list_faults, untold_faults
from benchmarks.records import Record, measured, write_records
from benchmarks.results import environment_facts, markdown_table, write_file
from subterra_jax.host.files import require_folder

SCHEMA = "subterra.dirty/2"
_HEAD = ("case", "verdict", "walls mean, cm", "within 10 cm, %", "width, cm", "height, cm", "floor, cm", "from, to, m",
         "sleepers seen", "gauge, m", "s", "what is wrong, or said")  # fmt: skip
_progress = Console(stderr=True, highlight=False)


@dataclass(frozen=True)
class JudgeConfig:
    """Builds each cloud of a folder and judges it by the truth beside it."""

    folder: Annotated[Path, tyro.conf.Positional]  # Folder with inputs and their `NAME_truth.npz`.
    out: Path  # Folder for results and logs; cases with a result there are not built again.
    only: tuple[str, ...] = ()  # Beginnings of the names of the cases wanted; all if not given.
    flags: str = ""  # Further words for the builder, in one string.
    keep: bool = False  # Keep the scenes in `OUT/scenes`.


def judge(config: JudgeConfig) -> None:
    """Judges all cases; writes `dirty.md`, `dirty.json` and `records.json` after each.

    Raises:
        BenchmarkError: The folder holds no cases, or a truth is none.
        OutputError: The folder for the results cannot be written.
    """
    require_folder(config.out)
    rows: list[dict[str, Any]] = []
    for case in find_cases(config.folder, config.only):
        file = config.out / "rows" / f"{case.name}.json"
        if not file.is_file():
            write_file(file, (json.dumps(judge_case(case, config), indent=1) + "\n").encode())
        rows.append(json.loads(file.read_text()))
        _progress.print(f"{case.name}: {rows[-1]['verdict']}", markup=False)
        facts = {"schema": SCHEMA, **environment_facts(), "rows": rows}
        write_file(config.out / "dirty.json", (json.dumps(facts, indent=1) + "\n").encode())
        write_file(config.out / "dirty.md", as_markdown(rows).encode())
        write_records(config.out / "records.json", records_of(rows))
    print(as_markdown(rows))


def judge_case(case: Case, config: JudgeConfig) -> dict[str, Any]:
    """Builds a case by the command line, as a user would, and returns its row of results."""
    scene, log = config.out / "scenes" / case.name, config.out / "logs" / f"{case.name}.txt"
    started = time.monotonic()
    ran = run_module("scene.build", *case.words, "--out", scene, "--fresh", *config.flags.split(), log=log)
    seconds, truth = time.monotonic() - started, load_truth(case)
    row: dict[str, Any] = {"name": case.name, "kind": case.kind, "seconds": seconds, **ran._asdict()}
    row |= {"warnings": [], "faults": [], "untold": []}
    faults = []
    if ran.status == 0:
        row["warnings"] = json.loads((scene / "manifest.json").read_text()).get("judgement", {}).get("warnings", [])
        row |= judge_scene(scene, truth)
        faults = list_faults(row, truth)
        row["faults"] = [fault.text for fault in faults]
        row["untold"] = [fault.text for fault in untold_faults(row, faults, truth)]
    row["verdict"] = judge_build(row, faults, truth)
    if not config.keep:
        shutil.rmtree(scene, ignore_errors=True)
    return row


def as_markdown(rows: list[dict[str, Any]]) -> str:
    """Returns a table with a line for each case; sizes are median / worst errors, the worst over 1.5 m."""
    lines = []
    for row in rows:
        said = [*row["faults"], row["message"], *(f"[{one['text']}]" for one in row["warnings"])]
        sizes = [" / ".join(filter(None, (_number(row, key) for key in (name, f"{name}_worst"))))
                 for name in ("width", "height", "floor")]  # fmt: skip
        ends = f"{row['from']:.2f}, {row['to']:.2f}" if "from" in row else ""
        sleepers = "" if row.get("sleepers_seen") is None else f"{row['sleepers_seen']} of {row['sleepers']}"
        cells = [_number(row, "wall_mean", 100, 2), _number(row, "wall_near", 100, 2), *sizes, ends, sleepers,
                 _number(row, "gauge_seen", 1, 4), f"{row['seconds']:.0f}", "; ".join(filter(None, said))]  # fmt: skip
        lines.append([row["name"], row["verdict"], *cells])
    return markdown_table(_HEAD, lines)


def _number(row: dict[str, Any], name: str, scale: float = 100.0, digits: int = 1) -> str:
    value = row.get(name)
    return "" if value is None or math.isnan(value) else f"{scale * value:.{digits}f}"


# Quantity of a record, the worst of its values over all clouds, scale and unit.
_RECORDS = {
    "dirty/wall-mean": ("wall_mean", max, 100.0, "cm"),
    "dirty/wall-within-10-cm": ("wall_near", min, 100.0, "%"),
    "dirty/width": ("width", max, 100.0, "cm"),
    "dirty/floor-worst": ("floor_worst", max, 100.0, "cm"),
}


def records_of(rows: list[dict[str, Any]]) -> list[Record]:
    """Returns the worst figures as records; a cloud that was refused has none."""
    found, command = [], "benchmarks.dirty {shared}/data/dirty_clouds --out out/dirty"
    for id, (name, worst, scale, unit) in _RECORDS.items():
        values = [abs(row[name]) for row in rows if not math.isnan(row.get(name, math.nan))]
        if values:
            found.append(measured(id, round(scale * worst(values), 2), unit, command, n=len(values), split="clouds"))
    return found


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    again = "interrupted; the same command goes on"
    return run_main("dirty", JudgeConfig, judge, description=__doc__, words=words, interrupted=again)


if __name__ == "__main__":
    sys.exit(main())
