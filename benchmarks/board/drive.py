"""Drives what the board lacks: one cell for a task and an agent, in a file of its own."""

import dataclasses
import hashlib
import itertools
import json
import os
import re
import time
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console

import subterra_jax as st
from benchmarks.board.cells import SCHEMA
from benchmarks.board.columns import FIRST, Setting, columns_of, draw_episodes, tunnel_names
from benchmarks.board.roster import ROSTER, bare, entry_of, make_agent
from benchmarks.command import BenchmarkError, require_least
from benchmarks.results import environment_facts, write_file
from subterra_jax.evaluation import evaluate
from subterra_jax.evaluation.floor import floor
from subterra_jax.evaluation.harness import fitting_batch
from subterra_jax.parts.spatial_lidar import SENSORS
from subterra_jax.policies.files import read_facts
from subterra_jax.policies.opening import policy_source, require_known
from subterra_jax.tasks import find
from subterra_jax.tunnel.sources import tunnel_digest
from train.tunnels import load

PLANAR = SENSORS[0]
TASKS = ("StopAt", "Return", "Obstructed", "Faulted", "Relocalise")
_HIDES = ("StopAt", "Return", "Obstructed", "Faulted")
_STARTS = {"given": (False,), "hidden": (True,), "both": (False, True)}
_progress = Console(stderr=True, highlight=False)


@dataclasses.dataclass(frozen=True)
class BoardConfig:
    """Settings of the board."""

    out: Path  # Folder for the cells, `board.md`, `board.png` and `records.json`.
    tasks: tuple[str, ...] = TASKS  # Tasks, as `StopAt`, `Subterra/StopAt-v1` or `FILE.py:ID` of one's own.
    # Whether the start is `given`, as tasks do, `hidden`, or one after the other where a task has both.
    start: Literal["given", "hidden", "both"] = "both"
    # Agents by name; policies by name, file or run folder; code as `module:Class` or `FILE.py:Class`; `cut:` and
    # `nomap:` before a learnt localiser take away what its walls tell, or its map. All of the roster if not given.
    agents: tuple[str, ...] = ()
    # Splits of the open world; a choice may be made on `val` alone.
    splits: tuple[str, ...] = ("val", "test-seen", "test-unseen")
    episodes: int = 50  # Episodes of each kind and split.
    tunnels: int = 5  # Tunnels of each kind and split.
    further: tuple[str, ...] = ()  # Names or files of further tunnels, a column each.
    sensor: str = PLANAR  # The LiDAR of agents without a line in the roster, by name.
    texture: float = 0.0  # Brightness of the walls, which agents get as intensities; 0 gives none.
    load: tuple[Path, ...] = ()  # Python files to run first, with things of one's own.
    memory: float = 8.0  # Memory for driving, GB; an agent that needs more drives in parts.
    report_only: bool = False  # Drive nothing.
    cells: Path | None = None  # Cells to report.


@dataclasses.dataclass(frozen=True)
class Job:
    """One cell to drive: what, by whom, with which LiDAR."""

    setting: Setting
    agent: str
    sensor: str


def choose_by_rule() -> None:
    """Let XLA choose kernels by rule, not by timing, if it has not started: the same cell then has the same bytes."""
    flags = os.environ.get("XLA_FLAGS", "")
    if "autotune_level" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_gpu_autotune_level=0".strip()


def check(config: BoardConfig) -> None:
    """Refuse what cannot be run, before anything is made.

    Raises:
        BenchmarkError: An agent, split or sensor is unknown, or a number is too small.
    """
    for agent in config.agents:
        require_known(bare(agent))
    require_least(config, tunnels=1, episodes=2)
    if not columns_of(config.splits, config.further):
        raise BenchmarkError("there is nowhere to drive: name splits or further tunnels")
    if config.sensor not in SENSORS:
        raise BenchmarkError(f"no sensor {config.sensor!r}; there are {', '.join(SENSORS)}")
    if not config.memory > 0.0:
        raise BenchmarkError(f"memory must be above 0, got {config.memory}")
    if config.cells is not None and not (config.report_only and config.cells.is_file()):
        raise BenchmarkError(f"{config.cells}: --cells takes a file, with --report-only")


def jobs_of(config: BoardConfig) -> list[Job]:
    """Return all cells that settings ask for, in the order of tasks and agents.

    Raises:
        TaskError: A task is unknown.
    """
    found = []
    for name in config.tasks:
        id = find(name, short=True)
        task = id.removeprefix("Subterra/").removesuffix("-v1") if id.startswith("Subterra/") else id
        for hidden in _STARTS[config.start]:
            if hidden and task not in _HIDES:
                continue
            for agent in config.agents or tuple(entry.name for entry in ROSTER):
                entry, asked = entry_of(agent), bool(config.agents)
                fits = (not entry.tasks or task in entry.tasks) and (entry.hidden or not hidden)
                if asked or fits:
                    sensor = config.sensor if entry.group == "other" else entry.sensor
                    found.append(Job(Setting(task, hidden, config.texture), agent, sensor))
    return list(dict.fromkeys(found))


