"""When each seed reached the goal: episodes, steps and seconds to 90 % coverage with every episode a success."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from train.curve import GOAL
from train.run.episodes import WINDOW
from train.run.log import read_log

FILE = "seeds.json"
_UNIT = {"episodes": 1.0, "steps": 1e3, "seconds": 1.0, "seconds_compiled": 1.0}
_WHAT = tuple(_UNIT)


def reached(run: Path) -> dict[str, float] | None:
    """Where the rolling hundred of a run first met the goal; None if it never did.

    Returns:
        `episodes` and `steps` until then, `seconds` with compilation and `seconds_compiled` without.
    """
    for line in read_log(run):
        full = line["episodes"] >= WINDOW
        if full and line["coverage_mean_100"] >= GOAL and line["success_mean_100"] == 1.0:
            seconds = line["timing"]["seconds"]
            return {
                "episodes": line["episodes"],
                "steps": line["step"],
                "seconds": seconds,
                "seconds_compiled": seconds - line["timing"]["compile_seconds"],
            }
    return None


def tell(out: Path, runs: list[Path], scores: list[dict[str, Any]]) -> None:
    """Prints a line for each seed and their mean ± standard deviation; writes `seeds.json`."""
    rows: list[dict[str, Any]] = [
        {"run": run.name, "reached": reached(run), "last": read_log(run)[-1], "evaluation": found}
        for run, found in zip(runs, scores, strict=True)
    ]
    summary = _mean_and_spread(rows)
    Console().print(_table(rows, summary))
    fresh = out / f".{FILE}.partial"
    fresh.write_text(json.dumps({"schema": "subterra.seeds/1", "goal": GOAL, "mean_sd": summary, "runs": rows}) + "\n")
    fresh.replace(out / FILE)


def _table(rows: list[dict[str, Any]], summary: dict[str, tuple[float, float]]) -> Table:
    """A line for each seed, narrow enough for 80 columns."""
    grid = Table(title=f"to {100 * GOAL:.0f} % coverage and 100 % success of the last {WINDOW}; at the end")
    for heading in ("run", "episodes", "k steps", "s", "s compiled", "coverage %", "success %"):
        grid.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        when = [f"{row['reached'][name] / _UNIT[name]:,.1f}" for name in _WHAT] if row["reached"] else ["never"] * 4
        covered = row["last"]["coverage_mean_100"]
        last = "none yet" if covered is None else f"{100 * covered:.2f}"
        grid.add_row(row["run"], *when, last, f"{100 * row['evaluation']['success']:.1f}")
    grid.add_section()
    spread = [[f"{summary[name][k] / _UNIT[name]:,.1f}" for name in summary] for k in (0, 1)]
    grid.add_row("mean", *spread[0])
    grid.add_row("± sd", *spread[1])
    return grid


def _mean_and_spread(rows: list[dict[str, Any]]) -> dict[str, tuple[float, float]]:
    """Over the seeds that have reached the goal; empty if none has."""
    found = [row["reached"] for row in rows if row["reached"]]
    spread = {name: np.array([row[name] for row in found], float) for name in _WHAT} if found else {}
    return {name: (float(v.mean()), float(v.std(ddof=min(1, len(v) - 1)))) for name, v in spread.items()}
