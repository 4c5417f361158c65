"""Measures the numbers of README and docs/results.md again, says which differ, and lists the others with commands.

Example: python -m benchmarks.reproduce --jobs speed learning metro --out out/reproduce
"""

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.command import BenchmarkError, run_main
from benchmarks.reproduce.claims import CLAIMS, HEADING, JOBS, Claim, Job, read_result, read_tables
from benchmarks.results import constants_facts, environment_facts, write_file
from subterra_jax.host.files import require_folder

ROOT = Path(__file__).parents[2]
README, RESULTS, MEASUREMENTS = ROOT / "README.md", ROOT / "docs" / "results.md", ROOT / "docs" / "measurements.md"
_QUICK = tuple(name for name, job in JOBS.items() if job.minutes <= 15.0)
_MISSING = "not in the documents"


@dataclass(frozen=True)
class ReproduceConfig:
    """Settings of a reproduction.

    Attributes:
        jobs: Measurements to make; `leaderboard` takes hours and runs only if named.
        out: Folder for results; finished jobs in it are not run again.
        shared: Folder that holds `data/metro_asbuilt`, which is not packaged.
    """

    jobs: tuple[str, ...] = _QUICK
    out: Path = Path("out/reproduce")
    shared: Path = Path("../shared")


def result_rows() -> list[dict[str, str]]:
    """Returns the rows of the tables of results, then of all tables of README, results and measurements."""
    pages = [path.read_text() for path in (README, RESULTS, MEASUREMENTS)]
    results = [row for page in pages[:2] for row in read_tables(page, HEADING)]
    return [*results, *(row for page in pages for row in read_tables(page))]


def verdict(claim: Claim, stated: float | None, measured: float | None) -> str:
    """Returns `same`, `differs`, or why neither can be said."""
    if stated is None:
        return _MISSING
    if measured is None:
        return "not measured: its input is not here"
    return "same" if claim.holds(stated, measured) else "differs"


def run_job(job: Job, folder: Path, shared: Path) -> Path | None:
    """Runs a job unless its result is there.

    Args:
        job: Job to run.
        folder: Its folder.
        shared: Folder of the surveys that are not packaged.

    Returns:
        Its result; `None` where its input is missing.

    Raises:
        BenchmarkError: A command failed.
    """
    result = folder / job.result
    if result.exists():
        return result
    if job.needs and not Path(job.needs.format(shared=shared)).exists():
        return None
    folder.mkdir(parents=True, exist_ok=True)
    for command in job.commands:
        words = [word.format(out=folder, shared=shared) for word in command.split()]
        print(f"$ python -m {' '.join(words)}", flush=True)
        with (folder / "log.txt").open("a") as log:
            code = subprocess.run([sys.executable, "-m", *words], stdout=log, stderr=log, check=False).returncode
        if code and not result.exists():  # a missed goal also ends with a status
            raise BenchmarkError(f"{folder / 'log.txt'}: python -m {words[0]} ended with status {code}")
    return result


def reproduce(config: ReproduceConfig, documents: Sequence[dict[str, str]], console: Console) -> list[dict[str, Any]]:
    """Runs the jobs; returns one row for each number.

    Raises:
        BenchmarkError: There is no such job, or one failed.
    """
    for name in config.jobs:
        if name not in JOBS:
            raise BenchmarkError(f"no job {name!r}; there are {', '.join(JOBS)}")
    rows = []
    for name in config.jobs:
        console.print(f"{name}: about {JOBS[name].minutes:g} min on two idle cores")
        path = run_job(JOBS[name], config.out / name, config.shared)
        content = None if path is None else read_result(path)
        for claim in CLAIMS:
            if claim.job == name and claim.read is not None:
                stated, measured = claim.stated(documents), None if content is None else claim.read(content)
                text = f"{claim.row}: {claim.text or claim.column}"
                result = verdict(claim, stated, measured)
                rows.append({"number": text, "stated": stated, "measured": measured, "verdict": result})
    return rows


def show(rows: list[dict[str, Any]], documents: Sequence[dict[str, str]], console: Console) -> None:
    """Prints the measured numbers, then those that are only listed."""
    table = Table("number", "stated", "measured", "verdict")
    for row in rows:
        cells = ["" if value is None else f"{value:.6g}" for value in (row["stated"], row["measured"])]
        table.add_row(row["number"], *cells, row["verdict"])
    console.print(table)
    console.print("Not measured here, since they need a GPU or hours:")
    for claim in CLAIMS:
        if claim.command and claim.stated(documents) is not None:
            bound = "±" if claim.bound == "near" else f"{claim.bound}, tolerance"
            console.print(
                f"  {claim.row}: {claim.text}, {bound} {claim.tolerance:g} ({claim.measured})", soft_wrap=True
            )
            console.print(f"    python -m {claim.command}", soft_wrap=True)


def run(config: ReproduceConfig) -> int:
    """Measures, prints and writes; returns 0 where every number is the same, 1 where one differs."""
    console, documents = Console(highlight=False), result_rows()
    require_folder(config.out)
    rows = reproduce(config, documents, console)
    content = {"config": asdict(config), "environment": environment_facts(), **constants_facts(), "rows": rows}
    write_file(config.out / "reproduce.json", (json.dumps(content, indent=1, default=str) + "\n").encode())
    show(rows, documents, console)
    return int(any(row["verdict"] in ("differs", _MISSING) for row in rows))


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 0 where every number is the same, 1 where one differs, 2 for a mistake."""
    return run_main("reproduce", ReproduceConfig, run, description=__doc__, words=words)


if __name__ == "__main__":
    sys.exit(main())
