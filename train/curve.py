"""The learning curve of one or several runs: `python -m train.curve RUN [RUN ...] --out curve.png`.

Of the paper's task the rolling hundred's coverage and success against finished episodes, as in its Fig. 4; of the tasks
that end at a goal, success against steps and against seconds.
"""

import dataclasses
import json
import sys
from collections.abc import Mapping
from itertools import cycle
from pathlib import Path
from types import MappingProxyType
from typing import Any

import matplotlib
import numpy as np
import tyro

from subterra_jax.host.command import parse, run_command
from subterra_jax.host.files import replace_file, require_file
from train.folder import RunFolderError
from train.log import EPISODES, read_log
from train.snapshot import WINDOW

GOAL = 0.9
_COLUMNS = "episode,step,coverage_mean_100,success_mean_100"
_EPISODE, _STEP, _SECOND = "finished episodes", "environment steps, millions", "seconds, with compiling"
_AGAINST = {_EPISODE: ("episode", 1.0), _STEP: ("step", 1e6), _SECOND: ("second", 1.0)}
_POINTS = 4000  # of one line in the figure
_SMOOTH = 1000  # episodes that a success is averaged over in the figure: a hundred of them scatter by 4 %
Curve = dict[str, np.ndarray]


def read_episodes(run: Path) -> Curve:
    """Reads the columns of a run folder's `episodes.csv`, one row per finished episode.

    Raises:
        RunFolderError: There is none, or it cannot be read.
    """
    try:
        heading, *lines = (run / EPISODES).read_text().splitlines()
        names = heading.split(",")
        rows = np.loadtxt(lines, delimiter=",", ndmin=2) if lines else np.zeros((0, len(names)))
        return dict(zip(names, rows.T, strict=True))
    except (OSError, ValueError) as error:
        raise RunFolderError(f"{run}: no readable {EPISODES} in it") from error


def rolling(values: np.ndarray, window: int = WINDOW) -> np.ndarray:
    """Averages each value and those before it, at most `window` of them in all."""
    total = np.concatenate([[0.0], np.cumsum(values, dtype=np.float64)])
    end = np.arange(1, len(values) + 1)
    begin = np.maximum(end - window, 0)
    return (total[end] - total[begin]) / (end - begin)


def write_curve(runs: list[Path], png: Path, lines: Mapping[str, float] = MappingProxyType({})) -> None:
    """Draws the rolling hundred of every run, mean ± standard deviation over several, and writes its numbers.

    Args:
        runs: Run folders; each gets a `curve.csv` of its own.
        png: File of the figure.
        lines: Fractions to draw as lines through it, by what they are called.

    Raises:
        RunFolderError: One of them cannot be read; nothing is drawn then.
    """
    matplotlib.use("Agg")
    from matplotlib import pyplot

    curves, shown = [_curve(run) for run in runs], measure(runs[0])
    for run, curve in zip(runs, curves, strict=True):
        _write_table(run, curve)
    figure, panels = pyplot.subplots(1, 2, figsize=(10.0, 4.0), sharey=True, layout="constrained")
    paper = [("coverage", _EPISODE), ("success", _EPISODE)]
    drawn = paper if shown == "coverage" else [("smooth", _STEP), ("smooth", _SECOND)]
    for axes, (name, against) in zip(panels, drawn, strict=True):
        for (label, level), style in zip(lines.items(), cycle((":", "-.", "--"))):
            axes.axhline(100.0 * level, ls=style, lw=1.2, color="0.3", zorder=2, label=f"{label}, {100.0 * level:g} %")
        _draw(axes, [run.resolve().name for run in runs], curves, name, against)
    panels[0].legend(loc="lower right" if shown == "coverage" else "center right", fontsize=8)
    with replace_file(png) as fresh:
        figure.savefig(fresh, dpi=120, format="png")
    pyplot.close(figure)


def measure(run: Path) -> str:
    """Returns the measure of a run's progress: `coverage` where that is the task, else `success`."""
    try:
        task = json.loads((run / "config.json").read_text())["task"]
    except (OSError, ValueError, KeyError) as error:
        raise RunFolderError(f"{run}: no readable config.json in it") from error
    return "coverage" if "Traverse" in task else "success"


