"""Counts the robots that get through a tunnel by physics: `python -m benchmarks.b2_traverse --robots 100`.

Friction, mass, gains and sensor noise are drawn for every B2; `--robot rover` drives Scouts, all alike. With
`--engine mujoco` the same robots walk in MuJoCo's own engine on the host, with `--scene DIR` in the scene itself.
"""

import json
import math
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

import subterra_jax as st
from benchmarks.command import require_least, run_main
from subterra_jax.b2 import tasks, transfer
from subterra_jax.b2.gait import RELEASED
from subterra_jax.host.files import require_file
from subterra_jax.parts.unicycle import VehicleParams
from subterra_jax.policies.opening import open_agent
from subterra_jax.tunnel.sources import load_tunnel
from train.log import print_table

_HORIZON = 8000  # steps of a rover, as long as the B2 may take; the task's own end before a slipping rover's arrival


@dataclass(frozen=True)
class Command:
    """Lets robots with mass traverse a tunnel.

    Example: python -m benchmarks.b2_traverse --robots 100 --agent B2Traverse-v1 --engine mujoco
    """

    robot: Literal["b2", "rover"] = "b2"  # Robot.
    robots: int = 100  # Number of robots.
    seed: int = 0  # Seed for their draws.
    # Driver: a baseline, a run folder of `train --embodiment b2`, a policy's file or name, or code as `FILE.py:Class`.
    agent: str = "dead-reckoning"
    policy: str = RELEASED  # Gait: a file, the name of a released gait, or `trot`.
    engine: Literal["mjx", "mujoco"] = "mjx"  # `mjx`, or `mujoco` in C on the host.
    tunnel: str | None = None  # Tunnel file or name; the packaged tunnel if not given.
    scene: Path | None = None  # Built scene folder, instead of a tunnel.
    # Length of the tunnel to use, m; 0 is all of it. A policy trained on all of it has never been near a far mouth; for
    # a short trial, lower `coverage` instead.
    length: float = 0.0
    coverage: float = 0.9  # Share of the tunnel that counts as success.
    speed: float | None = None  # Largest commanded speed, m/s; that of the robot if not given.
    out: Path | None = None  # JSON file for the figures.


def show_progress(now: transfer.Walk) -> None:
    """Prints station, falls and contacts of the robots on one line."""
    falls, contacts = int(np.sum(now.fall)), int(np.sum(now.contact))
    counts = f"{int(np.sum(now.over))} of {len(now.over)} over, {falls} falls, {contacts} contacts"
    print(f"\rstation {np.median(now.state.station):6.1f} m, {counts}", end="", file=sys.stderr, flush=True)


def _check(arguments: Command) -> None:
    require_least(arguments, robots=1, seed=0)
    if not 0.0 < arguments.coverage <= 1.0:
        raise ValueError(f"coverage must be above 0 and at most 1, got {arguments.coverage}")
    if arguments.speed is not None and not 0.0 < arguments.speed < math.inf:
        raise ValueError(f"speed must be above 0, got {arguments.speed}")
    if not 0.0 <= arguments.length < math.inf:
        raise ValueError(f"length must not be negative, got {arguments.length}")
    if arguments.scene is not None and arguments.tunnel is not None:
        raise ValueError(f"either a tunnel or a scene, got both {arguments.tunnel} and {arguments.scene}")
    if arguments.out is not None:
        require_file(arguments.out)


def command(arguments: Command) -> None:
    """Drives the robots and prints the figures.

    Raises:
        ValueError: A number is out of range.
        SubterraError: Scene, tunnel, agent or gait is missing or wrong, or the output cannot be written.
    """
    _check(arguments)
    tunnel: Any = arguments.tunnel
    if arguments.length:
        plan = load_tunnel(arguments.tunnel)
        tunnel = plan.slice(0.0, min(arguments.length, plan.length))
    usual = tasks.VEHICLE if arguments.robot == "b2" else VehicleParams()
    options: dict[str, Any] = {
        "tunnel": tunnel,
        "scene": arguments.scene,
        "engine": arguments.engine,
        "goal_coverage": arguments.coverage,
        "vehicle": usual if arguments.speed is None else replace(usual, speed_max=arguments.speed),
    }
    if arguments.robot == "b2":
        env, params = tasks.make_mission(policy=arguments.policy, **options)
    else:
        env, params = st.make("Subterra/Traverse-v1", motion="rover", horizon=_HORIZON, **options)
    agent, started = open_agent(arguments.agent, env, params), time.perf_counter()
    walks = transfer.walk_robots(env, params, agent, arguments.robots, arguments.seed, show_progress)
    figures = transfer.figures(*walks, params)
    print(file=sys.stderr)
    figures["wall_seconds"] = time.perf_counter() - started
    print_table(f"{arguments.robots} of {arguments.robot}, {arguments.engine}, {arguments.agent}", figures)
    if arguments.out is not None:
        arguments.out.write_text(json.dumps({**vars(arguments), **figures}, default=str, indent=1) + "\n")


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    return run_main("b2_traverse", Command, command, words=words)


if __name__ == "__main__":
    sys.exit(main())
