"""Cross-sections laid over each other, and the lining unrolled."""

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.fidelity.derive.beams import paired, returns
from benchmarks.fidelity.derive.reference_axis import reference_curve
from benchmarks.fidelity.derive.sections import sections
from benchmarks.fidelity.figures import Drawn, Sheet
from benchmarks.fidelity.figures.style import BLUE, DIVERGING, GREY, INK, ORANGE, RED

_SLICE = 0.15  # m
_CELL = (0.10, 2.0)  # m, deg


def overlays(sheet: Sheet) -> Drawn | None:
    """F5: reconstruction, reference and held-out points at eight stations."""
    if sheet.case.hold is None and sheet.case.truth is None:
        return None
    found = sections(sheet.case)
    rows = np.linspace(0, len(found.station) - 1, 10).astype(int)[1:-1]
    local = None if sheet.case.hold is None else reference_curve(sheet.case).local(returns(sheet.case).points)
    figure, axes = plt.subplots(2, 4, figsize=(12, 6.6), layout="constrained", sharex=True, sharey=True)
    count = 0
    for axis, row in zip(axes.flat, rows, strict=True):
        if local is not None:
            near = local[np.abs(local[:, 0] - found.station[row]) < _SLICE]
            count += len(near)
            axis.plot(near[:, 1], near[:, 2], ".", color=ORANGE, ms=1.2, rasterized=True)
        wall, real = found.judged[row], found.reference[row]
        c, s = np.cos(found.angle), np.sin(found.angle)
        axis.fill(
            np.append(wall * c, (real * c)[::-1]), np.append(wall * s, (real * s)[::-1]), color=RED, alpha=0.25, lw=0
        )
        axis.plot(real * c, real * s, color=INK, lw=0.9)
        axis.plot(wall * c, wall * s, color=BLUE, lw=0.9)
        axis.set(title=f"{found.station[row]:.1f} m", aspect="equal")
    names = (("reconstruction", BLUE), ("reference", INK), ("held-out points", ORANGE), ("between the two", RED))
    figure.legend(
        handles=[plt.Line2D([], [], color=c, label=n) for n, c in names],
        loc="outside lower center",
        ncol=4,
        frameon=False,
    )
    for axis in axes[1]:
        axis.set(xlabel="left, m")
    for axis in axes[:, 0]:
        axis.set(ylabel="up, m")
    return figure, "Cross-sections; shaded: over- and under-break between reconstruction and reference." + sheet.note(
        count
    )


def depth_maps(sheet: Sheet) -> Drawn | None:
    """F6: radii along held-out beams unrolled: candidate, recording, difference; the smooth part removed."""
    if sheet.case.hold is None:
        return None
    real, cast = returns(sheet.case), paired(sheet.case)
    reach = np.where(cast.hit, cast.range, np.nan)[:, None]
    path_scale = (reach[:, 0] - real.range)[:, None]
    figure, axes = plt.subplots(3, 1, figsize=(12, 7), layout="constrained", sharex=True)
    radius = np.hypot(real.local[:, 1], real.local[:, 2] - np.median(real.local[:, 2]))
    outward = radius + path_scale[:, 0] * np.clip(_outwardness(real), 0, 1)
    angle = np.degrees(np.arctan2(real.local[:, 2] - np.median(real.local[:, 2]), real.local[:, 1]))
    maps = [_map(real.local[:, 0], angle, values) for values in (outward, radius)]
    smooth = [m - _running(m) for m in maps]
    pictures = (("reconstruction", smooth[0]), ("recording", smooth[1]), ("difference", maps[0] - maps[1]))
    extent = [real.local[:, 0].min(), real.local[:, 0].max(), -180, 180]
    for axis, (name, picture) in zip(axes, pictures, strict=True):
        shown = axis.imshow(
            100 * picture.T,
            origin="lower",
            extent=extent,
            aspect="auto",
            cmap=DIVERGING,
            vmin=-12,
            vmax=12,
            interpolation="nearest",
        )
        axis.set_facecolor(GREY)
        axis.set(ylabel=f"{name}\nangle, deg", yticks=(-180, -90, 0, 90, 180))
    axes[-1].set(xlabel="station, m")
    figure.colorbar(shown, ax=axes, label="cm outward", shrink=0.5)
    return figure, "Lining unrolled in cells of 10 cm by 2 degrees, smooth part removed; grey: not seen." + sheet.note(
        len(radius)
    )


def _outwardness(real) -> np.ndarray:
    away = real.local[:, 1:] - np.array([0.0, np.median(real.local[:, 2])])
    away = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    return np.einsum("ij,ij->i", real.heading[:, 1:], away)


def _map(station: np.ndarray, angle: np.ndarray, values: np.ndarray) -> np.ndarray:
    shape = (int(np.ptp(station) / _CELL[0]) + 1, int(360 / _CELL[1]))
    i = np.minimum(((station - station.min()) / _CELL[0]).astype(int), shape[0] - 1)
    j = np.minimum(((angle + 180) / _CELL[1]).astype(int), shape[1] - 1)
    good = np.isfinite(values)
    flat = i[good] * shape[1] + j[good]
    total, count = (np.bincount(flat, weights, shape[0] * shape[1]) for weights in (values[good], None))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(shape)


def _running(values: np.ndarray, half: int = 12) -> np.ndarray:
    padded = np.pad(values, ((half, half), (0, 0)), constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=0)
    known = np.isfinite(windows).any(axis=-1)
    return np.where(known, np.nanmedian(np.where(known[..., None], windows, 0.0), axis=-1), np.nan)
