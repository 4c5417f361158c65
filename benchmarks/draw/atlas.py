"""Atlas of a tunnel: bound of one scan and drift of a perfect filter along it, by lining and sensor.

`python -m benchmarks.draw atlas build/tunnel --linings pockets smooth --out out/atlas`
"""

import dataclasses
import json
from pathlib import Path
from typing import Annotated

import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.figure import Figure
from rich.console import Console

import subterra_jax as st
from benchmarks.command import BenchmarkError, run_main
from benchmarks.results import constants_facts, environment_facts, png_bytes, write_file
from subterra_jax.evaluation.localisability import Localisability, Solid
from subterra_jax.host.files import require_folder
from subterra_jax.lidar3d import Relief, beams
from subterra_jax.tasks import find
from subterra_jax.tunnel.sources import tunnel_of

SCHEMA = "subterra.atlas/1"
SENSORS = ("planar", "spin16x64")
LOST = 1.0  # m, tolerance of T1
_COLOURS = ("#1b4965", "#c1121f", "#e09f3e", "#5b8e7d", "#8367c7", "#444444")
_CEILING = 100.0  # m; bounds above it are drawn there
_progress = Console(stderr=True, highlight=False)


@dataclasses.dataclass(frozen=True)
class AtlasConfig:
    """Settings of an atlas."""

    # Folder of a built scene, a `tunnel.npz`, or a name as for `st.load_tunnel`.
    tunnel: Annotated[str, tyro.conf.Positional]
    linings: tuple[str, ...] = ()  # Variants of the walls; all that the tunnel has if not given.
    # `planar`, and `spin16x64` (16 rings from -15° to 15°, 64 columns), which needs the bore in three dimensions; where
    # a file holds none, its walls stand upright.
    sensors: tuple[str, ...] = ("planar",)
    task: str = "Subterra/StopAt-v1"  # Task whose noise, range and errors of odometry count.
    step: float = 0.5  # Length of a cell of station, m.
    out: Path | None = None  # Folder for `atlas.json` and `atlas.png`; `None` prints the summary only.


def run(config: AtlasConfig) -> None:
    """Computes and writes the atlas.

    Raises:
        SubterraError: The tunnel, a lining, a sensor or the task is unknown, or the folder cannot be written.
        ValueError: The tunnel is too short for the task, or `step` is out of range.
    """
    for sensor in config.sensors:
        if sensor not in SENSORS:
            raise BenchmarkError(f"there is no sensor {sensor!r}; there are {', '.join(SENSORS)}")
    if config.out is not None:
        require_folder(config.out)
    source = tunnel_of(Path(config.tunnel)) if Path(config.tunnel).is_dir() else config.tunnel
    plan = st.load_tunnel(source, solid=set(config.sensors) != {"planar"})
    for lining in config.linings:
        plan.lining(lining)
    found: dict[str, Localisability] = {}
    for lining in config.linings or tuple(plan.linings):
        _, params = st.make(find(config.task, short=True), tunnel=plan, lining=lining)
        if "slip" not in params.parts:
            raise BenchmarkError(f"{config.task} has no slip, so that commands alone tell the station: take StopAt")
        for sensor in config.sensors:
            solid = None if sensor == "planar" else Solid(Relief.from_plan(plan, lining), plan, beams.vlp16(64))
            title = f"{lining}, {sensor}"
            found[title] = st.localisability(params, step=config.step, solid=solid)
            print(f"{plan.name}, {title}: {describe(found[title])}")
    if config.out is not None:
        content = {
            "schema": SCHEMA,
            "tunnel": plan.name,
            "task": config.task,
            "facts": {**environment_facts(), **constants_facts()},
            "atlas": {title: as_columns(one) for title, one in found.items()},
        }
        write_file(config.out / "atlas.json", (json.dumps(content) + "\n").encode())
        write_file(config.out / "atlas.png", png_bytes(draw_atlas(plan.name, found), 110))
        print(config.out / "atlas.png")


def describe(found: Localisability) -> str:
    """Returns the summary of an atlas in a sentence, the 30 m next to either mouth left out."""
    inside = (found.station > 30.0) & (found.station < found.station[-1] - 30.0)
    inside = inside if inside.any() else np.ones(len(inside), bool)
    bound, drift = found.station_bound[inside], found.drift[inside]
    blind = np.mean(~np.isfinite(bound))
    least, usual = (float(np.quantile(bound, q, method="lower")) for q in (0.1, 0.5))
    where = found.station[inside][int(np.argmax(drift))]
    return (
        f"one scan tells the station to {usual:.2f} m in the median ({least:.2f} m in the best tenth), nothing in "
        f"{100 * blind:.0f} % of the cells; a perfect filter drifts by at most {drift.max():.2f} m, at {where:.0f} m"
    )


def as_columns(found: Localisability) -> dict[str, list]:
    """Returns plain lists by name, for JSON; infinity becomes `null`."""

    def plain(values: np.ndarray) -> list:
        return [None if not np.isfinite(value) else float(f"{value:.6g}") for value in values]

    names = ("station", "station_bound", "offset_bound", "heading_bound", "drift", "blind_drift")
    return {name: plain(getattr(found, name)) for name in names}


def draw_atlas(name: str, found: dict[str, Localisability]) -> Figure:
    """Draws the bound of one scan above and the drift below, one colour for each lining and sensor."""
    figure, (above, below) = plt.subplots(2, 1, figsize=(10.0, 5.6), sharex=True, layout="constrained")
    for colour, (title, one) in zip(_COLOURS * len(found), found.items(), strict=False):
        bound = np.minimum(one.station_bound, _CEILING)
        above.plot(one.station, bound, color=colour, lw=0.9, label=title)
        below.plot(one.station, one.drift, color=colour, lw=1.3, label=title)
    one = next(iter(found.values()))
    below.plot(one.station, one.blind_drift, color="#999999", lw=1.3, ls="--", label="without scans")
    for axes, words in ((above, "bound of one scan, m"), (below, "drift of a perfect filter, m")):
        axes.set_yscale("log")
        axes.set_ylabel(words)
        axes.axhline(LOST, color="black", lw=0.6, ls=":")
        axes.grid(alpha=0.25)
        axes.legend(fontsize=8, ncols=3, loc="upper right")
    above.set_title(
        f"{name}: how well the walls tell the station ({_CEILING:g} m: not at all; dotted: tolerance of T1)"
    )
    below.set_xlabel("station, m")
    return figure


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    return run_main("draw atlas", AtlasConfig, run, description=__doc__, words=words)
