"""The bound of `st.localisability` against the error of the ceiling's filter along tunnels, in one figure.

`python -m benchmarks.openboard.bound --out out/bound`
"""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

import subterra_jax as st
from benchmarks.command import require_least, run_main
from benchmarks.results import environment_facts, png_bytes, write_file
from subterra_jax.baselines.ceiling import ceiling
from subterra_jax.episode import Driver, Episode, Taken, concatenate
from subterra_jax.evaluation.localisability import localisability
from subterra_jax.host.files import require_folder
from subterra_jax.rules import GoalParams
from subterra_jax.state import EnvParams
from subterra_jax.tunnel.sources import tunnel_of

SCHEMA = "subterra.bound/1"
TIGHT = 0.3  # m; the bound and the error are compared where the bound is below
_CELL = 5.0  # m of station over which errors are gathered
_MOUTH = 35.0  # m next to a mouth that are left out: the mouth itself is seen
_MARGIN = 4.0  # m from each mouth to start and goal
_CHUNK = 200
_progress = Console(stderr=True, highlight=False)


@dataclasses.dataclass(frozen=True)
class BoundConfig:
    """Settings of the comparison.

    Attributes:
        out: Folder for `bound.json` and `bound.png`.
        tunnels: Names, files or scene folders, each with `:LINING`.
        episodes: Episodes in each tunnel, from mouth to mouth.
        seed: Seed of the first episode.
    """

    out: Path
    tunnels: tuple[str, ...] = (
        "subterra-351:pockets",
        "subterra-351:smooth",
        "metro-asbuilt:pockets",
        "metro-asbuilt:smooth",
        "control:smooth",
    )
    episodes: int = 64
    seed: int = 700_000_000


def run(config: BoundConfig) -> None:
    """Drives, compares, and writes figure and numbers.

    Raises:
        SubterraError: A tunnel is unknown, or the folder cannot be written.
    """
    require_least(config, episodes=2, seed=0)
    require_folder(config.out)
    rows = []
    for name in config.tunnels:
        rows.append(compare(name, config))
        print(describe(rows[-1]))
        content = {"schema": SCHEMA, "rows": rows, "episodes": config.episodes, "facts": environment_facts()}
        write_file(config.out / "bound.json", (json.dumps(content) + "\n").encode())
    write_file(config.out / "bound.png", png_bytes(draw(rows), 110))
    print(config.out / "bound.png")


def compare(name: str, config: BoundConfig) -> dict[str, Any]:
    """Return stations (m), bound (m) and root of the mean squared error of the filter (m) along a tunnel."""
    source, _, lining = name.rpartition(":")
    plan = st.load_tunnel(tunnel_of(Path(source)) if Path(source).is_dir() else source)
    way = plan.length - 2.0 * _MARGIN
    goal = GoalParams(low=way, high=way, margin=_MARGIN)
    env, params = st.make("Subterra/StopAt-v1", plan, lining, estimates=True, goal=goal, horizon=20_000)
    found = localisability(params, step=_CELL)
    driver = Driver(env, keep=_keep)
    seeds = config.seed + np.arange(config.episodes)
    agent = ceiling(params)
    kept = []
    for _, rows in driver.drive(params, agent, driver.begin(params, agent, seeds), _CHUNK):
        kept.append(jax.device_get(rows))
        _progress.print(f"{name}: station {float(np.nanmax(kept[-1][0])):.0f} m", end="\r")
    station, error, over = (np.asarray(part).ravel() for part in concatenate(kept))
    there = ~over & np.isfinite(error)
    cell = np.clip((station[there] / _CELL).astype(int), 0, len(found.station) - 1)
    count = np.bincount(cell, minlength=len(found.station))
    square = np.bincount(cell, error[there] ** 2, len(found.station))
    rms = np.sqrt(square / np.maximum(count, 1))
    inside = (found.station > _MOUTH) & (found.station < plan.length - _MOUTH) & (count > 0)
    return {
        "tunnel": name,
        "station": found.station[inside].tolist(),
        "bound": found.drift[inside].tolist(),
        "error": rms[inside].tolist(),
    }


def _keep(now: Episode, taken: Taken, params: EnvParams) -> tuple[Any, Any, Any]:
    """Keep station, error of the estimate, and whether the episode was over."""
    del params
    return taken.info["station"], taken.info["estimate_error"], now.over


def ratio(row: dict[str, Any]) -> float | None:
    """Return the root of the mean squared error over that of the bound, where the bound is tight; None for nowhere."""
    bound, error = np.array(row["bound"]), np.array(row["error"])
    tight = bound < TIGHT
    if not tight.any():
        return None
    return float(np.sqrt(np.mean(error[tight] ** 2) / np.mean(bound[tight] ** 2)))


def describe(row: dict[str, Any]) -> str:
    """Return the comparison in a sentence."""
    bound, error, found = np.array(row["bound"]), np.array(row["error"]), ratio(row)
    words = f"{row['tunnel']}: bound {np.median(bound):.3f} m and error {np.median(error):.3f} m in the median"
    if found is None:
        return f"{words}; the bound is nowhere below {TIGHT} m"
    share = 100.0 * float(np.mean(bound < TIGHT))
    return f"{words}; ratio {found:.2f} where the bound is below {TIGHT} m ({share:.1f} % of the way)"


def draw(rows: list[dict[str, Any]]) -> Figure:
    """Draw bound and error along each tunnel, one panel each."""
    figure, grid = plt.subplots(len(rows), 1, figsize=(9.0, 1.0 + 1.8 * len(rows)), squeeze=False, layout="constrained")
    for axes, row in zip(grid[:, 0], rows, strict=True):
        axes.plot(row["station"], row["bound"], color="#1b4965", lw=1.4, label="bound: drift of a perfect filter")
        axes.plot(row["station"], row["error"], color="#c1121f", lw=1.0, label="error of the ceiling's filter, RMS")
        axes.axhline(TIGHT, color="black", lw=0.6, ls=":")
        axes.set_yscale("log")
        axes.set_ylabel("m")
        found = ratio(row)
        words = "" if found is None else f": error over bound {found:.2f} where that is below {TIGHT} m"
        axes.set_title(row["tunnel"] + words, fontsize=9)
        axes.grid(alpha=0.25)
    grid[0, 0].legend(fontsize=8)
    grid[-1, 0].set_xlabel("station, m")
    return figure


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    return run_main("openboard.bound", BoundConfig, run, description=__doc__, words=words)


if __name__ == "__main__":
    sys.exit(main())
