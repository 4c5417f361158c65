"""What the sensor saw and what it would have seen in the candidate."""

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.fidelity.derive.beams import noisy, paired, returns
from benchmarks.fidelity.derive.noise import chosen, real_planes, synthetic_planes
from benchmarks.fidelity.figures import Drawn, Sheet
from benchmarks.fidelity.figures.style import BLUE, DIVERGING, ORANGE


def range_image(sheet: Sheet) -> Drawn | None:
    """F8: ranges of one held-out scan, the same beams in the candidate, and the difference."""
    if sheet.case.hold is None:
        return None
    real, cast = returns(sheet.case), paired(sheet.case)
    scans = np.unique(real.scan)
    rows = real.scan == scans[len(scans) // 2]
    turn = np.degrees(np.arctan2(real.heading[rows, 1], real.heading[rows, 0]))
    rise = np.degrees(np.arcsin(np.clip(real.heading[rows, 2], -1, 1)))
    figure, axes = plt.subplots(1, 3, figsize=(13, 3.4), layout="constrained", sharey=True)
    span = dict(vmin=0, vmax=float(np.percentile(real.range[rows], 98)), cmap="viridis")
    seen = np.where(cast.hit, cast.range, np.nan)
    pictures = (("recorded", real.range[rows], span), ("in the reconstruction", seen[rows], span),
                ("difference", 100 * cast.difference[rows], dict(vmin=-20, vmax=20, cmap=DIVERGING)))  # fmt: skip
    for axis, (name, values, style) in zip(axes, pictures, strict=True):
        shown = axis.scatter(turn, rise, c=values, s=2.5, lw=0, rasterized=True, **style)
        axis.set(title=name, xlabel="azimuth from the axis, deg")
        figure.colorbar(shown, ax=axis, label="cm" if name == "difference" else "m")
    axes[0].set(ylabel="elevation, deg")
    return (
        figure,
        f"Scan {int(scans[len(scans) // 2])} of the held-out recording and the same beams cast."
        + sheet.note(int(rows.sum())),
    )


def distributions(sheet: Sheet) -> Drawn | None:
    """F9: ranges, incidences and ranges by elevation, real and synthetic."""
    if sheet.case.hold is None:
        return None
    real, synthetic = returns(sheet.case), noisy(sheet.case, "first")
    by = {entry["id"]: entry["value"] for entry in sheet.report["metrics"]}
    figure, (ranges, incidence, elevation) = plt.subplots(1, 3, figsize=(13, 3.4), layout="constrained")
    top = float(np.percentile(real.range, 99.5))
    for values, colour, label in (
        (real.range, BLUE, "recorded"),
        (synthetic[np.isfinite(synthetic)], ORANGE, "in the reconstruction"),
    ):
        ranges.hist(np.clip(values, 0, top), bins=120, density=True, histtype="step", color=colour, label=label)
    ranges.set(xlabel="range, m", ylabel="density, 1/m", title=_title("KS", by["range_ks"], "W1", by["range_w1"], "m"))
    ranges.legend(frameon=False)
    direction = real.direction[chosen(sheet.case)]
    for planes, colour in ((real_planes(sheet.case), BLUE), (synthetic_planes(sheet.case), ORANGE)):
        angle = np.degrees(np.arccos(np.clip(np.abs(np.einsum("ij,ij->i", direction, planes.normal)), 0, 1)))
        incidence.hist(angle[np.isfinite(angle)], bins=60, density=True, histtype="step", color=colour)
    incidence.set(
        xlabel="incidence, deg", ylabel="density, 1/deg", title=_title("W1", by["incidence_w1"], "", None, "deg")
    )
    rise = np.degrees(np.arcsin(np.clip(real.heading[:, 2], -1, 1)))
    edges = np.linspace(rise.min(), rise.max() + 1e-6, 25)
    group = np.digitize(rise, edges) - 1
    for values, colour in ((real.range, BLUE), (synthetic, ORANGE)):
        medians = [np.median(v) if len(v := values[(group == k) & np.isfinite(values)]) else np.nan for k in range(24)]
        elevation.step(edges[:-1], medians, where="post", color=colour)
    elevation.set(
        xlabel="elevation, deg", ylabel="median range, m", title=_title("W1", by["elevation_w1"], "", None, "m")
    )
    return figure, "Distributions of held-out beams, recorded and cast with range noise." + sheet.note(len(real.range))


def _title(first: str, a: float | None, second: str, b: float | None, unit: str) -> str:
    parts = [f"{name} {value:.3g}" for name, value in ((first, a), (second, b)) if value is not None]
    return ", ".join(parts) + (f" {unit}" if parts else "")