def enter(job: Job, tunnel: Any) -> tuple[Any, Any]:
    """Return environment and params of a cell."""
    name = job.setting.task
    id = name if "/" in name else f"Subterra/{name}-v1"
    hidden: dict[str, Any] = {"hidden_start": True} if job.setting.hidden_start else {}
    texture = job.setting.texture
    shown: dict[str, Any] = {"intensity": True, "texture": texture} if texture else {}
    return st.make(id, tunnel=tunnel, estimates=True, sensor=job.sensor, **hidden, **shown)


def conditions(config: BoardConfig, sensor: str) -> str:
    """Return a digest of what a cell depends on: constants, world, tunnels, episodes and LiDAR."""
    content: list[Any] = [st.constants_digest(), config.splits, config.episodes, config.tunnels, FIRST]
    if sensor != PLANAR:
        content.append(sensor)
    if config.texture:
        content.append(config.texture)
    if config.further:
        content.append([tunnel_digest(name) for name in config.further])
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


def conditions_of_parts(config: BoardConfig) -> set[str]:
    """Return the digests of all splits together and of every choice of them, with any LiDAR."""
    parts = {
        some
        for n in range(not config.further, len(config.splits) + 1)
        for some in itertools.combinations(config.splits, n)
    }
    return {conditions(dataclasses.replace(config, splits=some), sensor) for some in parts for sensor in SENSORS}


def cell_file(config: BoardConfig, job: Job) -> Path:
    """Return the file of a cell."""
    words = (job.setting.words.replace(", ", "-"), job.agent, *(() if job.sensor == PLANAR else (job.sensor,)))
    return config.out / "cells" / f"{'.'.join(re.sub(r'[^A-Za-z0-9_-]', '_', word) for word in words)}.json"


def is_there(config: BoardConfig, job: Job) -> bool:
    """Tell whether a cell was driven under the same conditions, with the same weights."""
    file = cell_file(config, job)
    if not file.exists():
        return False
    kept = json.loads(file.read_text())
    return bool(kept.get("conditions") == conditions(config, job.sensor) and kept.get("policy") == weights(job.agent))


def weights(agent: str) -> str | None:
    """Return the digest of a policy's weights; None of a written agent."""
    source = policy_source(bare(agent))
    return None if source is None else str(read_facts(source)["tensors_sha256"])


def drive(config: BoardConfig, missing: list[Job]) -> None:
    """Drive cells, the tunnels made once for each LiDAR, and write each when it is done."""
    columns = columns_of(config.splits, config.further)
    names = tunnel_names(columns, config.tunnels)
    for sensor in dict.fromkeys(job.sensor for job in missing):
        started = time.monotonic()
        made = load(names, sensor=sensor)
        _progress.print(f"{len(names)} tunnels: {time.monotonic() - started:.0f} s")
        tunnel: Any = made if len(made) > 1 else made[0]
        floors: dict[Setting, list[float] | None] = {}
        for job in (job for job in missing if job.sensor == sensor):
            started = time.monotonic()
            env, params = enter(job, tunnel)
            tunnel = params.tunnel
            if job.setting not in floors:
                floors[job.setting] = floors_of(params, len(names))
            content = cell_of(config, job, env, params, floors[job.setting])
            content["seconds"] = round(time.monotonic() - started, 1)
            write_file(cell_file(config, job), (json.dumps(content) + "\n").encode())
            success, seconds = 100.0 * np.mean(content["success"]), content["seconds"]
            _progress.print(f"{job.setting.words}, {job.agent}: {success:.1f} % ({seconds:.0f} s)")


def floors_of(params: Any, n: int) -> list[float] | None:
    """Return the floor in each tunnel; None where nobody has derived one, as for a task of one's own."""
    if params.goal_kind == "cover" or "slip" not in params.parts:
        return None
    return [round(floor(params, index), 4) for index in range(n)]


def cell_of(config: BoardConfig, job: Job, env: Any, params: Any, floors: list[float] | None) -> dict[str, Any]:
    """Drive one cell."""
    columns = columns_of(config.splits, config.further)
    episodes = draw_episodes(job.setting, columns, config.tunnels, config.episodes, "faults" in params.parts)
    driver = make_agent(job.agent, env, params)
    at_once = fitting_batch(env, params, driver, len(episodes), config.memory)
    records = evaluate(env, params, driver, episodes, at_once)
    return {
        "schema": SCHEMA,
        "conditions": conditions(config, job.sensor),
        "task": job.setting.task,
        "hidden_start": job.setting.hidden_start,
        "agent": job.agent,
        "policy": weights(job.agent),
        "columns": [dataclasses.asdict(column) for column in columns],
        "tunnels": config.tunnels,
        "sensor": job.sensor,
        "texture": job.setting.texture,
        "success": records.success.astype(int).tolist(),
        "contact": records.contact.astype(int).tolist(),
        "goal_error": [None if np.isnan(e) else round(float(e), 3) for e in records.goal_error],
        "floor": floors,
        "facts": {**environment_facts(), "constants_sha256": st.constants_digest()},
    }
