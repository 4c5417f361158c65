"""Centrelines from above and from the side, and the distance between them."""

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.fidelity.derive.curve import candidate_curve
from benchmarks.fidelity.derive.reference_axis import reference_curve
from benchmarks.fidelity.figures import Drawn, Sheet
from benchmarks.fidelity.figures.style import BLUE, INK, ORANGE


def plan_and_profile(sheet: Sheet) -> Drawn | None:
    """F16: reconstruction and reference in plan and profile, and the offset along the tunnel."""
    if sheet.case.hold is None and sheet.case.truth is None:
        return None
    ours, reference = candidate_curve(sheet.case), reference_curve(sheet.case)
    start, chord = reference.position[0], reference.position[-1] - reference.position[0]
    chord = chord[:2] / np.linalg.norm(chord[:2])
    turn = np.array([chord, [-chord[1], chord[0]]])
    figure, (plan, profile, offset) = plt.subplots(3, 1, figsize=(11, 7), layout="constrained")
    for curve, colour, label, style in ((reference, INK, "reference", "-"), (ours, BLUE, "reconstruction", "--")):
        along, across = turn @ (curve.position[:, :2] - start[:2]).T
        plan.plot(along, across, style, color=colour, label=label)
        profile.plot(along, curve.position[:, 2] - start[2], style, color=colour)
    ends = reference.position[[0, -1]]
    plan.plot(*(turn @ (ends[:, :2] - start[:2]).T), "^", color=ORANGE, label="ends of the reference")
    local = reference.local(ours.position)
    offset.plot(local[:, 0], 100 * local[:, 1], color=BLUE, label="left")
    offset.plot(local[:, 0], 100 * local[:, 2], color=ORANGE, label="up")
    plan.set(ylabel="across, m")
    profile.set(ylabel="height, m", xlabel="along the chord, m")
    offset.set(xlabel="station, m", ylabel="offset from the\nreference, cm")
    plan.legend(frameon=False, ncol=3)
    offset.legend(frameon=False, ncol=2)
    return (
        figure,
        "Centrelines in plan and profile, and the reconstruction's offset from the reference; no alignment."
        + sheet.note(len(ours.station)),
    )
