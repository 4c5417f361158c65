"""Pictures of the kinds of lining: the wall rolled out flat, a section with the sensor's plane, and the plan.

`python -m benchmarks.draw kinds --out docs/kinds`
"""

import dataclasses
import io
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image

from benchmarks.command import BenchmarkError, run_main
from benchmarks.results import png_bytes, write_file
from subterra_jax.host.files import require_folder
from subterra_jax.host.loading import load_module
from subterra_jax.procedural.bore import Bore
from subterra_jax.procedural.kinds import KINDS, all_kinds
from subterra_jax.procedural.open_world import HELD_OUT, UNSEEN, Drawn, draw, plan

_COLOURS = 48  # of a picture, to keep it small
_INK, _PLANE, _POCKET, _BOX = "#222222", "#c1121f", "#1b4965", "#e09f3e"


@dataclasses.dataclass(frozen=True)
class KindsConfig:
    """Settings of the pictures."""

    # Kinds of lining, `FILE.py:NAME` for one of your own; all of the benchmark if not given.
    kinds: tuple[str, ...] = ()
    # Index of the tunnel in its split; the default lies behind every tunnel that results are made with.
    index: int = 900_010
    length: float = 40.0  # Length of tunnel to draw, m.
    out: Path = Path("out/linings")  # Folder for a PNG of each kind.


def run(config: KindsConfig) -> None:
    """Draws the pictures.

    Raises:
        SubterraError: A kind is unknown, the length is too small, or the folder cannot be written.
    """
    kinds = [_find_kind(kind) for kind in config.kinds or KINDS]
    if not config.length >= 20.0:
        raise BenchmarkError(f"length must be at least 20 m, got {config.length:g}")
    require_folder(config.out)
    names = {kind: f"open:{kind}:{'train' if kind in HELD_OUT else UNSEEN}:{config.index}" for kind in kinds}
    for kind, name in names.items():
        write_file(config.out / f"{kind}.png", few_colours(png_bytes(picture(name, config.length), 80)))
        print(config.out / f"{kind}.png")


def _find_kind(name: str) -> str:
    """Returns the name of a kind; before a colon may stand a user's module, which is run and registers it."""
    source, _, kind = name.rpartition(":")
    if source:
        load_module(source)
    if kind not in (known := all_kinds()):
        raise BenchmarkError(f"there is no kind {kind!r}; there are {', '.join(known)}")
    return kind


def picture(name: str, length: float) -> Figure:
    """Draws one tunnel."""
    drawn = draw(name, length)
    bore = drawn.bore
    figure = plt.figure(figsize=(11.0, 5.0), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(3.2, 1.0), height_ratios=(1.5, 1.0))
    draw_unrolled(figure.add_subplot(grid[0, 0]), bore)
    draw_section(figure.add_subplot(grid[:, 1]), bore)
    draw_plan(figure.add_subplot(grid[1, 0]), drawn, name, length)
    things = ", ".join(drawn.items) or "no furniture"
    figure.suptitle(f"{bore.kind.title}: {things}", fontsize=11)
    return figure


