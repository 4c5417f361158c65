"""How many B2s come through a tunnel on their legs: `python -m benchmarks.b2_traverse --robots 100`.

Every robot is drawn anew: friction, mass, gains, sensor noise. `--engine mujoco` has the same robots walk in MuJoCo's
own engine, on the host; with `--scene DIR` in the scene itself.
"""

import json
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from benchmarks.command import status
from scene.arguments import parse
from subterra_jax import policies
from subterra_jax.b2 import missions, trial
from subterra_jax.b2.policy import RELEASED
from subterra_jax.baselines import registry
from subterra_jax.outputs import require_file
from subterra_jax.tunnel.sources import load_tunnel
from train import cli
from train.evaluate import open_agent


@dataclass(frozen=True)
class Command:
    """Lets B2s traverse a tunnel.

    Example: python -m benchmarks.b2_traverse --robots 100 --agent B2Traverse-v0 --engine mujoco

    Attributes:
        robots: How many.
        seed: Of their draws.
        agent: Who steers: a baseline, a run folder of `train.navigate --embodiment b2`, or a policy's file or name.
        policy: The gait: a file, the name of a released one, or `trot`.
        engine: `mjx`, or `mujoco` in C on the host.
        tunnel: File or name; the packaged tunnel if left out.
        scene: A built scene folder, instead of a tunnel.
        length: Only so many metres of the tunnel; 0 is all of it. A policy that was trained on all of it has never been
            near a far mouth; to try it for a while only, lower `coverage`.
        coverage: Share of the tunnel that counts as success.
        odometer: `legs`, the robot's own, or `drift`.
        speed: Largest speed that may be commanded, m/s.
        out: File to which the figures are written as JSON.
    """

    robots: int = 100
    seed: int = 0
    agent: str = "dead-reckoning"
    policy: str = RELEASED
    engine: Literal["mjx", "mujoco"] = "mjx"
    tunnel: str | None = None
    scene: Path | None = None
    length: float = 0.0
    coverage: float = 0.9
    odometer: Literal["legs", "drift"] = "legs"
    speed: float = missions.VEHICLE.speed_max
    out: Path | None = None


def opened(name: str, env: Any, params: Any) -> Any:
    """An agent by its name, file or run folder, known to fit."""
    if name in registry.names():
        return registry.make_agent(name, params)
    agent, _ = open_agent(Path(name), None)
    policies.check_fits(agent, env, params, name)
    return agent


def tell(now: trial.Walk) -> None:
    """How the robots are, on one line."""
    falls, contacts = int(np.sum(now.fall)), int(np.sum(now.contact))
    counts = f"{int(np.sum(now.over))} of {len(now.over)} over, {falls} falls, {contacts} contacts"
    print(f"\rstation {np.median(now.state.station):6.1f} m, {counts}", end="", file=sys.stderr, flush=True)


def _check(arguments: Command) -> None:
    for name, least in (("robots", 1), ("seed", 0)):
        if getattr(arguments, name) < least:
            raise ValueError(f"{name} must be at least {least}, got {getattr(arguments, name)}")
    for name, most in (("coverage", 1.0), ("speed", math.inf)):
        value = getattr(arguments, name)
        if not 0.0 < value <= most or math.isinf(value):
            raise ValueError(
                f"{name} must be above 0{'' if math.isinf(most) else f' and at most {most:g}'}, got {value}"
            )
    if not 0.0 <= arguments.length < math.inf:
        raise ValueError(f"length must not be negative, got {arguments.length}")
    if arguments.scene is not None and arguments.tunnel is not None:
        raise ValueError(f"either a tunnel or a scene, got both {arguments.tunnel} and {arguments.scene}")
    if arguments.out is not None:
        require_file(arguments.out)


def command(arguments: Command) -> None:
    """Drives and prints.

    Raises:
        ValueError: A number is out of range.
        SubterraError: Scene, tunnel, agent or gait is missing or wrong, or the output cannot be written.
    """
    _check(arguments)
    tunnel: Any = arguments.tunnel
    if arguments.length:
        plan = load_tunnel(arguments.tunnel)
        tunnel = plan.slice(0.0, min(arguments.length, plan.length))
    env, params = missions.make(
        tunnel=tunnel,
        scene=arguments.scene,
        policy=arguments.policy,
        engine=arguments.engine,
        odometer=arguments.odometer,
        goal_coverage=arguments.coverage,
        vehicle=missions.VEHICLE.replace(speed_max=arguments.speed),  # type: ignore[attr-defined]
    )
    agent, started = opened(arguments.agent, env, params), time.perf_counter()
    found = trial.figures(*trial.drive(env, params, agent, arguments.robots, arguments.seed, tell), params)
    print(file=sys.stderr)
    found["wall_seconds"] = time.perf_counter() - started
    cli.table(f"{arguments.robots} B2s, {arguments.engine}, gait {arguments.policy}, {arguments.agent}", found)
    if arguments.out is not None:
        arguments.out.write_text(json.dumps({**vars(arguments), **found}, default=str, indent=1) + "\n")


def _read(words: list[str]) -> Command:
    return tyro.cli(Command, args=words, prog="python -m benchmarks.b2_traverse")


def main() -> None:
    """Entry point of `python -m benchmarks.b2_traverse`."""
    arguments = parse(_read)
    sys.exit(status(lambda: command(arguments)))


if __name__ == "__main__":
    main()
