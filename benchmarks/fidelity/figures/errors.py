"""Figures of the surface: distances, cross-sections, voxels."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm

from benchmarks.fidelity.derive.axis import reference_curve
from benchmarks.fidelity.derive.beams import Returns, cast_beams, returns, synthetic_points
from benchmarks.fidelity.derive.clouds import real_planes
from benchmarks.fidelity.derive.curve import running_median
from benchmarks.fidelity.derive.distances import VOXEL_EDGE, Occupied, mesh_distances, occupied_voxels, thinned_rows
from benchmarks.fidelity.derive.sections import sections
from benchmarks.fidelity.derive.surface import surface_nearest
from benchmarks.fidelity.figures.sheet import (
    BLUE,
    CLASSES,
    DIVERGING,
    GREY,
    INK,
    ORANGE,
    RED,
    Drawn,
    Sheet,
    bin_along,
    legend_classes,
    show_map,
)  # fmt: skip  # isort: skip

_LIMIT = 5.0  # cm
_SLICE = 0.15  # m
_MAP_CELL = (0.10, 2.0)  # m, deg
_SMOOTHED = 2.4  # m along the tunnel
_PLANES = (("station, m", "left, m", 2), ("station, m", "up, m", 1), ("left, m", "up, m", 0))
_TURN = (-180, -90, 0, 90, 180)  # deg


# Distances of held-out points to the mesh.


def draw_signed_errors(sheet: Sheet) -> Drawn:
    distances, local = mesh_distances(sheet.case), returns(sheet.case).local[thinned_rows(sheet.case)]
    figure, axes = plt.subplots(figsize=(12, 3.6), layout="constrained")
    angle = np.degrees(np.arctan2(local[:, 2] - np.median(local[:, 2]), local[:, 1]))
    order = np.argsort(np.abs(distances.signed))
    station, signed = distances.station[order], 100 * distances.signed[order]
    picture = axes.scatter(station, angle[order], c=signed, s=1.5, lw=0, cmap=DIVERGING, vmin=-_LIMIT, vmax=_LIMIT,
                           rasterized=True)  # fmt: skip
    axes.set_facecolor("0.8")  # points near the mesh are nearly white
    axes.set(xlabel="station, m", ylabel="angle from left\ntowards up, deg", yticks=_TURN)
    figure.colorbar(picture, label="signed distance, cm", extend="both")
    caption = "Held-out points by signed distance to the mesh; positive: the point lies on the sensor's side of it."
    return figure, caption + sheet.note(len(angle))


def draw_errors_along(sheet: Sheet) -> Drawn:
    figure, axes = plt.subplots(figsize=(12, 3.2), layout="constrained")
    width = max(1.0, float(np.ptp(mesh_distances(sheet.case).station)) / 120)
    for case, colour, name in ((sheet.case, BLUE, ""), (sheet.null, GREY, "null tube, ")):
        distances = mesh_distances(case)
        station, distance = distances.station, 100 * distances.distance
        middle, mean = bin_along(station, distance, width, np.mean)
        low, high, p95 = (
            bin_along(station, distance, width, lambda v, q=q: np.percentile(v, q))[1] for q in (25, 75, 95)
        )
        if not name:
            axes.fill_between(middle, low, high, color=colour, alpha=0.2, label="middle half")
        axes.plot(middle, mean, color=colour, label=f"{name}mean")
        axes.plot(middle, p95, color=colour, ls="--", lw=1, label=f"{name}95th percentile")
    axes.set(xlabel="station, m", ylabel="distance to the mesh, cm", ylim=(0, None))
    axes.legend(ncol=5, frameon=False, loc="upper center", bbox_to_anchor=(0.5, 1.16))
    caption = f"Distance of held-out points to the mesh in bins of {width:.1f} m."
    return figure, caption + sheet.note(len(mesh_distances(sheet.case).distance))


def draw_error_distribution(sheet: Sheet) -> Drawn:
    own = synthetic_points(sheet.case)[thinned_rows(sheet.case)]
    own = own[np.isfinite(own).all(axis=1)][:20_000]
    curves = (
        ("held-out points", 100 * mesh_distances(sheet.case).distance, BLUE, "-"),
        ("held-out points, null tube", 100 * mesh_distances(sheet.null).distance, GREY, "-"),
        ("noise of the recording itself", 100 * np.abs(real_planes(sheet.case).residual), ORANGE, "--"),
        ("self-cast: synthetic points to the same mesh", 100 * surface_nearest(sheet.case).query(own)[0], RED, ":"),
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
    caption = "Distances to the mesh. The self-cast curve is the range noise alone and says nothing of the tunnel."
    return figure, caption + sheet.note(len(curves[0][1]))


# Cross-sections, and the lining unrolled.


def draw_sections(sheet: Sheet) -> Drawn:
    cut = sections(sheet.case)
    rows = np.linspace(0, len(cut.station) - 1, 10).astype(int)[1:-1]
    local = None if sheet.case.hold is None else reference_curve(sheet.case).local(returns(sheet.case).points)
    figure, axes = plt.subplots(2, 4, figsize=(12, 6.6), layout="constrained", sharex=True, sharey=True)
    count = 0
    for axis, row in zip(axes.flat, rows, strict=True):
        if local is not None:
            near = local[np.abs(local[:, 0] - cut.station[row]) < _SLICE]
            count += len(near)
            axis.plot(near[:, 1], near[:, 2], ".", color=ORANGE, ms=1.2, rasterized=True)
        across, above = np.cos(cut.angle), np.sin(cut.angle)
        wall, real = ((radius * across, radius * above) for radius in (cut.judged[row], cut.reference[row]))
        between = (np.append(ours, theirs[::-1]) for ours, theirs in zip(wall, real, strict=True))
        axis.fill(*between, color=RED, alpha=0.25, lw=0)
        axis.plot(*real, color=INK, lw=0.9)
        axis.plot(*wall, color=BLUE, lw=0.9)
        axis.set(title=f"{cut.station[row]:.1f} m", aspect="equal")
    names = (("reconstruction", BLUE), ("reference", INK), ("held-out points", ORANGE), ("between the two", RED))
    lines = [plt.Line2D([], [], color=colour, label=name) for name, colour in names]
    figure.legend(handles=lines, loc="outside lower center", ncol=4, frameon=False)
    for axis in axes[1]:
        axis.set(xlabel="left, m")
    for axis in axes[:, 0]:
        axis.set(ylabel="up, m")
    caption = "Cross-sections; shaded: over- and under-break between reconstruction and reference."
    return figure, caption + sheet.note(count)


def draw_depth_maps(sheet: Sheet) -> Drawn:
    real, cast = returns(sheet.case), cast_beams(sheet.case)
    longer = np.where(cast.hit, cast.range, np.nan) - real.range
    height = real.local[:, 2] - np.median(real.local[:, 2])
    radius, angle = np.hypot(real.local[:, 1], height), np.degrees(np.arctan2(height, real.local[:, 1]))
    outward = radius + longer * np.clip(_outward_share(real), 0, 1)
    maps = [_cell_means(real.local[:, 0], angle, values) for values in (outward, radius)]
    smooth = [m - running_median(m, _MAP_CELL[0], _SMOOTHED) for m in maps]
    figure, axes = plt.subplots(3, 1, figsize=(12, 7), layout="constrained", sharex=True)
    pictures = (("reconstruction", smooth[0]), ("recording", smooth[1]), ("difference", maps[0] - maps[1]))
    extent = (real.local[:, 0].min(), real.local[:, 0].max(), -180, 180)
    for axis, (name, picture) in zip(axes, pictures, strict=True):
        shown = show_map(axis, 100 * picture, extent, cmap=DIVERGING, vmin=-12, vmax=12)
        axis.set_facecolor(GREY)
        axis.set(ylabel=f"{name}\nangle, deg", yticks=_TURN)
    axes[-1].set(xlabel="station, m")
    figure.colorbar(shown, ax=axes, label="cm outward", shrink=0.5)
    caption = "Lining unrolled in cells of 10 cm by 2 degrees, smooth part removed; grey: not seen."
    return figure, caption + sheet.note(len(radius))


def _outward_share(real: Returns) -> np.ndarray:
    """Return the part of each beam's direction that points away from the sensor's path, 1."""
    away = real.local[:, 1:] - np.array([0.0, np.median(real.local[:, 2])])
    away = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    return np.einsum("ij,ij->i", real.heading[:, 1:], away)


def _cell_means(station: np.ndarray, angle: np.ndarray, values: np.ndarray) -> np.ndarray:
    shape = (int(np.ptp(station) / _MAP_CELL[0]) + 1, int(360 / _MAP_CELL[1]))
    i = np.minimum(((station - station.min()) / _MAP_CELL[0]).astype(int), shape[0] - 1)
    j = np.minimum(((angle + 180) / _MAP_CELL[1]).astype(int), shape[1] - 1)
    good = np.isfinite(values)
    flat = i[good] * shape[1] + j[good]
    total, count = (np.bincount(flat, weights, shape[0] * shape[1]) for weights in (values[good], None))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(shape)


# Voxels of the bore's shell, and the voxels in which cloud and mesh disagree (the paper's Fig. 3).


def draw_projections(sheet: Sheet) -> Drawn:
    grids, edge = occupied_voxels(sheet.case), VOXEL_EDGE * sheet.case.tolerance
    low = _low_corner(sheet, grids)
    figure, axes = plt.subplots(1, 3, figsize=(13, 3.4), layout="constrained", width_ratios=(3, 3, 1.4))
    for axis, (x, y, along) in zip(axes, _PLANES, strict=True):
        total = grids.first.sum(axis=along).astype(float)
        rest = [k for k in range(3) if k != along]
        picture = show_map(axis, np.where(total > 0, total, np.nan), _extent(low[rest], edge, total.shape),
                           cmap="viridis", norm=LogNorm(1), aspect="equal" if along == 0 else "auto")  # fmt: skip
        axis.set(xlabel=x, ylabel=y)
        figure.colorbar(picture, ax=axis, shrink=0.8, label="voxels" if along == 0 else None)
    caption = f"Occupied voxels of {edge * 100:.0f} cm of the bore's shell, summed along the third axis."
    return figure, caption + sheet.note(int(grids.first.sum()))


def draw_mismatch(sheet: Sheet) -> Drawn:
    grids, edge = occupied_voxels(sheet.case), VOXEL_EDGE * sheet.case.tolerance
    low = _low_corner(sheet, grids)
    figure, (side, unrolled) = plt.subplots(2, 1, figsize=(12, 5.4), layout="constrained", sharex=True)
    flat = _agreement_classes(np.asarray(grids.real.any(axis=1)), np.asarray(grids.first.any(axis=1)))
    rolled = _unroll_classes(grids, low, edge)
    end = low[0] + edge * rolled.shape[0]
    show_map(side, flat, _extent(low[[0, 2]], edge, flat.shape), cmap=CLASSES, vmin=0, vmax=2)
    show_map(unrolled, rolled, (low[0], end, -180, 180), cmap=CLASSES, vmin=0, vmax=2)
    side.set(ylabel="up, m")
    unrolled.set(ylabel="angle from left\ntowards up, deg", xlabel="station, m", yticks=_TURN)
    legend_classes(side, ("both", "mesh only", "held-out cloud only"))
    both, either = int((grids.real & grids.first).sum()), int((grids.real | grids.first).sum())
    caption = f"Voxels of {edge * 100:.0f} cm: from the side and unrolled. {both / max(either, 1):.1%} agree."
    return figure, caption + sheet.note(either)


def _extent(low: np.ndarray, edge: float, shape: tuple[int, ...]) -> tuple[float, float, float, float]:
    return low[0], low[0] + edge * shape[0], low[1], low[1] + edge * shape[1]


def _low_corner(sheet: Sheet, grids: Occupied) -> np.ndarray:
    """Return the low corner of the grid: station, left, up, m."""
    real, edge = returns(sheet.case), VOXEL_EDGE * sheet.case.tolerance
    low = [grids.station[0] - 0.5 * edge]
    first = np.argwhere(grids.real).min(axis=0)
    return np.array(low + [edge * (np.floor(real.local[:, k].min() / edge) - first[k]) for k in (1, 2)])


def _agreement_classes(real: np.ndarray, mesh: np.ndarray) -> np.ndarray:
    """Return 0 for both, 1 for the mesh alone, 2 for the cloud alone, NaN for neither."""
    return np.where(real & mesh, 0.0, np.where(mesh, 1.0, np.where(real, 2.0, np.nan)))


def _unroll_classes(grids: Occupied, low: np.ndarray, edge: float, sectors: int = 90) -> np.ndarray:
    real, mesh = (np.zeros((grids.real.shape[0], sectors), bool) for _ in range(2))
    middle = np.median(low[1:] + edge * (np.argwhere(grids.real)[:, 1:] + 0.5), axis=0)
    for target, grid in ((real, grids.real), (mesh, grids.first)):
        index = np.argwhere(grid)
        place = low[1:] + edge * (index[:, 1:] + 0.5)
        angle = np.arctan2(place[:, 1] - middle[1], place[:, 0] - middle[0])
        target[index[:, 0], np.floor((angle + np.pi) / (2 * np.pi) * sectors).astype(int) % sectors] = True
    return _agreement_classes(real, mesh)
