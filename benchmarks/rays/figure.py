"""Histograms of the errors."""

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.rays.agreement import MEDIAN_GOAL, TAIL_GOAL, Agreement

_INK, _GOAL, _EDGE = "#1b4965", "#c1121f", "#e09f3e"
_BINS = np.logspace(-7, 1.5, 86)


def histograms(comparisons: list[Agreement]) -> Figure:
    """One panel for each comparison: how many rays are how far off, those that pass an edge set apart."""
    columns = min(2, len(comparisons))
    rows = -(-len(comparisons) // columns)
    size = (6.0 * columns, 2.6 * rows + 0.4)
    figure, panels = plt.subplots(rows, columns, figsize=size, sharex=True, squeeze=False, layout="constrained")
    for axes, found in zip(panels.flat, comparisons, strict=False):
        kinds = (("passing no edge", ~found.edge, _INK), ("passing an edge", found.edge, _EDGE))
        axes.hist(
            [np.maximum(found.error[which], _BINS[0]) for _, which, _ in kinds], _BINS, stacked=True,
            color=[colour for *_, colour in kinds], label=[label for label, *_ in kinds],
        )  # fmt: skip
        for goal in (MEDIAN_GOAL, TAIL_GOAL) if found.judged else ():
            axes.axvline(goal, color=_GOAL, lw=1.0, ls="--")
        axes.set(xscale="log", yscale="log", ylim=(0.5, None))
        axes.set_title(f"{found.title}: median {1e3 * np.median(found.error):.3g} mm", fontsize=9)
        axes.grid(alpha=0.3)
    for axes in panels.flat[len(comparisons) :]:
        axes.set_visible(False)
    for axes in panels[-1]:
        axes.set_xlabel("difference from embree, m (dashed: goals for median and 99.9 %)")
    for axes in panels[:, 0]:
        axes.set_ylabel("rays")
    panels[0, 0].legend(fontsize=8, loc="upper left")
    return figure
