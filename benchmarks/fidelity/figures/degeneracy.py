"""How well the tunnel holds a scan along its axis, recorded and in the candidate."""

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.fidelity.derive.hessian import real_frames, synthetic_frames
from benchmarks.fidelity.figures import Drawn, Sheet
from benchmarks.fidelity.figures.style import BLUE, GREY, ORANGE


def along(sheet: Sheet) -> Drawn | None:
    """F12: axial information along the tunnel."""
    if sheet.case.hold is None:
        return None
    frames = (
        (real_frames(sheet.case), BLUE, "recorded"),
        (synthetic_frames(sheet.case), ORANGE, "in the reconstruction"),
        (synthetic_frames(sheet.null), GREY, "in the null tube"),
    )
    figure, (axial, strong) = plt.subplots(2, 1, figsize=(12, 4.6), layout="constrained", sharex=True)
    for found, colour, label in frames:
        order = np.argsort(found.station)
        axial.plot(found.station[order], found.axial[order], color=colour, lw=1.2, label=label)
        strong.plot(found.station[order], 100 * found.strong[order], color=colour, lw=1.2)
    axial.set(ylabel="axial information a point", yscale="log")
    axial.legend(frameon=False, ncol=3, loc="upper center", bbox_to_anchor=(0.5, 1.22))
    strong.set(xlabel="station, m", ylabel="points whose normal lies\nwithin 60° of the axis, %", ylim=(0, None))
    return figure, "Axial share of the point-to-plane Hessian of each held-out scan." + sheet.note(
        len(frames[0][0].station)
    )