def _curve(run: Path) -> Curve:
    """Returns episodes, steps, seconds, and the rolling means at each episode."""
    rows, log = read_episodes(run), read_log(run)
    means = {name: rolling(rows[name]) for name in ("coverage", "success")}
    means["smooth"] = rolling(rows["success"], _SMOOTH)
    seconds = [line["timing"]["seconds"] for line in log]
    second = np.interp(rows["step"], [line["step"] for line in log], seconds) if log else rows["step"]
    return {"episode": rows["episode"], "step": rows["step"], "second": second, **means, "single": rows["coverage"]}


def _write_table(run: Path, curve: Curve) -> None:
    table = np.column_stack([curve[name] for name in ("episode", "step", "coverage", "success")])
    with replace_file(run / "curve.csv") as fresh:
        np.savetxt(fresh, table, fmt=["%d", "%d", "%.9g", "%.9g"], delimiter=",", header=_COLUMNS, comments="")


def _draw(axes: Any, names: list[str], curves: list[Curve], name: str, against: str) -> None:
    """Draws one panel: a thin line for a run, and the band of several."""
    for label, curve in zip(names, curves, strict=True):
        column, unit = _AGAINST[against]
        x = curve[column] / unit
        few = slice(None, None, max(1, len(x) // _POINTS))
        axes.plot(x[few], 100.0 * curve[name][few], lw=1.0, label=label, zorder=3)
        if len(curves) == 1 and name == "coverage":
            axes.plot(x[few], 100.0 * curve["single"][few], ".", ms=2, alpha=0.25, color="0.5", label="single episodes")
    if len(curves) > 1 and against == _EPISODE:
        _draw_band(axes, [curve[name] for curve in curves])
    if name == "coverage":
        axes.axhline(100.0 * GOAL, ls="--", lw=1.0, color="0.3", zorder=2, label=f"{100.0 * GOAL:.0f} % goal")
    label = f"success, %, mean of the last {_SMOOTH:,}" if name == "smooth" else f"{name}, %, mean of the last {WINDOW}"
    axes.set(xlabel=against, ylabel=label, ylim=(0.0, 102.0))
    axes.set_xlim(left=0.0)
    axes.grid(alpha=0.3)


def _draw_band(axes: Any, curves: list[np.ndarray]) -> None:
    """Draws mean ± standard deviation of several runs, as far as all of them go."""
    shortest = min(len(curve) for curve in curves)
    if shortest == 0:
        return
    few = slice(None, shortest, max(1, shortest // _POINTS))
    table, episode = 100.0 * np.stack([curve[few] for curve in curves]), np.arange(1, shortest + 1)[few]
    mean, spread = table.mean(axis=0), table.std(axis=0, ddof=1)
    axes.plot(episode, mean, color="black", lw=1.5, label="mean ± sd", zorder=5)
    axes.fill_between(episode, mean - spread, mean + spread, color="black", alpha=0.2, lw=0.0, zorder=4)


@dataclasses.dataclass(frozen=True)
class Command:
    """Draws the coverage curve of one or several runs."""

    runs: tyro.conf.Positional[tuple[Path, ...]]  # run folders
    out: Path = Path("curve.png")  # the figure
    # fractions to draw as lines, by name: `--lines floor 0.32 ceiling 0.997`
    lines: dict[str, float] = dataclasses.field(default_factory=dict)


def command(arguments: Command) -> None:
    """Draws the curves."""
    if not arguments.runs:
        raise RunFolderError("no run folder was named")
    require_file(arguments.out, ".png")
    write_curve(list(arguments.runs), arguments.out, arguments.lines)


def main() -> None:
    """Runs `python -m train.curve`."""
    sys.exit(run_command(lambda: command(parse(_read))))


def _read(words: list[str]) -> Command:
    return tyro.cli(Command, args=words, prog="python -m train.curve", description=__doc__)


if __name__ == "__main__":
    main()
