"""The coverage curve of one or several runs: `python -m train.curve RUN [RUN ...] --out curve.png`."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import tyro

from train import cli
from train.episodes import WINDOW
from train.errors import RunFolderError
from train.log import EPISODES

GOAL = 0.9
_COLUMNS = "episode,step,coverage_mean_100,success_mean_100"


def read_episodes(run: Path) -> np.ndarray:
    """`episodes.csv` of a run folder, one row per finished episode.

    Raises:
        RunFolderError: There is none, or it cannot be read.
    """
    try:
        return np.atleast_1d(np.genfromtxt(run / EPISODES, delimiter=",", names=True, dtype=np.float64))
    except (OSError, ValueError) as error:
        raise RunFolderError(f"{run}: no readable {EPISODES} in it") from error


def rolling(values: np.ndarray, window: int = WINDOW) -> np.ndarray:
    """Mean of each value and those before it, at most `window` of them in all."""
    total = np.concatenate([[0.0], np.cumsum(values, dtype=np.float64)])
    end = np.arange(1, len(values) + 1)
    begin = np.maximum(end - window, 0)
    return (total[end] - total[begin]) / (end - begin)


def write_curve(runs: list[Path], png: Path) -> None:
    """Draws the rolling-100 `measure` against episodes and steps, and writes the numbers of each run beside it.

    Args:
        runs: Run folders; each gets a `curve.csv` of its own.
        png: Where the figure goes.
    """
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (by_episode, by_step) = pyplot.subplots(1, 2, figsize=(10.0, 4.0), sharey=True, layout="constrained")
    for run in runs:  # unreadable folders are refused before anything is drawn
        read_episodes(run)
    shown = measure(runs[0])
    for run in runs:
        rows = read_episodes(run)
        coverage, success = rolling(rows["coverage"]), rolling(rows["success"])
        curves = {"coverage": coverage, "success": success}
        table = np.column_stack([rows["episode"], rows["step"], coverage, success])
        fresh = run / ".curve.csv.partial"
        np.savetxt(fresh, table, fmt=["%d", "%d", "%.9g", "%.9g"], delimiter=",", header=_COLUMNS, comments="")
        fresh.replace(run / "curve.csv")
        (line,) = by_episode.plot(rows["episode"], 100.0 * curves[shown], label=run.resolve().name, zorder=3)
        by_step.plot(rows["step"] / 1e6, 100.0 * curves[shown], color=line.get_color(), zorder=3)
        if len(runs) == 1:
            by_episode.plot(
                rows["episode"], 100.0 * rows[shown], ".", ms=2, alpha=0.25, color="0.5", label="single episodes"
            )
    if len(runs) > 1:
        _draw_band(by_episode, [rolling(read_episodes(run)[shown]) for run in runs])
    for axes, label in ((by_episode, "finished episodes"), (by_step, "environment steps, millions")):
        axes.axhline(100.0 * GOAL, ls="--", lw=1.0, color="0.3", zorder=2, label=f"{100.0 * GOAL:.0f} % goal")
        axes.set(xlabel=label, ylim=(0.0, 100.0))
        axes.set_xlim(left=0.0)
        axes.grid(alpha=0.3)
    by_episode.set_ylabel(f"{shown}, %, mean of the last {WINDOW}")
    by_episode.legend(loc="lower right")
    fresh = png.with_name(f".{png.name}.partial")
    figure.savefig(fresh, dpi=120, format="png")
    fresh.replace(png)
    pyplot.close(figure)


def measure(run: Path) -> str:
    """What says how far a run has come: `coverage` where that is the task, else `success`."""
    try:
        task = json.loads((run / "config.json").read_text())["task"]
    except (OSError, ValueError, KeyError) as error:
        raise RunFolderError(f"{run}: no readable config.json in it") from error
    return "coverage" if "Traverse" in task else "success"


def _draw_band(axes: Any, curves: list[np.ndarray]) -> None:
    """Mean ± standard deviation of several runs, as far as all of them go."""
    shortest = min(len(curve) for curve in curves)
    if shortest == 0:
        return
    table = 100.0 * np.stack([curve[:shortest] for curve in curves])
    mean, spread, episode = table.mean(axis=0), table.std(axis=0, ddof=1), np.arange(1, shortest + 1)
    axes.plot(episode, mean, color="black", lw=1.5, label="mean ± sd", zorder=4)
    axes.fill_between(episode, mean - spread, mean + spread, color="black", alpha=0.2, lw=0.0, zorder=3)


@dataclasses.dataclass(frozen=True)
class Command:
    """Draws the coverage curve of one or several runs.

    Attributes:
        runs: Run folders.
        out: The figure.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    out: Path = Path("curve.png")


def command(arguments: Command) -> None:
    """Draws."""
    if not arguments.runs:
        raise RunFolderError("no run folder was named")
    write_curve(list(arguments.runs), arguments.out)


def main() -> None:
    """Entry point of `python -m train.curve`."""
    cli.run(lambda: command(tyro.cli(Command)))


if __name__ == "__main__":
    main()
