"""Fig. 2: from the recording to the validated scene, each stage with a picture of what it leaves."""

from collections.abc import Callable
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch

from benchmarks.fidelity.figures.style import BLUE, GREY, INK
from benchmarks.paper.material import Material
from benchmarks.paper.sheet import PAGE, Drawing

_SLICE = 0.15  # m either side of a section
_HISTOGRAM = 0.10  # m
_STRETCH = 4.0  # m either side of it, from above
_WALL = 0.25  # m that are left out beside the walls, whose height would take all the colours
_KNEE = -1.3  # m above the axis: below it lie track and floor
_HEIGHT = 1.45  # in
_TOP, _BOTTOM, _GAP, _EDGE = 0.87, 0.32, 0.033, 0.008  # shares of the figure


def draw(material: Material) -> Drawing:
    """Six stages from left to right, with arrows between them."""
    stages = _stages(material)
    figure = plt.figure(figsize=(PAGE, _HEIGHT))
    width = (1.0 - 2 * _EDGE - (len(stages) - 1) * _GAP) / len(stages)
    for k, (title, paint, lines) in enumerate(stages):
        left = _EDGE + k * (width + _GAP)
        axes = figure.add_axes((left, _BOTTOM, width, _TOP - _BOTTOM))
        paint(material, axes)
        axes.set(xticks=[], yticks=[])
        figure.text(left + 0.5 * width, _TOP + 0.03, title, ha="center", va="bottom", weight="bold", fontsize=7.5)
        figure.text(left + 0.5 * width, _BOTTOM - 0.03, "\n".join(lines), ha="center", va="top", fontsize=6.5)
        if k:
            _arrow(figure, left - _GAP, left)
    rows = [(title, line.replace("$\\times$", "x")) for title, _, lines in stages for line in lines]
    columns = {"stage": np.array([row[0] for row in rows]), "what": np.array([row[1] for row in rows])}
    caption = (
        "Construction pipeline: from the recording to the validated MJCF scene. The last stage compares the scene with "
        "a LiDAR that the builder never read."
    )
    error = np.abs(material.residual)
    facts = {"beams": len(error), "median": float(np.median(error)), "within_10cm": float(np.mean(error < _HISTOGRAM))}
    return Drawing(figure, caption, columns, {"held_out": facts})


def _stages(material: Material) -> tuple[tuple[str, Callable[[Material, Any], None], list[str]], ...]:
    """Title, picture and what is told of each stage, all from the manifest and the held-out beams."""
    facts, bore, count = (material.manifest[name] for name in ("detected", "bore", "count"))
    error = np.abs(material.residual)
    poses = str(facts["length_fixed_by"])
    size = f"{bore['width_mean']:.2f} $\\times$ {bore['height_mean']:.2f} m"
    return (
        ("recording", _scan, [f"{facts['scans']:,} scans", f"{facts['returns'] / 1e6:.1f} M returns"]),
        ("cloud", _plan, [f"{facts['points'] / 1e6:.2f} M voxels", f"by {poses}"]),
        ("bore", _section, [f"{bore['length']:.1f} m", size]),
        ("lining, track", _wall, [f"{count['pockets']:,} pockets", f"{count['sleepers']:,} sleepers"]),
        ("MuJoCo scene", _view, [f"{count['lining_faces'] / 1e3:.0f} k faces", "MJCF, MJX, JAX"]),
        (
            "held-out LiDAR",
            _errors,
            [f"median {100 * np.median(error):.1f} cm", f"{100 * np.mean(error < _HISTOGRAM):.1f} % in 10 cm"],
        ),
    )


def _scan(material: Material, axes: Any) -> None:
    """One scan from the side, as it comes from the sensor."""
    frame, pose = material.frame, material.pose
    local = (frame.points[frame.single] - pose.at) @ pose.axes.T
    local = local[local[:, 2] < 30.0]
    axes.scatter(local[:, 2], local[:, 1], c=local[:, 2], cmap="viridis_r", s=0.4, lw=0.0, rasterized=True)
    axes.set(xlim=(-1.0, 30.0), ylim=(-8.0, 10.0))


def _plan(material: Material, axes: Any) -> None:
    """The cloud of floor and track from above, by height."""
    bore, row = material.case.candidate.bore, material.row
    offset = material.cloud - bore.position[row]
    along, left, up = (offset @ axis[row] for axis in (bore.tangent, bore.lateral, bore.up))
    shown = (np.abs(along) < _STRETCH) & (np.abs(left) < 0.5 * bore.width[row] - _WALL) & (up < _KNEE)
    order = np.argsort(up[shown])
    along, left, up = (values[shown][order] for values in (along, left, up))
    low, high = np.percentile(up, (1, 99))
    axes.scatter(along, left, c=up, cmap="cividis", s=0.8, lw=0.0, vmin=low, vmax=high, rasterized=True)
    axes.set_aspect("equal", adjustable="datalim")


def _section(material: Material, axes: Any) -> None:
    """The section at the frame's place over the cloud about it."""
    bore, row = material.case.candidate.bore, material.row
    offset = material.cloud - bore.position[row]
    near = offset[np.abs(offset @ bore.tangent[row]) < _SLICE]
    near = near[np.linalg.norm(near, axis=1) < 2.0 * bore.radius[row].max()]
    axes.plot(near @ -bore.lateral[row], near @ bore.up[row], ".", ms=0.8, color=GREY, rasterized=True)
    angle, radius = np.append(bore.angle, bore.angle[0]), np.append(bore.radius[row], bore.radius[row][0])
    axes.plot(-radius * np.cos(angle), radius * np.sin(angle), color=BLUE, lw=1.0)
    axes.set_aspect("equal", adjustable="datalim")


def _wall(material: Material, axes: Any) -> None:
    axes.imshow(material.wall, aspect="auto")


def _view(material: Material, axes: Any) -> None:
    view = material.view
    cut = (view.shape[1] - view.shape[0]) // 2
    axes.imshow(view[:, cut : view.shape[1] - cut], aspect="auto")


def _errors(material: Material, axes: Any) -> None:
    """Ranges in the scene less those of the held-out LiDAR."""
    axes.hist(100.0 * material.residual, np.linspace(-100 * _HISTOGRAM, 100 * _HISTOGRAM, 41), color=BLUE)
    axes.axvline(0.0, color=INK, lw=0.6)
    axes.set_xlim(-100 * _HISTOGRAM, 100 * _HISTOGRAM)
    for at, place in ((0.03, "left"), (0.97, "right")):
        text = "$-$10 cm" if place == "left" else "10 cm"
        axes.text(at, 0.97, text, transform=axes.transAxes, ha=place, va="top", fontsize=5.5)


def _arrow(figure: Figure, start: float, end: float) -> None:
    middle = 0.5 * (_TOP + _BOTTOM)
    figure.add_artist(
        FancyArrowPatch((start, middle), (end, middle), transform=figure.transFigure, arrowstyle="-|>",
                        mutation_scale=8, color=INK, lw=0.9, shrinkA=1.5, shrinkB=1.5)
    )  # fmt: skip