def draw_unrolled(axes: Axes, bore: Bore) -> None:
    """Draws how far the wall lies outside its design section, over station and girth; recesses as outlines."""
    order = np.argsort(bore.grid.girth)
    off = 1e3 * (bore.radius() - bore.radius(smooth=True))[:, order].T
    most = max(1.0, float(np.quantile(np.abs(off), 0.995)))
    girth, station = bore.grid.girth[order], bore.grid.station
    image = axes.pcolormesh(station, girth, off, cmap="RdBu_r", vmin=-most, vmax=most, shading="nearest")
    axes.figure.colorbar(image, ax=axes, label="wall outside the design, mm", pad=0.01)
    recesses = np.concatenate([bore.pocket, bore.niche, bore.recess])
    middle = np.interp(recesses[:, 1], bore.grid.angle, bore.grid.girth, period=2.0 * np.pi)
    for (at, _, along, around, _), place in zip(recesses, middle, strict=True):
        corner = (at - 0.5 * along, place - 0.5 * around)
        axes.add_patch(Rectangle(corner, along, around, fill=False, ec=_POCKET, lw=0.7))
    for side in (1.0, -1.0):
        height = float(bore.mount.plane(side * bore.section.half_width))
        lateral = bore.shift + side * float(bore.section.wall(height))
        angle = np.mod(np.arctan2(height - bore.middle, lateral), 2.0 * np.pi)
        axes.axhline(np.interp(angle, bore.grid.angle, bore.grid.girth, period=2.0 * np.pi), color=_PLANE, lw=0.9)
    axes.set_ylabel("around the section, m")
    axes.set_xlabel("station, m (red: where the sensor's plane meets the wall)")


def draw_section(axes: Axes, bore: Bore) -> None:
    """Draws design section, one built section, boxes, and the plane of the sensor."""
    row = len(bore.grid.station) // 2
    for radius, style in ((bore.radius(smooth=True)[row], {"lw": 0.8, "ls": "--"}), (bore.radius()[row], {"lw": 1.4})):
        turn = np.append(bore.grid.angle, bore.grid.angle[0])
        closed = np.append(radius, radius[0])
        axes.plot(closed * np.cos(turn), bore.middle + closed * np.sin(turn), color=_INK, **style)
    for boxes in (bore.box, bore.furniture):
        for side, face, low, high, out in zip(boxes.side, boxes.face, boxes.low, boxes.high, boxes.out, strict=True):
            axes.add_patch(Rectangle((side * face, low), side * out, high - low, fill=False, ec=_BOX, lw=0.8))
    for bench in bore.benches:
        edge = bore.bench_edge(bench)
        axes.add_patch(Rectangle((bench.side * edge, 0.0), bench.side * bench.width, bench.top, fc=_BOX, alpha=0.4))
    wide = np.array([-1.0, 1.0]) * bore.section.half_width
    axes.plot(wide, bore.mount.plane(wide), color=_PLANE, lw=1.2)
    axes.plot([0.0], [bore.mount.plane(0.0)], "o", color=_PLANE, ms=4)
    axes.invert_xaxis()  # left is left, seen in the direction of growing station
    axes.set_aspect("equal")
    axes.set_title(f"sensor at {bore.mount.height:.2f} m", fontsize=9)
    axes.set_xlabel("to the left of the axis, m")


def draw_plan(axes: Axes, drawn: Drawn, name: str, length: float) -> None:
    """Draws both walls of the plan against the axis, the laterals stretched."""
    tunnel = plan(name, solid=False, length=length, variants=("built",))
    walls = tunnel.lining("built")
    for wall, side in ((walls.left, 1.0), (walls.right, -1.0)):
        normal = drawn.alignment.tangent(wall.station)[:, ::-1] * [-1.0, 1.0]
        lateral = np.sum((wall.vertex - drawn.alignment.position(wall.station)) * normal, axis=1)
        axes.plot(wall.station, lateral, color=_INK, lw=0.8)
        axes.fill_between(wall.station, lateral, side * (np.abs(lateral).max() + 0.4), color="#dddddd", lw=0)
    axes.axhline(0.0, color="#999999", lw=0.6, ls=":")
    axes.set_ylabel("left of the axis, m")
    axes.set_xlabel("station, m (the plan: walls in the sensor's plane)")
    axes.set_xlim(0.0, length)


def few_colours(png: bytes) -> bytes:
    """Returns a PNG with few colours, which is small."""
    out = io.BytesIO()
    Image.open(io.BytesIO(png)).convert("RGB").quantize(_COLOURS).save(out, format="png", optimize=True)
    return out.getvalue()


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    return run_main("draw kinds", KindsConfig, run, description=__doc__, words=words)
