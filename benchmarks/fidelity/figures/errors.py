"""Distances of held-out points to the mesh: where, along the tunnel, and how distributed."""

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.fidelity.derive.beams import returns, synthetic
from benchmarks.fidelity.derive.distances import thinned, to_mesh
from benchmarks.fidelity.derive.noise import real_planes
from benchmarks.fidelity.derive.surface import nearest
from benchmarks.fidelity.figures import Drawn, Sheet
from benchmarks.fidelity.figures.style import BLUE, DIVERGING, GREY, INK, ORANGE, RED, binned

_LIMIT = 5.0  # cm


def unrolled(sheet: Sheet) -> Drawn | None:
    """F3: signed distance over chainage and angle."""
    if sheet.case.hold is None:
        return None
    found, local = to_mesh(sheet.case), returns(sheet.case).local[thinned(sheet.case)]
    figure, axes = plt.subplots(figsize=(12, 3.6), layout="constrained")
    middle = np.median(local[:, 2])
    angle = np.degrees(np.arctan2(local[:, 2] - middle, local[:, 1]))
    order = np.argsort(np.abs(found.signed))
    picture = axes.scatter(found.station[order], angle[order], c=100 * found.signed[order], s=1.5, lw=0, cmap=DIVERGING,
                           vmin=-_LIMIT, vmax=_LIMIT, rasterized=True)  # fmt: skip
    axes.set_facecolor("0.8")  # points near the mesh are nearly white
    axes.set(xlabel="station, m", ylabel="angle from left\ntowards up, deg", yticks=(-180, -90, 0, 90, 180))
    figure.colorbar(picture, label="signed distance, cm", extend="both")
    return (
        figure,
        "Held-out points by signed distance to the mesh; positive: the point lies on the sensor's side of it."
        + sheet.note(len(angle)),
    )


def along(sheet: Sheet) -> Drawn | None:
    """F4: mean and 95th percentile of the distance along the tunnel, with the null tube."""
    if sheet.case.hold is None:
        return None
    figure, axes = plt.subplots(figsize=(12, 3.2), layout="constrained")
    found, null = to_mesh(sheet.case), to_mesh(sheet.null)
    width = max(1.0, float(np.ptp(found.station)) / 120)
    x, mean = binned(found.station, 100 * found.distance, width, np.mean)
    _, low = binned(found.station, 100 * found.distance, width, lambda v: np.percentile(v, 25))
    _, high = binned(found.station, 100 * found.distance, width, lambda v: np.percentile(v, 75))
    _, p95 = binned(found.station, 100 * found.distance, width, lambda v: np.percentile(v, 95))
    axes.fill_between(x, low, high, color=BLUE, alpha=0.2, label="middle half")
    axes.plot(x, mean, color=BLUE, label="mean")
    axes.plot(x, p95, color=BLUE, ls="--", lw=1, label="95th percentile")
    axes.plot(*binned(null.station, 100 * null.distance, width, np.mean), color=GREY, label="null tube, mean")
    axes.plot(
        *binned(null.station, 100 * null.distance, width, lambda v: np.percentile(v, 95)),
        color=GREY,
        ls="--",
        lw=1,
        label="null tube, 95th percentile",
    )
    axes.set(xlabel="station, m", ylabel="distance to the mesh, cm", ylim=(0, None))
    axes.legend(ncol=5, frameon=False, loc="upper center", bbox_to_anchor=(0.5, 1.16))
    return figure, f"Distance of held-out points to the mesh in bins of {width:.1f} m." + sheet.note(
        len(found.distance)
    )


def distribution(sheet: Sheet) -> Drawn | None:
    """F7: histogram and distribution of the distance, with the recording's own noise and the self-cast curve."""
    if sheet.case.hold is None:
        return None
    own = synthetic(sheet.case)[thinned(sheet.case)]
    own = own[np.isfinite(own).all(axis=1)][:20_000]
    curves = (
        ("held-out points", 100 * to_mesh(sheet.case).distance, BLUE, "-"),
        ("held-out points, null tube", 100 * to_mesh(sheet.null).distance, GREY, "-"),
        ("noise of the recording itself", 100 * np.abs(real_planes(sheet.case).residual), ORANGE, "--"),
        ("self-cast: synthetic points to the same mesh", 100 * nearest(sheet.case).query(own)[0], RED, ":"),
    )
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.6), layout="constrained")
    for label, values, colour, style in curves:
        values = values[np.isfinite(values)]
        left.hist(np.clip(values, 0, 15), bins=90, density=True, histtype="step", color=colour, ls=style, lw=1.4)
        right.plot(np.sort(values), np.linspace(0, 1, len(values)), color=colour, ls=style, lw=1.6, label=label)
    for axes in (left, right):
        axes.set(xlabel="distance, cm", xlim=(0, 15))
        axes.axvline(10, color=INK, lw=0.6, ls=":")
    left.set(ylabel="density, 1/cm")
    right.set(ylabel="share of points", ylim=(0, 1.01))
    right.legend(frameon=False, loc="lower right")
    return (
        figure,
        "Distances to the mesh. The self-cast curve is the range noise alone and says nothing of the tunnel."
        + sheet.note(len(curves[0][1])),
    )
