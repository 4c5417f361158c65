"""Measures the README's numbers again and says which differ; goes on where it stopped.

Example: python -m benchmarks.reproduce --jobs speed learning metro --out out/reproduce
"""

import json
import re
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.command import status
from benchmarks.reproduce.claims import CLAIMS, ON_A_GPU, Claim, read_result
from benchmarks.reproduce.errors import ReproduceError
from benchmarks.reproduce.jobs import JOBS, run
from benchmarks.throughput.facts import environment_facts
from scene.arguments import parse
from subterra_jax.outputs import require_folder

README = Path(__file__).parents[2] / "README.md"
_QUICK = tuple(name for name, job in JOBS.items() if job.about <= 15.0)


@dataclass(frozen=True)
class ReproduceConfig:
    """What is measured again.

    Attributes:
        jobs: Which measurements; `leaderboard` takes hours and is left out unless named.
        out: Folder for results; what is in it already is not measured again.
        shared: Folder that holds `data/metro_asbuilt`, which is not packaged.
    """

    jobs: tuple[str, ...] = _QUICK
    out: Path = Path("out/reproduce")
    shared: Path = Path("../shared")


def verdict(claim: Claim, stated: float | None, measured: float | None) -> str:
    """`same`, `differs`, or why neither can be said."""
    if stated is None:
        return "not in the README"
    if measured is None:
        return "not measured: its input is not here"
    if claim.speed:
        return f"{measured / stated:.2f} times as much on this machine"
    return "same" if abs(measured - stated) <= claim.tolerance + 1e-9 else "differs"


def reproduce(config: ReproduceConfig, readme: str, console: Console) -> list[dict[str, Any]]:
    """One row a number.

    Raises:
        ReproduceError: There is no such job, or one failed.
    """
    for name in config.jobs:
        if name not in JOBS:
            raise ReproduceError(f"no job {name!r}; there are {', '.join(JOBS)}")
    rows = []
    for name in config.jobs:
        console.print(f"{name}: about {JOBS[name].about:g} min on two idle cores")
        path = run(JOBS[name], config.out / name, config.shared)
        content = None if path is None else read_result(path)
        for claim in CLAIMS:
            if claim.job == name:
                stated, measured = claim.stated(readme), None if content is None else claim.read(content)
                told = verdict(claim, stated, measured)
                rows.append({"number": claim.name, "readme": stated, "measured": measured, "verdict": told})
    return rows


def show(rows: list[dict[str, Any]], readme: str, console: Console) -> None:
    """The table, and what a GPU is needed for."""
    table = Table("number", "README", "measured", "verdict")
    for row in rows:
        cells = ["" if value is None else f"{value:.6g}" for value in (row["readme"], row["measured"])]
        table.add_row(row["number"], *cells, row["verdict"])
    console.print(table)
    console.print("These need a GPU:")
    text = " ".join(readme.split())
    for pattern, command in ON_A_GPU:
        if found := re.search(pattern, text):
            console.print(f"  {found[0]}: {command}", soft_wrap=True)


def act(config: ReproduceConfig) -> int:
    """Measures and tells: 0 where every number is the same, 1 where one differs."""
    console, readme = Console(highlight=False), README.read_text()
    require_folder(config.out)
    rows = reproduce(config, readme, console)
    content = {"config": asdict(config), "environment": environment_facts(), "rows": rows}
    config.out.mkdir(parents=True, exist_ok=True)
    (config.out / "reproduce.json").write_text(json.dumps(content, indent=1, default=str) + "\n")
    show(rows, readme, console)
    return int(any(row["verdict"] in ("differs", "not in the README") for row in rows))


def main(args: list[str] | None = None) -> int:
    """Entry point: 0 where every number is the same, 1 where one differs, 2 for a user's mistake."""
    prog = "python -m benchmarks.reproduce"
    config = parse(lambda words: tyro.cli(ReproduceConfig, args=words, prog=prog, description=__doc__), args)
    return status(lambda: act(config))


if __name__ == "__main__":
    sys.exit(main())
