"""How true a reconstruction is, on simulated surveys of seeds that the builder was not developed on.

`python -m benchmarks.reconstruction --seeds 201 202 --out out/reconstruction`
"""

import json
import os
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.command import status
from benchmarks.features import pocket_figures, sleeper_figures
from benchmarks.fidelity.candidate import load
from benchmarks.fidelity.derive import surface
from benchmarks.fidelity.references import HoldConfig, load_hold
from benchmarks.truth import compare, load_truth
from scene.arguments import parse
from scene.survey.config import SurveyConfig, TruthName, check_survey
from subterra_jax.outputs import require_folder


@dataclass(frozen=True)
class ReconstructionConfig:
    """Survey → build → truth, for every seed and both ways to have poses.

    The builder reads the Avia; the OS1 on the same rack is held out.

    Attributes:
        seeds: Of the surveys.
        length: Of each bore, m.
        truth: Kind of bore; see `python -m scene.survey --help`.
        poses: `given` true poses; `control` odometry, IMU and prism.
        out: Folder to write; surveys that are there already are not simulated again.
    """

    seeds: tuple[int, ...] = (201, 202)
    length: float = 60.0
    truth: str = "paper"
    poses: tuple[Literal["given", "control"], ...] = ("given", "control")
    out: Path = Path("out/reconstruction")


@dataclass(frozen=True)
class Goal:
    """What is asked of a figure: at most, or at least, with true poses and with control; `scale` is for printing."""

    given: float
    control: float
    at_least: bool = False
    scale: float = 100.0
    unit: str = "cm"


GOALS = {
    "length_error": Goal(0.1, 0.2, unit="%", scale=1.0),
    "lateral_rmse": Goal(0.02, 0.05),
    "width_rmse": Goal(0.02, 0.04),
    "height_rmse": Goal(0.02, 0.04),
    "hold_mean": Goal(0.0246, 0.03),
    "hold_within_10cm": Goal(0.975, 0.96, at_least=True, scale=100.0, unit="%"),
    "pocket_f1": Goal(0.90, 0.80, at_least=True, scale=1.0, unit=""),
    "pocket_depth_error": Goal(0.015, 0.02),
    "sleeper_f1": Goal(0.97, 0.95, at_least=True, scale=1.0, unit=""),
    "gauge_error": Goal(0.003, 0.005, scale=1000.0, unit="mm"),
    "seconds": Goal(300.0, 900.0, scale=1.0, unit="s"),
    "memory": Goal(4.0, 4.0, scale=1.0, unit="GiB"),
}


def met(name: str, value: float, poses: str) -> bool:
    """Whether a figure meets its goal; signed errors count by their size, a figure that is no number does not."""
    goal = GOALS[name]
    limit = goal.given if poses == "given" else goal.control
    return value >= limit if goal.at_least else abs(value) <= limit


def simulate(config: ReconstructionConfig, seed: int) -> Path:
    """The survey of one seed, with the OS1 beside the Avia."""
    folder = config.out / f"survey-{config.truth}-{config.length:g}-{seed}"
    if not (folder / "truth.json").exists():
        words = ["--truth", config.truth, "--length", config.length, "--seed", seed, "--out", folder]
        _run("scene.survey", *words, "--sensors", "avia", "os1", "--scan-every", 20)
    return folder


def build(survey: Path, out: Path, poses: str) -> dict[str, float]:
    """Builds the scene as a user would; wall-clock time, s, and peak memory, GiB."""
    given = ("--trajectory", survey / "groundtruth.tum")
    control = ("--control", survey / "prism.tum", "--calibration", "geode-gamma")
    started = time.monotonic()
    words = (*(given if poses == "given" else control), "--provenance", "simulated", "--out", out, "--fresh")
    memory = _run("scene.build", survey / "survey.bag", *words)
    return {"seconds": time.monotonic() - started, "memory": memory}


