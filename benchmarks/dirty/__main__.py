"""Builds of clouds as scanners leave them, judged against truth.

Example: python -m benchmarks.dirty ../shared/data/dirty_clouds --out out/dirty
"""

import json
import math
import sys
from typing import Any

from rich.console import Console

from benchmarks.command import require_least, run_main
from benchmarks.dirty.judging import JudgeConfig, judge_all
from benchmarks.dirty.table import as_markdown
from benchmarks.dirty.truth import find_cases
from benchmarks.records import Record, measured, write_records
from benchmarks.results import environment_facts, write_file
from subterra_jax.host.files import require_folder

SCHEMA = "subterra.dirty/1"
_progress = Console(stderr=True, highlight=False)


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
    for row in judge_all(cases, config):
        done[row["name"]] = row
        rows = [done[case.name] for case in cases if case.name in done]
        _progress.print(f"{row['name']}: {row['verdict']} {'; '.join(row['faults']) or row['message']}", markup=False)
        facts = {"schema": SCHEMA, **environment_facts(), "rows": rows}
        write_file(config.out / "dirty.json", (json.dumps(facts, indent=1, default=str) + "\n").encode())
        write_file(config.out / "dirty.md", as_markdown(rows).encode())
        write_records(config.out / "records.json", records_of(rows))
    print(as_markdown([done[case.name] for case in cases]))


# Quantity of a record, the worst of its values over all clouds, scale and unit.
_RECORDS = {
    "dirty/wall-mean": ("wall_mean", max, 100.0, "cm"),
    "dirty/wall-within-10-cm": ("wall_near", min, 100.0, "%"),
    "dirty/width": ("width", max, 100.0, "cm"),
    "dirty/floor-worst": ("floor_worst", max, 100.0, "cm"),
}


def records_of(rows: list[dict[str, Any]]) -> list[Record]:
    """Return the worst figures as records; a cloud that was refused has none."""
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
