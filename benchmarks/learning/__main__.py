"""Our PPO beside that of Stable-Baselines3: `python -m benchmarks.learning --out out/learning`."""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any, Literal

import matplotlib.pyplot as plt
import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.command import require_least, run_main
from benchmarks.learning.runs import Curve, require_stable_baselines, train_ours, train_stable_baselines
from benchmarks.results import environment_facts, png_bytes, version, write_file
from subterra_jax.host.files import require_folder
from train.config import ConfigError
from train.curve import GOAL, rolling
from train.snapshot import WINDOW
from train.world import open_world, require_task

_HEADINGS = ("", "episodes", "steps", "s", "compiled in", "steps/s")


@dataclasses.dataclass(frozen=True)
class Command:
    """Trains both on one task until the last hundred episodes cover 90 % and all succeed; about ten minutes on 2 cores.

    Attributes:
        out: Folder for learning.json and learning.png.
        task: Task whose success is coverage.
        tunnel: Tunnel file or name; the packaged tunnel if not given.
        steps: Largest number of environment steps of Stable-Baselines3.
        our_steps: Largest number of environment steps of ours.
        preset: Preset of ours, `cpu` or `gpu`.
        seed: Seed for both.
    """

    out: Path
    task: str = "Subterra/TraverseShort-v1"
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
    require_task(command.task)
    if "Traverse" not in command.task:
        raise ConfigError(f"task {command.task} is not one of coverage")
    require_least(command, steps=1, our_steps=1, seed=0)
    open_world(command.task, command.tunnel)
    require_folder(command.out)
    require_stable_baselines()
    curves = [
        train_ours(command.task, command.our_steps, command.seed, command.preset, command.tunnel),
        train_stable_baselines(command.task, command.steps, command.seed, command.tunnel),
    ]
    facts = {"task": command.task, "seed": command.seed, "stable-baselines3": version("stable-baselines3")}
    report(command.out, curves, {**facts, "torch": version("torch"), **environment_facts()})


def report(out: Path, curves: list[Curve], facts: dict[str, Any]) -> None:
    """Prints the table; writes `learning.json` and `learning.png`."""
    table = Table(title=f"{facts['task']}: to {100 * GOAL:.0f} % coverage and 100 % success of the last {WINDOW}")
    for heading in _HEADINGS:
        table.add_column(heading, justify="right", no_wrap=True)
    for curve in curves:
        goal = curve.reached()
        when = [f"{goal['episodes']:,}", f"{goal['steps']:,}", f"{goal['seconds']:.1f}"] if goal else ["never"] * 3
        table.add_row(curve.name, *when, f"{curve.compiling:.1f} s", f"{curve.rate():,.0f}")
    Console().print(table)
    out.mkdir(parents=True, exist_ok=True)
    rows = [
        {
            "name": curve.name,
            "reached": curve.reached(),
            "compiling": curve.compiling,
            "steps_per_second": curve.rate(),
            "episode": {
                "step": curve.step.tolist(),
                "seconds": np.round(curve.seconds, 3).tolist(),
                "coverage": np.round(curve.coverage, 6).tolist(),
                "success": curve.success.astype(int).tolist(),
            },
        }
        for curve in curves
    ]
    content = {"schema": "subterra.learning/1", **facts, "runs": rows}
    write_file(out / "learning.json", json.dumps(content).encode() + b"\n")
    write_file(out / "learning.png", _draw(curves))


def _draw(curves: list[Curve]) -> bytes:
    """Returns coverage against steps and against seconds as a PNG file."""
    figure, panels = plt.subplots(1, 2, figsize=(10.0, 4.0), sharey=True, layout="constrained")
    for axes, x, label in ((panels[0], "step", "environment steps"), (panels[1], "seconds", "s, without compiling")):
        for curve in curves:
            axes.plot(np.maximum(getattr(curve, x), 1e-2), 100.0 * rolling(curve.coverage), label=curve.name)
        axes.axhline(100.0 * GOAL, ls="--", lw=1.0, color="0.3")
        axes.set(xlabel=label, xscale="log", ylim=(0.0, 100.0))
        axes.grid(alpha=0.3)
    panels[0].set_ylabel(f"coverage, %, mean of the last {WINDOW}")
    panels[0].legend(loc="center left", fontsize=8)
    return png_bytes(figure, dpi=120)


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    return run_main("learning", Command, run, description=__doc__, words=words)


if __name__ == "__main__":
    sys.exit(main())