def figures(scene: Path, survey: Path) -> dict[str, float]:
    """All figures of one scene but those of `build`; nothing is aligned, fitted or scaled first."""
    truth = load_truth(survey / "truth.json")
    compared = compare(scene, truth)
    candidate = load(scene)
    trajectory = survey / "groundtruth_os1.tum"
    hold = load_hold(survey / "survey_os1.bag", trajectory, candidate.origin, HoldConfig(beams_per_scan=2000))
    distance, _, _ = surface.Nearest(surface.visible(candidate)).query(hold.points)
    return {
        "length_error": 100.0 * compared.length_error / (truth.station[-1] - truth.station[0]),
        "lateral_rmse": float(np.sqrt(np.mean(compared.lateral**2))),
        "width_rmse": float(np.sqrt(np.mean(compared.width**2))),
        "height_rmse": float(np.sqrt(np.mean(compared.height**2))),
        "hold_mean": float(distance.mean()),
        "hold_within_10cm": float(np.mean(distance < 0.10)),
        **pocket_figures(scene, survey),
        **sleeper_figures(scene, survey),
    }


def measure(config: ReconstructionConfig) -> list[dict[str, Any]]:
    """One row a survey and way to have poses."""
    rows = []
    for seed in config.seeds:
        survey = simulate(config, seed)
        for poses in config.poses:
            scene = config.out / f"scene-{config.truth}-{config.length:g}-{seed}-{poses}"
            cost = build(survey, scene, poses)
            rows.append({"seed": seed, "poses": poses, **figures(scene, survey), **cost})
    return rows


def show(rows: list[dict[str, Any]], console: Console) -> None:
    """A table of the figures beside what is asked of them; what misses its goal is marked."""
    table = Table(title="simulated surveys, held out from development")
    for heading in ("figure", *(f"seed {row['seed']}, {row['poses']}" for row in rows), "asked: given", "control"):
        table.add_column(heading, justify="right")
    for name, goal in GOALS.items():
        cells = [
            f"{row[name] * goal.scale:.3g}" + ("" if met(name, row[name], row["poses"]) else " [red]missed[/red]")
            for row in rows
        ]
        sign = "≥" if goal.at_least else "≤"
        limits = (f"{sign} {limit * goal.scale:g}" for limit in (goal.given, goal.control))
        table.add_row(f"{name} {goal.unit}".strip(), *cells, *limits)
    console.print(table)


def _run(module: str, *arguments: object) -> float:
    """Runs `python -m module …`; returns its peak memory, GiB."""
    words = [sys.executable, "-m", module, *(str(argument) for argument in arguments)]
    print(f"$ python -m {' '.join(words[2:])}", flush=True)
    process = subprocess.Popen(words)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        sys.exit(os.waitstatus_to_exitcode(status))
    return usage.ru_maxrss / 2**20


def main() -> None:
    """The command."""
    config = parse(
        lambda words: tyro.cli(
            ReconstructionConfig, args=words, prog="python -m benchmarks.reconstruction", description=__doc__
        )
    )
    sys.exit(status(lambda: run(config)))


def check(config: ReconstructionConfig) -> None:
    """Refuses what cannot be simulated or written.

    Raises:
        ValueError: Nothing is asked for, or a number is out of range.
        SubterraError: The folder cannot be written.
    """
    for name in ("seeds", "poses"):
        if not getattr(config, name):
            raise ValueError(f"{name} must name at least one")
    if config.truth not in get_args(TruthName):
        raise ValueError(f"no bore {config.truth!r}; there are {', '.join(get_args(TruthName))}")
    for seed in config.seeds:
        check_survey(SurveyConfig(config.out, truth=cast(TruthName, config.truth), length=config.length, seed=seed))
    require_folder(config.out)


def run(config: ReconstructionConfig) -> None:
    """Measures, prints, writes."""
    check(config)
    config.out.mkdir(parents=True, exist_ok=True)
    rows = measure(config)
    show(rows, Console())
    facts = {"config": asdict(config) | {"out": str(config.out)}, "provenance": "simulated", "rows": rows}
    name = f"figures-{config.truth}-{config.length:g}.json"
    (config.out / name).write_text(json.dumps(facts, indent=1) + "\n")


if __name__ == "__main__":
    main()
