"""Drives a policy on wheels, on the rover and on four legs: `python -m benchmarks.b2_traverse --robot rover`.

Robots of the same seeds have the same starts, goals and noise whatever moves them. Friction, mass, gains and sensor
noise are drawn for every B2; rovers are all alike. With `--engine mujoco` they move in MuJoCo's own engine on the host,
with `--scene DIR` in the scene itself.
"""

import dataclasses
import math
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from scipy.stats import binomtest

import subterra_jax as st
from benchmarks.command import BenchmarkError, require_least, run_main
from benchmarks.records import Record, measured, write_records
from subterra_jax.b2 import transfer
from subterra_jax.b2.gait import RELEASED
from subterra_jax.evaluation import Episodes
from subterra_jax.host.files import require_file
from subterra_jax.host.task_ids import B2_TRAVERSE, full_id
from subterra_jax.physics.stage import EngineName
from subterra_jax.policies.opening import open_agent
from subterra_jax.policies.trained import Trained
from subterra_jax.tunnel.sources import load_tunnel
from train.log import print_table
from train.tunnels import names_of

_HORIZON = 8000  # steps of a rover, as long as the B2 may take; the task's own end before a slipping rover's arrival
_UNITS = {"percent": "%", "deg": "deg", "rms": "m", "p95": "m", "mean": "m/s"}


@dataclass(frozen=True)
class Command:
    """Lets robots do a task, and says how far they got and how their motion differs from that of the plan.

    Example: python -m benchmarks.b2_traverse --robot rover --task StopAt-v1 --agent StopAt-v1 --engine mujoco
    """

    robot: Literal["wheels", "rover", "b2"] = "b2"  # Robot; `wheels` is that of the plan.
    task: str = "Traverse-v1"  # Task of wheels and rover.
    robots: int = 100  # Number of robots.
    seed: int = 0  # Seed of the first; the others have those after it.
    jobs: int = 1  # Processes that share the robots; for `--engine mujoco`.
    # Driver: a baseline, a run folder of `train`, a policy's file or name, or code as `FILE.py:Class`.
    agent: str = "dead-reckoning"
    # Largest speed of a trained driver, m/s; its own if not given. A rover reaches 1.5, and slips less below.
    speed: float | None = None
    policy: str = RELEASED  # Gait: a file, the name of a released gait, or `trot`.
    engine: EngineName = "mjx"  # `mjx`, by Warp where it is installed on a GPU, or one way of it; or `mujoco`, in C.
    tunnel: str | None = None  # Tunnels, files or names as `open:val:0-7`; the task's own if not given.
    scene: Path | None = None  # Built scene folder, instead of a tunnel.
    # Length of the tunnel to use, m; 0 is all. For a short trial lower `coverage`: no policy has met a far mouth.
    length: float = 0.0
    coverage: float | None = None  # Fraction of the tunnel that counts as success; the task's own if not given.
    out: Path | None = None  # File for the figures, as records.


def show_progress(now: transfer.Walk) -> None:
    """Prints station, falls and contacts of the robots on one line."""
    falls, contacts = int(np.sum(now.fall)), int(np.sum(now.contact))
    counts = f"{int(np.sum(now.over))} of {len(now.over)} over, {falls} falls, {contacts} contacts"
    print(f"\rstation {np.median(now.state.station):6.1f} m, {counts}", end="", file=sys.stderr, flush=True)


def _check(arguments: Command) -> None:
    require_least(arguments, robots=1, seed=0, jobs=1)
    if arguments.jobs > 1 and arguments.engine != "mujoco":
        raise BenchmarkError(f"jobs = {arguments.jobs} is for engine = mujoco")
    if arguments.coverage is not None and not 0.0 < arguments.coverage <= 1.0:
        raise ValueError(f"coverage must be above 0 and at most 1, got {arguments.coverage}")
    if arguments.speed is not None and not 0.0 < arguments.speed < math.inf:
        raise ValueError(f"speed must be above 0, got {arguments.speed}")
    if not 0.0 <= arguments.length < math.inf:
        raise ValueError(f"length must not be negative, got {arguments.length}")
    if arguments.scene is not None and arguments.tunnel is not None:
        raise ValueError(f"either a tunnel or a scene, got both {arguments.tunnel} and {arguments.scene}")
    if arguments.out is not None:
        require_file(arguments.out)


def _open(arguments: Command) -> tuple[Any, Any]:
    tunnel: Any = None if arguments.tunnel is None else names_of(arguments.tunnel)
    if arguments.length:
        tunnel = [load_tunnel(name).stretch((0.0, arguments.length)) for name in tunnel or [None]]
    if tunnel is not None and len(tunnel) == 1:
        tunnel = tunnel[0]
    options: dict[str, Any] = {"tunnel": tunnel}
    if arguments.coverage is not None:
        options["goal_coverage"] = arguments.coverage
    if arguments.robot != "wheels":
        options |= {"scene": arguments.scene, "engine": arguments.engine}
    if arguments.robot == "b2":
        return st.make(B2_TRAVERSE, policy=arguments.policy, **options)
    id = full_id(arguments.task.removeprefix("Subterra/"))
    if id == "Subterra/Traverse-v1":
        options["horizon"] = _HORIZON
    return st.make(id, motion=arguments.robot, **options)


