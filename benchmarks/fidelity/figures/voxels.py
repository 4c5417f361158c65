"""Voxels: the three projections of the bore's shell, and where cloud and mesh disagree (the paper's Fig. 3)."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.patches import Patch

from benchmarks.fidelity.derive.beams import returns
from benchmarks.fidelity.derive.voxels import EDGE, occupied
from benchmarks.fidelity.figures import Drawn, Sheet
from benchmarks.fidelity.figures.style import AGREE, ONLY_CLOUD, ONLY_MESH

_PLANES = (("station, m", "left, m", 2), ("station, m", "up, m", 1), ("left, m", "up, m", 0))


def projections(sheet: Sheet) -> Drawn | None:
    """F1: occupied voxels of the mesh as held-out beams see it, summed along each axis."""
    if sheet.case.hold is None:
        return None
    grids, edge = occupied(sheet.case), EDGE * sheet.case.tolerance
    low = _low(sheet, grids)
    figure, axes = plt.subplots(1, 3, figsize=(13, 3.4), layout="constrained", width_ratios=(3, 3, 1.4))
    for axis, (x, y, along) in zip(axes, _PLANES, strict=True):
        total = grids.first.sum(axis=along).astype(float)
        rest = [k for k in range(3) if k != along]
        extent = [
            low[rest[0]],
            low[rest[0]] + edge * total.shape[0],
            low[rest[1]],
            low[rest[1]] + edge * total.shape[1],
        ]
        aspect = "equal" if along == 0 else "auto"
        picture = axis.imshow(
            np.where(total > 0, total, np.nan).T,
            origin="lower",
            extent=extent,
            aspect=aspect,
            cmap="viridis",
            norm=LogNorm(1),
        )
        axis.set(xlabel=x, ylabel=y)
        figure.colorbar(picture, ax=axis, shrink=0.8, label="voxels" if along == 0 else None)
    return (
        figure,
        f"Occupied voxels of {edge * 100:.0f} cm of the bore's shell, summed along the third axis."
        + sheet.note(int(grids.first.sum())),
    )


def mismatch(sheet: Sheet) -> Drawn | None:
    """F2: agreement by voxel from the side, and unrolled."""
    if sheet.case.hold is None:
        return None
    grids, edge = occupied(sheet.case), EDGE * sheet.case.tolerance
    low = _low(sheet, grids)
    figure, (side, unrolled) = plt.subplots(2, 1, figsize=(12, 5.4), layout="constrained", sharex=True)
    colours = ListedColormap([AGREE, ONLY_MESH, ONLY_CLOUD])
    picture = _classes(np.asarray(grids.real.any(axis=1)), np.asarray(grids.first.any(axis=1)))
    extent = [low[0], low[0] + edge * picture.shape[0], low[2], low[2] + edge * picture.shape[1]]
    side.imshow(
        picture.T, origin="lower", extent=extent, aspect="auto", cmap=colours, vmin=0, vmax=2, interpolation="nearest"
    )
    side.set(ylabel="up, m")
    rolled = _unrolled(grids, low, edge)
    extent = [low[0], low[0] + edge * rolled.shape[0], -180, 180]
    unrolled.imshow(
        rolled.T, origin="lower", extent=extent, aspect="auto", cmap=colours, vmin=0, vmax=2, interpolation="nearest"
    )
    unrolled.set(ylabel="angle from left\ntowards up, deg", xlabel="station, m", yticks=(-180, -90, 0, 90, 180))
    names = (("both", AGREE), ("mesh only", ONLY_MESH), ("held-out cloud only", ONLY_CLOUD))
    side.legend(
        handles=[Patch(color=c, label=n) for n, c in names],
        loc="upper center",
        bbox_to_anchor=(0.5, 1.22),
        ncol=3,
        frameon=False,
    )
    both, either = int((grids.real & grids.first).sum()), int((grids.real | grids.first).sum())
    return (
        figure,
        f"Voxels of {edge * 100:.0f} cm: from the side and unrolled. {both / max(either, 1):.1%} agree."
        + sheet.note(either),
    )


def _low(sheet: Sheet, grids) -> np.ndarray:
    real, edge = returns(sheet.case), EDGE * sheet.case.tolerance
    low = [grids.station[0] - 0.5 * edge]
    first = np.argwhere(grids.real).min(axis=0)
    return np.array(low + [edge * (np.floor(real.local[:, k].min() / edge) - first[k]) for k in (1, 2)])


def _classes(real: np.ndarray, mesh: np.ndarray) -> np.ndarray:
    return np.where(real & mesh, 0.0, np.where(mesh, 1.0, np.where(real, 2.0, np.nan)))


def _unrolled(grids, low: np.ndarray, edge: float, sectors: int = 90) -> np.ndarray:
    real, mesh = (np.zeros((grids.real.shape[0], sectors), bool) for _ in range(2))
    for target, grid in ((real, grids.real), (mesh, grids.first)):
        index = np.argwhere(grid)
        place = low[1:] + edge * (index[:, 1:] + 0.5)
        middle = np.median(low[1:] + edge * (np.argwhere(grids.real)[:, 1:] + 0.5), axis=0)
        angle = np.arctan2(place[:, 1] - middle[1], place[:, 0] - middle[0])
        target[index[:, 0], np.floor((angle + np.pi) / (2 * np.pi) * sectors).astype(int) % sectors] = True
    return _classes(real, mesh)
