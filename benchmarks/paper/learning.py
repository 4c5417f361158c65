"""Figure 4: coverage and success of the last hundred episodes against finished episodes, over seeds."""

import json
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float

from benchmarks.command import BenchmarkError
from benchmarks.fidelity.figures.sheet import BLUE, INK, ORANGE
from benchmarks.paper.sheet import COLUMN, Drawing
from train.curve import GOAL, read_episodes, rolling
from train.snapshot import WINDOW

_COLOURS = {"coverage": BLUE, "success": ORANGE}
_MOST_POINTS = 1500  # points of a line: more than its dots in print


def find_runs(folder: Path) -> list[Path]:
    """Returns the run folders `seed-*` of a folder in the order of their number.

    Raises:
        BenchmarkError: The folder has no run folder.
    """
    runs = [path for path in folder.glob("seed-*") if path.name[5:].isdigit() and (path / "config.json").exists()]
    if not runs:
        raise BenchmarkError(f"{folder}: holds no run folders seed-0, seed-1, ... of train")
    return sorted(runs, key=lambda path: int(path.name[5:]))


def common_task(runs: list[Path]) -> str:
    """Returns the task of all runs.

    Raises:
        BenchmarkError: The runs have several tasks, or one whose curve is not coverage.
    """
    tasks = [str(read_config(run).get("task")) for run in runs]
    for run, task in zip(runs, tasks, strict=True):
        if task != tasks[0]:
            raise BenchmarkError(f"{run}: is a run of {task}, but {runs[0].name} of {tasks[0]}")
    if "Traverse" not in tasks[0]:
        raise BenchmarkError(f"{runs[0].parent}: its runs are of {tasks[0]}; the figure shows coverage, that is T0")
    return tasks[0]


def provenance(runs: list[Path]) -> str:
    """Returns one line with task, tunnel, number of seeds and device."""
    first = read_config(runs[0])
    tunnel = f"{first.get('tunnel')} ({first.get('tunnel_provenance', 'no')} survey)"
    device = str(first.get("device")).rpartition(": ")[2]
    return f"train, {first.get('task')} in {tunnel}, {len(runs)} seeds, on {device}."


def read_config(run: Path) -> dict[str, Any]:
    """Reads a run's `config.json`.

    Raises:
        BenchmarkError: The file cannot be read.
    """
    try:
        return dict(json.loads((run / "config.json").read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise BenchmarkError(f"{run / 'config.json'}: cannot be read ({error})") from error


def draw(runs: list[Path]) -> Drawing:
    """Draws a thin line for each seed, their mean, and one standard deviation around it.

    Raises:
        BenchmarkError: The runs have several tasks, the task is not T0, or no episode finished.
        RunFolderError: A run cannot be read.
    """
    facts: dict[str, Any] = {"task": common_task(runs), "runs": [run.name for run in runs]}
    episodes = [read_episodes(run) for run in runs]
    shortest = min(len(one["episode"]) for one in episodes)
    if not shortest:
        raise BenchmarkError(f"{runs[0].parent}: one of its runs finished no episode")
    figure, panels = plt.subplots(2, 1, figsize=(COLUMN, 3.3), sharex=True, layout="constrained")
    columns: dict[str, np.ndarray] = {"episode": np.arange(1, shortest + 1)}
    for axes, name in zip(panels, _COLOURS, strict=True):
        table = np.stack([rolling(one[name])[:shortest] for one in episodes])
        mean, spread = table.mean(axis=0), table.std(axis=0, ddof=min(1, len(table) - 1))
        columns |= {f"{name}_{run.name}": row for run, row in zip(runs, table, strict=True)}
        columns |= {f"{name}_mean": mean, f"{name}_sd": spread}
        _panel(axes, name, 100.0 * table, 100.0 * mean, 100.0 * spread)
        facts[f"{name}_last"] = {"mean": float(mean[-1]), "sd": float(spread[-1])}
    panels[1].set_xlabel("finished episodes")
    facts["first_at_goal"] = _first_at_goal(columns["coverage_mean"])
    return Drawing(figure, _caption(facts, len(runs), shortest), columns, facts)


def _panel(axes: Any, name: str, table: Float[np.ndarray, "s n"], mean: np.ndarray, spread: np.ndarray) -> None:
    n = table.shape[1]
    shown = np.unique(np.linspace(0, n - 1, min(n, _MOST_POINTS)).round().astype(int))
    episode, colour = shown + 1, _COLOURS[name]
    for k, row in enumerate(table):
        axes.plot(episode, row[shown], color="0.6", lw=0.5, label=None if k else "one seed", zorder=2)
    low, high = np.clip(mean - spread, 0.0, 100.0), np.clip(mean + spread, 0.0, 100.0)
    axes.fill_between(episode, low[shown], high[shown], color=colour, alpha=0.3, lw=0.0, label="± sd", zorder=1)
    axes.plot(episode, mean[shown], color=colour, lw=1.4, label="mean", zorder=3)
    if name == "coverage":
        axes.axhline(100.0 * GOAL, color=INK, lw=0.8, ls="--", label=f"{100 * GOAL:.0f} % goal", zorder=4)
    axes.set(ylabel=f"{name}, %\n(mean of the last {WINDOW})", ylim=(-3.0, 104.0), xlim=(0, n))
    axes.set_yticks((0, 25, 50, 75, 100))
    axes.grid(alpha=0.25, lw=0.4)
    # Above the axes: where there is room inside depends on how soon the curves rise.
    axes.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, frameon=False, handlelength=1.2, columnspacing=1.0
    )


def _first_at_goal(mean: Float[np.ndarray, " n"]) -> int | None:
    """Returns the first full hundred whose mean coverage over seeds reaches the goal."""
    there = np.flatnonzero(mean[WINDOW - 1 :] >= GOAL)
    return int(there[0]) + WINDOW if len(there) else None


def _caption(facts: dict[str, Any], n_runs: int, shortest: int) -> str:
    last = {name: facts[f"{name}_last"] for name in _COLOURS}
    results = ", ".join(f"{name} {100 * one['mean']:.2f} ± {100 * one['sd']:.2f} %" for name, one in last.items())
    reached = facts["first_at_goal"]
    when = (
        f"Mean coverage reaches {100 * GOAL:.0f} % after {reached} episodes" if reached else "The goal is not reached"
    )
    return (
        f"Learning curves of PPO on {facts['task']}: coverage and success of the last {WINDOW} episodes, mean ± "
        f"standard deviation over {n_runs} seeds. {when}; after {shortest}: {results}."
    )
