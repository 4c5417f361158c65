"""Material and colours of all figures, and the figures of scores, controls and sweep."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.colors import LinearSegmentedColormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Patch

from benchmarks.fidelity import scoring
from benchmarks.fidelity.case import Case


@dataclass(frozen=True)
class Sheet:
    """Material of all figures."""

    case: Case  # Case of the reconstruction
    null: Case  # Case of the null tube on the same references
    report: dict[str, Any]  # Content of the report
    controls: list[dict[str, Any]]  # Rows of controls; may be empty
    sweep: list[dict[str, Any]]  # Rows of the sweep; may be empty

    def note(self, n: int | None = None) -> str:
        """Return the end of every caption: samples, seed, split."""
        hold = self.report["split"]["hold"]
        split = (f"held out: {hold['file']}" if hold["file"] else "held-out beams") if hold else "nothing held out"
        count = "" if n is None else f" n = {n:,}."
        return f"{count} Seed {self.report['seed']}; {split}; split {self.report['split']['rule']}."


Drawn = tuple[Figure, str]
Draw = Callable[[Sheet], Drawn | None]
INK, BLUE, ORANGE, GREEN, RED, GREY = "#1b1b1b", "#0072b2", "#e69f00", "#009e73", "#d55e00", "#999999"
AGREE, ONLY_MESH, ONLY_CLOUD = "#009e73", "#d55e00", "#0072b2"  # the paper's green, red and blue, for all eyes
DIVERGING = LinearSegmentedColormap.from_list("error", ["#0072b2", "#f7f7f7", "#d55e00"])


def bin_along(
    station: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"], width: float, statistic
) -> tuple[Float[np.ndarray, " b"], Float[np.ndarray, " b"]]:
    """Return the middle of each bin along the tunnel and a statistic of its values; bins below 5 are left out."""
    number = np.floor(station / width).astype(int)
    order = np.argsort(number, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(number[order])) + 1)
    kept = [group for group in groups if len(group) >= 5]
    middle = np.array([(number[group[0]] + 0.5) * width for group in kept])
    return middle, np.array([statistic(values[group]) for group in kept])


CLASSES = ListedColormap([AGREE, ONLY_MESH, ONLY_CLOUD])  # of a map of agreement


def show_map(axes: plt.Axes, values: Float[np.ndarray, "n m"], extent: Any, **style: Any) -> AxesImage:
    """Draws a map with the tunnel along x, as it is: no cell is blended with another."""
    style = {"aspect": "auto", "interpolation": "nearest"} | style
    return axes.imshow(values.T, origin="lower", extent=extent, **style)


def legend_classes(axes: plt.Axes, names: tuple[str, str, str], alpha: float = 1.0) -> None:
    """Draws the legend of a map of agreement over it: names of both, of the first alone and of the second alone."""
    patches = [Patch(color=CLASSES(k), alpha=alpha, label=name) for k, name in enumerate(names)]
    axes.legend(handles=patches, loc="upper center", bbox_to_anchor=(0.5, 1.22), ncol=3, frameon=False)


_KINDS = ("common", "category", "independent", "tolerance", "seed")


def draw_categories(sheet: Sheet) -> Drawn:
    entries = sheet.report["categories"]
    order = sorted(entries, key=lambda c: -1.0 if entries[c]["score"] is None else entries[c]["score"])
    failed = {m["category"] for m in sheet.report["metrics"] if m["status"] == "gate failed"}
    figure, axes = plt.subplots(figsize=(9, 5.6), layout="constrained")
    for row, name in enumerate(order):
        score, null, ceiling = (entries[name][key] for key in ("score", "null", "ceiling"))
        if score is None:
            axes.text(1, row, "no reference", va="center", color=GREY)
        else:
            axes.barh(row, score, height=0.62, color=RED if name in failed else BLUE)
        if null is not None:
            axes.plot(null, row, "D", color=GREY, markeredgecolor=INK, ms=6)
        if ceiling is not None:
            axes.plot(ceiling, row, "|", color=GREEN, ms=13, mew=2.5)
    axes.axvline(scoring.PASS_CATEGORY, color=INK, lw=0.8, ls=":")
    axes.set(yticks=range(len(order)), yticklabels=[f"{c}  {entries[c]['name']}" for c in order])
    axes.set(xlim=(0, 103), ylim=(-0.7, len(order) - 0.3), xlabel="score")
    line = plt.Line2D
    marks = [
        line([], [], color=BLUE, lw=7, label="reconstruction"),
        line([], [], color=RED, lw=7, label="with a failed gate"),
        line([], [], marker="D", ls="", color=GREY, markeredgecolor=INK, label="null tube"),
        line([], [], marker="|", ls="", ms=13, mew=2.5, color=GREEN, label="truth as candidate"),
    ]
    axes.legend(handles=marks, loc="upper center", bbox_to_anchor=(0.4, -0.09), ncol=4, frameon=False)
    scored = sum(m["score"] is not None for m in sheet.report["metrics"])
    note = sheet.note(scored).replace("n =", "Scored metrics n =")
    return figure, "Categories, sorted; dotted: least score for PASS." + note


def draw_controls(sheet: Sheet) -> Drawn | None:
    rows = [row for row in sheet.controls if row["bold"]]
    if not rows:
        return None
    names = list(sheet.report["categories"])
    drop = np.array([[np.nan if row["falls"][c] is None else row["falls"][c] for c in names] for row in rows], float)
    figure, axes = plt.subplots(figsize=(9.5, 1.4 + 0.24 * len(rows)), layout="constrained")
    picture = axes.imshow(drop, cmap="Blues", vmin=0, vmax=100, aspect="auto")
    for y, row in enumerate(rows):
        for x, name in enumerate(names):
            if name in row.get("short", {}):
                axes.text(x, y, "x", ha="center", va="center", color=RED, fontsize=12, fontweight="bold")
            elif np.isfinite(drop[y, x]) and abs(drop[y, x]) >= 0.5:
                color = "white" if drop[y, x] > 45 else INK
                axes.text(x, y, f"{drop[y, x]:.0f}", ha="center", va="center", fontsize=7, color=color)
    axes.set(xticks=range(len(names)), xticklabels=names, yticks=range(len(rows)))
    axes.set_yticklabels([f"{row['id']} {row['corruption'][:44]} · {row['dose']:g}" for row in rows], fontsize=7)
    axes.xaxis.tick_top()
    figure.colorbar(picture, label="points lost", shrink=0.5)
    caption = "Points that each category loses under each control; x marks a fall that is short of what is asked."
    return figure, caption + sheet.note(len(rows))


def draw_sweep(sheet: Sheet) -> Drawn | None:
    if not sheet.sweep:
        return None
    figure, axes = plt.subplots(figsize=(8, 3.2), layout="constrained")
    rng = np.random.default_rng(0)
    for row, kind in enumerate(_KINDS):
        delta = np.array([r["delta"] for r in sheet.sweep if r["kind"] == kind])
        axes.plot(delta, row + rng.uniform(-0.22, 0.22, len(delta)), "o", color=BLUE, ms=4, alpha=0.6)
    axes.axvline(0, color=INK, lw=0.8)
    axes.set(yticks=range(len(_KINDS)), yticklabels=_KINDS, xlabel="move of the global score, points")
    caption = "Global score under thresholds ±10 % (common, by category, independent), tolerances ±10 %, other seeds."
    return figure, caption + sheet.note(len(sheet.sweep))
