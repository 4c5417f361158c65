"""What came of it: a table, a JSON file and a figure."""

import json
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot
from rich.console import Console
from rich.table import Table

from benchmarks.learning.curve import Curve
from train.curve import GOAL, rolling
from train.run.episodes import WINDOW

_HEADINGS = ("", "episodes", "steps", "s", "compiled in", "steps/s")


def write(out: Path, curves: list[Curve], facts: dict[str, Any]) -> None:
    """Prints the table; writes `learning.json` and `learning.png`."""
    grid = Table(title=f"{facts['task']}: to {100 * GOAL:.0f} % coverage and 100 % success of the last {WINDOW}")
    for heading in _HEADINGS:
        grid.add_column(heading, justify="right", no_wrap=True)
    for curve in curves:
        found = curve.reached()
        when = [f"{found['episodes']:,}", f"{found['steps']:,}", f"{found['seconds']:.1f}"] if found else ["never"] * 3
        grid.add_row(curve.name, *when, f"{curve.compiling:.1f} s", f"{_rate(curve):,.0f}")
    Console().print(grid)
    out.mkdir(parents=True, exist_ok=True)
    rows = [
        {
            "name": curve.name,
            "reached": curve.reached(),
            "compiling": curve.compiling,
            "steps_per_second": _rate(curve),
            "episode": {
                "step": curve.step.tolist(),
                "seconds": np.round(curve.seconds, 3).tolist(),
                "coverage": np.round(curve.coverage, 6).tolist(),
                "success": curve.success.astype(int).tolist(),
            },
        }
        for curve in curves
    ]
    _write(out / "learning.json", json.dumps({"schema": "subterra.learning/1", **facts, "runs": rows}).encode() + b"\n")
    figure, panels = pyplot.subplots(1, 2, figsize=(10.0, 4.0), sharey=True, layout="constrained")
    for axes, x, label in ((panels[0], "step", "environment steps"), (panels[1], "seconds", "s, without compiling")):
        for curve in curves:
            axes.plot(np.maximum(getattr(curve, x), 1e-2), 100.0 * rolling(curve.coverage), label=curve.name)
        axes.axhline(100.0 * GOAL, ls="--", lw=1.0, color="0.3")
        axes.set(xlabel=label, xscale="log", ylim=(0.0, 100.0))
        axes.grid(alpha=0.3)
    panels[0].set_ylabel(f"coverage, %, mean of the last {WINDOW}")
    panels[0].legend(loc="center left", fontsize=8)
    fresh = out / ".learning.png.partial"
    figure.savefig(fresh, dpi=120, format="png")
    fresh.replace(out / "learning.png")
    pyplot.close(figure)


def _rate(curve: Curve) -> float:
    """Steps per second, learning included, without compiling."""
    return float(curve.step[-1] / curve.seconds[-1]) if len(curve.step) else 0.0


def _write(path: Path, content: bytes) -> None:
    fresh = path.with_name(f".{path.name}.partial")
    fresh.write_bytes(content)
    fresh.replace(path)