def _drive(arguments: Command, job: int = 0) -> tuple[transfer.Walk, transfer.Row, Any]:
    if arguments.jobs > 1 and hasattr(os, "sched_setaffinity"):  # each on a core, or all would compute on all of them
        os.sched_setaffinity(0, np.roll(sorted(os.sched_getaffinity(0)), -job)[:1].tolist())
    env, params = _open(arguments)
    count, levels = params.tunnel.count, np.asarray(env.levels(params))
    index = np.array_split(np.arange(arguments.robots), arguments.jobs)[job]
    episodes = Episodes(
        seed=(arguments.seed + index).astype(np.uint32),
        tunnel=(index % count).astype(np.int32),
        severity=levels[index // count % len(levels)].astype(np.int32),
        group=0 * index,
    )
    agent = _slowed(open_agent(arguments.agent, env, params), arguments)
    watch = show_progress if arguments.jobs == 1 else None
    return *transfer.walk_robots(env, params, agent, episodes, watch), jax.device_get(params)


def _slowed(agent: Any, arguments: Command) -> Any:
    """Returns a trained agent whose commands end at the speed that is asked for, in its own memory too."""
    if arguments.speed is None:
        return agent
    if Trained not in type(agent).__mro__:
        raise BenchmarkError(f"speed = {arguments.speed:g} is for a trained driver, and {arguments.agent} is none")
    own = {"speed": arguments.speed} if hasattr(agent, "speed") else {"high": agent.high.at[0].min(arguments.speed)}
    return dataclasses.replace(agent, **own)


def _drive_all(arguments: Command) -> tuple[transfer.Walk, transfer.Row, Any]:
    if arguments.jobs == 1:
        return _drive(arguments)
    arguments = dataclasses.replace(arguments, jobs=min(arguments.jobs, arguments.robots))
    with ProcessPoolExecutor(arguments.jobs, get_context("spawn")) as pool:
        done = list(pool.map(_drive, [arguments] * arguments.jobs, range(arguments.jobs)))
    steps = max(rows.lateral.shape[0] for _, rows, _ in done)
    over = lambda leaf: np.full((steps - len(leaf), *leaf.shape[1:]), np.nan, leaf.dtype)  # noqa: E731
    longer = [jax.tree.map(lambda leaf: np.concatenate([leaf, over(leaf)]), rows) for _, rows, _ in done]
    rows = jax.tree.map(lambda *parts: np.concatenate(parts, axis=1), *longer)
    return jax.tree.map(lambda *parts: np.concatenate(parts), *(walk for walk, _, _ in done)), rows, done[0][2]


def command(arguments: Command) -> None:
    """Drives the robots and prints the figures.

    Raises:
        ValueError: A number is out of range.
        SubterraError: Scene, tunnel, agent or gait is missing or wrong, or the output cannot be written.
    """
    _check(arguments)
    started = time.perf_counter()
    figures = transfer.figures(*_drive_all(arguments))
    print(f"\n{time.perf_counter() - started:.0f} s", file=sys.stderr)
    print_table(f"{arguments.robots} of {arguments.robot}, {arguments.engine}, {arguments.agent}", figures)
    if arguments.out is not None:
        write_records(arguments.out, records_of(arguments, figures))


def records_of(arguments: Command, figures: dict[str, float]) -> list[Record]:
    """Returns the figures as records `b2/ROBOT/TASK/ENGINE/AGENT/FIGURE`, of wheels without an engine."""
    n, agent = arguments.robots, Path(arguments.agent).name.removesuffix(".safetensors")
    agent += "" if arguments.speed is None else f"-at-{arguments.speed:g}"
    task = "B2Traverse-v1" if arguments.robot == "b2" else arguments.task
    place = arguments.scene or arguments.tunnel
    task += "" if place is None or ":" in str(place) else f"-in-{Path(place).stem}"
    name = "/".join(["b2", arguments.robot, task, *([] if arguments.robot == "wheels" else [arguments.engine]), agent])
    given = [(field.name, getattr(arguments, field.name), field.default) for field in dataclasses.fields(arguments)]
    words = " ".join(f"--{key} {value}" for key, value, usual in given if value != usual and key not in ("out", "jobs"))
    records = []
    for figure, value in figures.items():
        stem, _, unit = figure.rpartition("_")
        interval, tolerance = None, 0.1 * abs(value)
        if stem in ("success", "fall", "contact"):
            fraction = binomtest(round(value / 100.0 * n), n).proportion_ci(method="wilson")
            interval = round(100.0 * fraction.low, 1), round(100.0 * fraction.high, 1)
            tolerance = 100.0 * 1.96 * math.sqrt(0.25 / n)
        records.append(
            measured(
                f"{name}/{(stem if unit in ('percent', 'deg') else figure).replace('_', '-')}",
                round(value, 1) if unit in ("percent", "deg") else float(f"{value:.3g}"),
                _UNITS.get(unit, ""), f"benchmarks.b2_traverse {words}",
                interval=interval, tolerance=tolerance, n=n, split=str(place or "the task's own tunnels"),
            )
        )  # fmt: skip
    return records


if __name__ == "__main__":
    sys.exit(run_main("b2_traverse", Command, command))
