"""Measures results on record again, says which differ, and lists the others with the command that measures them.

Example: python -m benchmarks.reproduce --jobs speed metro --out out/reproduce
"""

import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from benchmarks.command import BenchmarkError, run_main, run_module
from benchmarks.records import Record, number, on_record, read_records
from benchmarks.results import environment_facts, write_file
from subterra_jax.host.files import require_folder


class Job(NamedTuple):
    """Commands that measure records on a CPU."""

    # Words after `python -m`; `{out}` is the job's folder, `{shared}` that of surveys not packaged
    commands: tuple[str, ...]
    minutes: float  # Duration on two idle cores, minutes
    records: str = "records.json"  # File below the job's folder that holds the records once it is done
    needs: str = ""  # Path that must exist, or empty
    read: Callable[[Any], dict[str, float]] | None = None  # Reads the figures by id where the command writes none


def _verdict(report: Any) -> dict[str, float]:
    names = {"subterra-351/global": "global", "subterra-351/null-tube": "global_null"}
    return {f"fidelity/{id}": report[name] for id, name in names.items()} | {
        "fidelity/categories": len(report["categories"])
    }


_METRO, _DIRTY = "{shared}/data/metro_asbuilt", "{shared}/data/dirty_clouds"
_SURVEY_351 = (
    "scene.survey --truth metro --length 351 --seed 0 --sensors avia os1 --scan-every 10 --out {out}/survey",
    "scene.build {out}/survey/survey.bag --trajectory {out}/survey/groundtruth.tum --provenance simulated "
    "--name subterra-351 --out {out}/scene",
)
_FIDELITY = (
    "benchmarks.fidelity run --scene {out}/scene --recording {out}/survey/survey_os1.bag "
    "--trajectory {out}/survey/groundtruth_os1.tum --truth {out}/survey --out {out}/report"
)
JOBS = {
    "speed": Job(("benchmarks.throughput --n 1 1024 --peers none --poses 200000 --out {out}",), 2.0),
    "metro": Job(
        (f"scene.build {_METRO} --out {{out}}/scene",), 2.0, "scene/manifest.json", _METRO,
        lambda manifest: {"reconstruction/metro/length": manifest["bore"]["length"]},
    ),
    "dirty": Job((f"benchmarks.dirty {_DIRTY} --out {{out}}",), 3.0, needs=_DIRTY),
    "rays": Job((*_SURVEY_351, "benchmarks.rays --scene {out}/scene --out {out}/rays.json"), 8.0),
    "reconstruction": Job(("benchmarks.reconstruction --seeds 203 --length 351 --truth metro --out {out}",), 12.0),
    "fidelity": Job((*_SURVEY_351, _FIDELITY), 15.0, "report/report.json", read=_verdict),
    "board": Job(
        ("benchmarks.board.again --agents dead-reckoning fused ring-filter scan-matching --out {out}",), 20.0
    ),
}  # fmt: skip


@dataclass(frozen=True)
class ReproduceConfig:
    """Settings of a reproduction."""

    jobs: tuple[str, ...] = tuple(name for name, job in JOBS.items() if job.minutes <= 15.0)  # Measurements to make.
    out: Path = Path("out/reproduce")  # Folder for results; finished jobs in it are not run again.
    shared: Path = Path("../shared")  # Folder that holds surveys that are not packaged.


def run_job(job: Job, folder: Path, shared: Path) -> dict[str, float] | None:
    """Runs a job in its folder unless its result is there.

    Returns:
        Its figures by the ids of records; None where its input is missing.

    Raises:
        BenchmarkError: A command failed.
    """
    result = folder / job.records
    if not result.exists():
        if job.needs and not Path(job.needs.format(shared=shared)).exists():
            return None
        for command in job.commands:
            words = [word.format(out=folder, shared=shared) for word in command.split()]
            status = run_module(*words, log=folder / "log.txt").status
            if status and not result.exists():  # a missed goal also ends with a status
                raise BenchmarkError(f"{folder / 'log.txt'}: python -m {words[0]} ended with status {status}")
    if job.read is not None:
        return job.read(json.loads(result.read_text()))
    return {record.id: record.value for record in read_records(result)}


def run(config: ReproduceConfig) -> int:
    """Measures, prints and writes; returns 0 where every figure is the same, 1 where one differs.

    Raises:
        BenchmarkError: There is no such job, or one failed.
    """
    for name in config.jobs:
        if name not in JOBS:
            raise BenchmarkError(f"no job {name!r}; there are {', '.join(JOBS)}")
    require_folder(config.out)
    console, records = Console(highlight=False), on_record()
    rows: list[dict[str, Any]] = []
    for name in config.jobs:
        console.print(f"{name}: about {JOBS[name].minutes:g} min on two idle cores")
        figures = run_job(JOBS[name], config.out / name, config.shared)
        if figures is None:
            console.print(f"{name}: not measured, {JOBS[name].needs.format(shared=config.shared)} is not there")
        for id, value in (figures or {}).items():
            if id in records:
                verdict = "same" if records[id].holds(value) else "differs"
                rows.append({"id": id, "measured": value, "verdict": verdict})
    content = {"config": asdict(config), "environment": environment_facts(), "rows": rows}
    write_file(config.out / "reproduce.json", (json.dumps(content, indent=1, default=str) + "\n").encode())
    _show(rows, records, console)
    return int(any(row["verdict"] == "differs" for row in rows))


def _show(rows: list[dict[str, Any]], records: dict[str, Record], console: Console) -> None:
    """Prints what was measured, then what is only listed, each command once."""
    table = Table("record", "recorded", "measured", "unit", "verdict")
    for row in rows:
        record = records[row["id"]]
        table.add_row(record.id, number(record.value), number(row["measured"]), record.unit, row["verdict"])
    console.print(table)
    console.print("Not measured here:")
    others: dict[str, list[Record]] = {}
    for record in records.values():
        if record.id not in {row["id"] for row in rows}:
            others.setdefault(record.command, []).append(record)
    for command, some in others.items():
        console.print(f"  python -m {command}", soft_wrap=True, markup=False)
        for record in some:
            console.print(f"    {record.id}: {record.text} ({record.hardware}, {record.date})", soft_wrap=True)


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 0 where every figure is the same, 1 where one differs, 2 for a mistake."""
    return run_main("reproduce", ReproduceConfig, run, description=__doc__, words=words)


if __name__ == "__main__":
    sys.exit(main())
