"""Times one trainer until 90 % of fresh episodes succeed: `python -m train.others sb3_ppo --out out/sb3.json`."""

import dataclasses
import importlib
import json
import os
import sys
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import tyro

from subterra_jax.host.command import parse, run_command
from subterra_jax.host.files import replace_file
from train.config import ConfigError
from train.others.watch import FIRST_FRESH, GOAL, N_FRESH, Score, Watch
from train.world import library_versions, require_task

Trainer = Literal["ours", "brax_ppo", "sb3_ppo", "cleanrl_like", "purejaxrl_like", "rejax_ppo"]
_PACKAGES = ("stable_baselines3", "torch", "gymnasium", "rejax", "gymnax")


@dataclasses.dataclass(frozen=True)
class Command:
    """Trains with one library until 90 % of 100 fresh episodes succeed, then drives the listed episodes once.

    Attributes:
        trainer: File of `train/others`.
        out: JSON file to write.
        task: Task id.
        steps: Largest number of environment steps.
        seed: Seed of the training.
        episodes: Listed episodes to drive at the end.
    """

    trainer: Annotated[Trainer, tyro.conf.Positional]
    out: Path
    task: str = "Subterra/TraverseShort-v1"
    steps: int = 2_000_000
    seed: int = 0
    episodes: int = 500


def command(arguments: Command) -> None:
    """Trains, prints a line for each score, and writes the file."""
    task = require_task(arguments.task)
    if arguments.steps < 1 or arguments.seed < 0:
        raise ConfigError(f"steps must be at least 1 and seed at least 0, got {arguments.steps} and {arguments.seed}")
    try:
        trainer = importlib.import_module(f"train.others.{arguments.trainer}")
    except ModuleNotFoundError as missing:
        raise ConfigError(
            f"{arguments.trainer} needs {missing.name}, which is not installed; "
            f"the head of train/others/{arguments.trainer}.py says how"
        ) from missing
    load = os.getloadavg()[0]
    watch = Watch(task, report=_print)
    trainer.train(watch, arguments.steps, arguments.seed)
    reached = watch.reached
    content: dict[str, Any] = {
        "schema": "subterra.others/1",
        "trainer": arguments.trainer,
        "task": task,
        "seed": arguments.seed,
        "goal": {"success": GOAL, "episodes": N_FRESH, "first_seed": FIRST_FRESH},
        "reached": None if reached is None else dataclasses.asdict(reached),
        "scores": [dataclasses.asdict(score) for score in watch.scores],
        "listed": watch.listed(arguments.episodes),
        "load": [load, os.getloadavg()[0]],
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "device": jax.devices()[0].device_kind,
        "versions": {**library_versions(), **_versions()},
    }
    with replace_file(arguments.out) as fresh:
        fresh.write_text(json.dumps(content, indent=1) + "\n")
    when = "never" if reached is None else f"{reached.steps:,} steps, {reached.seconds / 60.0:.2f} min"
    share = f"{100.0 * content['listed']['success']:.1f} % of {arguments.episodes} listed"
    print(f"{arguments.trainer}: {100 * GOAL:.0f} % after {when}; {share}")


def _print(score: Score) -> None:
    times = f"{score.seconds:7.1f} s {score.cpu_seconds:7.1f} CPU s"
    print(f"{score.steps:>9,} steps {times} {100.0 * score.success:5.1f} %", flush=True)


def _versions() -> dict[str, str]:
    installed = {package.metadata["Name"]: package.version for package in metadata.distributions()}
    return {name: installed[name] for name in _PACKAGES if name in installed}


def main() -> None:
    """Runs `python -m train.others`."""
    sys.exit(run_command(lambda: command(parse(_read))))


def _read(words: list[str]) -> Command:
    return tyro.cli(Command, args=words, prog="python -m train.others", description=__doc__)


if __name__ == "__main__":
    main()
