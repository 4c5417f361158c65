"""Our PPO beside that of Stable-Baselines3: `python -m benchmarks.learning --out out/learning`."""

import dataclasses
import sys
from pathlib import Path
from typing import Literal

import tyro

from benchmarks.command import status
from benchmarks.learning import ours, report
from benchmarks.throughput.facts import environment_facts, version
from scene.arguments import parse
from subterra_jax.outputs import require_folder
from train import policies
from train.errors import ConfigError


@dataclasses.dataclass(frozen=True)
class Command:
    """Trains both on one task until the last hundred episodes cover 90 % and all succeed; about ten minutes on 2 cores.

    Attributes:
        out: Folder for learning.json and learning.png.
        task: A task whose success is coverage.
        tunnel: Tunnel file or name; the packaged tunnel if left out.
        steps: Environment steps, at most, of Stable-Baselines3.
        our_steps: Of ours.
        preset: Of ours, `cpu` or `gpu`.
        seed: Of both.
    """

    out: Path
    task: str = "Subterra/TraverseShort-v0"
    tunnel: str | None = None
    steps: int = 1_000_000
    our_steps: int = 1_500_000
    preset: Literal["cpu", "gpu"] = "cpu"
    seed: int = 0


def run(command: Command) -> None:
    """Trains, prints and writes.

    Raises:
        ConfigError: The task or a number makes no sense, or stable-baselines3 is not installed.
    """
    policies.known_task(command.task)
    if "Traverse" not in command.task:
        raise ConfigError(f"task {command.task} is not one of coverage")
    for name, least in (("steps", 1), ("our_steps", 1), ("seed", 0)):
        if getattr(command, name) < least:
            raise ConfigError(f"{name} must be at least {least}, got {getattr(command, name)}")
    policies.open_world(command.task, command.tunnel)
    require_folder(command.out)
    try:
        from benchmarks.learning import stable_baselines
    except ImportError as missing:
        raise ConfigError("stable-baselines3 is not installed: pip install 'subterra-jax[sb3]'") from missing
    curves = [
        ours.train(command.task, command.our_steps, command.seed, command.preset, command.tunnel),
        stable_baselines.train(command.task, command.steps, command.seed, command.tunnel),
    ]
    told = {"task": command.task, "seed": command.seed, "stable-baselines3": version("stable-baselines3")}
    report.write(command.out, curves, {**told, "torch": version("torch"), **environment_facts()})


def main() -> int:
    """Entry point; the status is 2 for a user's mistake."""
    command = parse(
        lambda words: tyro.cli(Command, args=words, prog="python -m benchmarks.learning", description=__doc__)
    )
    return status(lambda: run(command))


if __name__ == "__main__":
    sys.exit(main())
