"""Persistence of the clearance field."""

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.fidelity.derive.freespace import candidate_diagrams, reference_diagrams
from benchmarks.fidelity.figures import Drawn, Sheet
from benchmarks.fidelity.figures.style import BLUE, GREY, ORANGE

_NAMES = ("components", "loops", "voids")


def diagrams(sheet: Sheet) -> Drawn | None:
    """F10: birth and death of components, loops and voids, reconstruction and reference."""
    if sheet.case.hold is None and sheet.case.truth is None:
        return None
    ours, reference = candidate_diagrams(sheet.case), reference_diagrams(sheet.case)
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.8), layout="constrained")
    count = 0
    for axis, name, mine, theirs in zip(axes, _NAMES, ours, reference, strict=True):
        for pairs, colour, mark, label in ((theirs, ORANGE, "o", "reference"), (mine, BLUE, "x", "reconstruction")):
            pairs = np.nan_to_num(np.asarray(pairs, float).reshape(-1, 2), posinf=0.0, neginf=0.0)
            count += len(pairs)
            axis.plot(pairs[:, 0], pairs[:, 1], mark, color=colour, ms=5, mfc="none", label=label)
        if not len(mine) and not len(theirs):
            axis.text(0.5, 0.5, "none in either", transform=axis.transAxes, ha="center", color=GREY)
            axis.set(xlim=(-1, 0), ylim=(-1, 0))
        low, high = min(axis.get_xlim()[0], axis.get_ylim()[0]), max(axis.get_xlim()[1], axis.get_ylim()[1])
        axis.plot([low, high], [low, high], color=GREY, lw=0.8)
        axis.set(title=name, xlabel="clearance at birth, m", aspect="equal")
    axes[0].set(ylabel="clearance at death, m")
    axes[0].legend(frameon=False)
    return (
        figure,
        "Persistence of free space as the clearance asked falls; far from the diagonal is what lasts."
        + sheet.note(count),
    )
