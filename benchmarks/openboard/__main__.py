"""Agents on the tasks of version 1, by kind of lining and split, between floor and ceiling.

`python -m benchmarks.openboard --tasks StopAt Return --out out/openboard`

Each task and agent is one file under `--out`/cells; a cell that is there is not driven again. All cells together are
`cells.jsonl`. `--report-only` writes tables and picture of the cells that are there, or of those in a file `--cells`,
also where a cell is of some of the splits only: `benchmarks/openboard/cells.jsonl` holds those of the docs.
"""

import dataclasses
import hashlib
import itertools
import json
import re
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

import subterra_jax as st
from benchmarks.command import BenchmarkError, run_main
from benchmarks.kinds import make_agent
from benchmarks.openboard import columns as board
from benchmarks.openboard import report
from benchmarks.results import environment_facts, write_file
from subterra_jax.evaluation import evaluate
from subterra_jax.evaluation.floor import floor
from subterra_jax.evaluation.harness import fitting_batch
from subterra_jax.host.files import require_folder
from subterra_jax.parts.spatial_lidar import SENSORS
from train.tunnels import PLANAR, load

_progress = Console(stderr=True, highlight=False)


@dataclasses.dataclass(frozen=True)
class OpenboardConfig:
    """Settings of the leaderboard of version 1.

    Attributes:
        out: Folder for the cells, `openboard.md` and `openboard.png`.
        tasks: Tasks without `Subterra/` and `-v1`.
        agents: Names of agents, released policies, or files of policies; `cut:FILE` and `nomap:FILE` as in
            `benchmarks.kinds`.
        splits: Splits of the open world; a choice may be made on `val` alone.
        episodes: Episodes of each kind and split.
        tunnels: Tunnels of each kind and split, over which the episodes are spread.
        sensor: The LiDAR, by name; use a folder of its own for each.
        memory: Memory that driving may take at once, GB; an agent that needs more is driven in parts of the episodes.
        cache: Folder in which made tunnels are kept from run to run.
        report_only: Drive nothing.
        cells: File of cells to report in place of those in `out`, with `report_only`.
    """

    out: Path
    tasks: tuple[str, ...] = board.TASKS
    agents: tuple[str, ...] = board.AGENTS
    splits: tuple[str, ...] = ("val", "test-seen", "test-unseen")
    episodes: int = 50
    tunnels: int = 5
    sensor: str = PLANAR
    memory: float = 8.0
    cache: Path | None = None
    report_only: bool = False
    cells: Path | None = None


def run(config: OpenboardConfig) -> None:
    """Drives the agents whose cells are missing, and writes tables and picture.

    Raises:
        SubterraError: A task, split or agent is unknown, or the folder cannot be written.
    """
    board.check(config.tasks, config.agents, config.splits, config.tunnels, config.episodes)
    if config.sensor not in SENSORS:
        raise BenchmarkError(f"no sensor {config.sensor!r}; there are {', '.join(SENSORS)}")
    if not config.memory > 0.0:
        raise BenchmarkError(f"memory must be above 0, got {config.memory}")
    require_folder(config.out)
    if config.cells is not None and not (config.report_only and config.cells.is_file()):
        raise BenchmarkError(f"{config.cells}: --cells takes a file, with --report-only")
    missing = [
        (task, agent)
        for task in config.tasks
        for agent in config.agents
        if not _is_there(cell_file(config, task, agent), config)
    ]
    if missing and not config.report_only:
        _drive(config, missing)
    cells = report.read_cells(config.cells or config.out / "cells", conditions_of_parts(config))
    write_file(config.out / "cells.jsonl", "".join(json.dumps(cell) + "\n" for cell in cells).encode())
    write_file(config.out / "openboard.md", report.as_markdown(cells).encode())
    write_file(config.out / "openboard.png", report.as_png(cells))
    print(config.out / "openboard.md")


def conditions(config: OpenboardConfig) -> str:
    """Return a digest of what a cell depends on: constants, world, tunnels, episodes and LiDAR."""
    content = [st.constants_digest(), config.splits, config.episodes, config.tunnels, board.FIRST]
    if config.sensor != PLANAR:
        content.append(config.sensor)
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


def conditions_of_parts(config: OpenboardConfig) -> set[str]:
    """Return the digests of all splits together and of every choice of them: a cell may be of a few splits only."""
    choices = (some for n in range(1, len(config.splits) + 1) for some in itertools.combinations(config.splits, n))
    return {conditions(dataclasses.replace(config, splits=some)) for some in choices}


def cell_file(config: OpenboardConfig, task: str, agent: str) -> Path:
    """Return the file of a task and an agent."""
    return config.out / "cells" / f"{task}.{re.sub(r'[^A-Za-z0-9_.-]', '_', agent)}.json"


def _is_there(file: Path, config: OpenboardConfig) -> bool:
    return file.exists() and json.loads(file.read_text()).get("conditions") == conditions(config)


def _drive(config: OpenboardConfig, missing: list[tuple[str, str]]) -> None:
    """Drives agents, the tunnels made once for all."""
    columns = board.columns_of(config.splits)
    names = board.tunnel_names(columns, config.tunnels)
    started = time.monotonic()
    made = load(names, cache=config.cache, sensor=config.sensor)
    tunnel = st.make(board.task_of(missing[0][0])[0], tunnel=made, sensor=config.sensor)[1].tunnel
    _progress.print(f"{len(names)} tunnels: {time.monotonic() - started:.0f} s")
    floors: dict[str, list[float]] = {}
    for task, agent in missing:
        started = time.monotonic()
        id, hidden = board.task_of(task)
        env, params = st.make(id, tunnel=tunnel, estimates=True, sensor=config.sensor, hidden_start=hidden)
        if task not in floors:
            floors[task] = [floor(params, index) for index in range(len(names))]
        episodes = board.draw_episodes(task, columns, config.tunnels, config.episodes)
        driver = make_agent(agent, env, params)
        at_once = fitting_batch(env, params, driver, len(episodes), config.memory)
        records = evaluate(env, params, driver, episodes, at_once)
        seconds = time.monotonic() - started
        content: dict[str, Any] = {
            "schema": board.SCHEMA,
            "conditions": conditions(config),
            "task": task,
            "agent": agent,
            "columns": [dataclasses.asdict(column) for column in columns],
            "tunnels": config.tunnels,
            "sensor": config.sensor,
            "success": records.success.astype(int).tolist(),
            "contact": records.contact.astype(int).tolist(),
            "goal_error": [None if np.isnan(e) else round(float(e), 3) for e in records.goal_error],
            "floor": [round(value, 4) for value in floors[task]],
            "seconds": round(seconds, 1),
            "facts": {**environment_facts(), "constants_sha256": st.constants_digest()},
        }
        write_file(cell_file(config, task, agent), (json.dumps(content) + "\n").encode())
        _progress.print(f"{task}, {agent}: {100 * records.success.mean():.1f} % ({seconds:.0f} s)")


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    return run_main("openboard", OpenboardConfig, run, description=__doc__, words=words)


if __name__ == "__main__":
    sys.exit(main())
