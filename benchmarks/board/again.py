"""Some episodes of each cell on record again: whether agents, tasks and tunnels are still those that were scored.

`python -m benchmarks.board.again --episodes 20 --out out/again`
"""

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.board.cells import Cell, read_cells, setting_of
from benchmarks.board.columns import Column, draw_episodes, tunnel_names
from benchmarks.board.drive import BoardConfig, Job, choose_by_rule, conditions_of_parts, enter
from benchmarks.board.roster import make_agent
from benchmarks.command import BenchmarkError, require_least, run_main
from benchmarks.records import measured, write_records
from benchmarks.results import environment_facts, write_file
from subterra_jax.evaluation import Episodes, evaluate
from subterra_jax.host.files import require_folder
from train.tunnels import load

ON_RECORD = Path(__file__).parent / "cells.jsonl"
_progress = Console(stderr=True, highlight=False)


@dataclasses.dataclass(frozen=True)
class AgainConfig:
    """Settings of a check."""

    out: Path  # Folder for `again.json`, a line for each cell.
    cells: Path = ON_RECORD  # File of the cells.
    tasks: tuple[str, ...] = ()  # Tasks of the cells to drive; all if not given.
    agents: tuple[str, ...] = ()  # Agents of the cells to drive; all if not given.
    episodes: int = 20  # Episodes of each cell, spread evenly over its tunnels.
    cache: Path | None = None  # Folder in which made tunnels are kept from run to run.


def run(config: AgainConfig) -> int:
    """Drives, compares and writes; returns 1 where a cell is another one.

    Raises:
        SubterraError: No cell is asked for, or the folder cannot be written.
    """
    require_least(config, episodes=1)
    cells = read_cells(config.cells, conditions_of_parts(BoardConfig(config.out)))
    cells = [cell for cell in cells if (not config.tasks or cell["task"] in config.tasks)
             and (not config.agents or cell["agent"] in config.agents)]  # fmt: skip
    if not cells:
        raise BenchmarkError(f"{config.cells}: holds no cell of these tasks and agents")
    require_folder(config.out)
    found = []
    for cell in cells:
        started = time.monotonic()
        row = compare(cell, config)
        found.append(row)
        verdict = "the same" if row["same"] else f"{row['differ']} of {row['episodes']} differ"
        _progress.print(f"{row['task']}, {row['agent']}: {verdict} ({time.monotonic() - started:.0f} s)")
        content = {"facts": environment_facts(), "cells": found}
        write_file(config.out / "again.json", (json.dumps(content) + "\n").encode())
    same = sum(row["same"] for row in found)
    command = f"benchmarks.board.again --episodes {config.episodes} --out out/again"
    share = measured("board/again/same", round(100.0 * same / len(found), 1), "%", command, n=len(found))
    write_records(config.out / "records.json", [share])
    print(f"{same} of {len(found)} cells have the same successes and contacts in {config.episodes} episodes")
    return int(same < len(found))


def compare(cell: Cell, config: AgainConfig) -> dict[str, Any]:
    """Drive some episodes of a cell again.

    Returns:
        Task, agent, whether successes and contacts are the same, how many are not, and the largest difference of the
        distance from the goal, m; that is rounded to 1 mm in cells.
    """
    setting, columns = setting_of(cell), [Column(**column) for column in cell["columns"]]
    rows = np.unique(np.linspace(0, len(cell["success"]) - 1, config.episodes).round().astype(int))
    size = len(cell["success"]) // len(columns)
    drawn = draw_episodes(setting, columns, cell["tunnels"], size, setting.task == "Faulted")
    used = np.unique(drawn.tunnel[rows])  # the tunnels of these episodes alone are made
    names = tunnel_names(columns, cell["tunnels"])
    made = load([names[i] for i in used], cache=config.cache, sensor=cell["sensor"])
    env, params = enter(Job(setting, cell["agent"], cell["sensor"]), made if len(made) > 1 else made[0])
    some = {name: values[rows] for name, values in vars(drawn).items()}
    episodes = Episodes(**{**some, "tunnel": np.searchsorted(used, some["tunnel"]).astype(np.int32)})
    records = evaluate(env, params, make_agent(cell["agent"], env, params), episodes, len(rows))
    then = {name: [cell[name][row] for row in rows] for name in ("success", "contact", "goal_error")}
    differ = (records.success.astype(int) != then["success"]) | (records.contact.astype(int) != then["contact"])
    apart = np.abs(records.goal_error - np.array([np.nan if e is None else e for e in then["goal_error"]]))
    return {
        "task": setting.words,
        "agent": cell["agent"],
        "same": not differ.any(),
        "differ": int(differ.sum()),
        "episodes": len(rows),
        "apart": float(np.nanmax(apart)) if np.isfinite(apart).any() else None,
    }


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 0 where all cells are the same, 1 where one is not, 2 for a user's mistake."""
    choose_by_rule()
    return run_main("board.again", AgainConfig, run, description=__doc__, words=words)


if __name__ == "__main__":
    sys.exit(main())
