"""Occupied voxels of held-out and synthetic points, in station, left and up along the sensor's path."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from benchmarks.fidelity.case import Case, derived, of_hold, until
from benchmarks.fidelity.derive.beams import local_at, noisy, returns
from benchmarks.fidelity.derive.packing import cells

EDGE = 0.20  # m
SHELL = 3  # voxels about either surface that count for kappa: 0.6 m
_LAST = 1.5  # m of a beam before its return that are known to be free
_STEP = 0.1  # m between samples along it
_AROUND = 12.0  # m from the path; what lies farther is no tunnel
_RAYS = 150_000


@dataclass(frozen=True)
class Occupied:
    """Voxels on one grid, axes station, left, up, `(i, j, k)` each.

    Attributes:
        real: Holds a held-out point.
        first: Holds a point of the first noisy draw in the candidate.
        second: Of the second draw; differs from the first in noise alone.
        known: The held-out beams tell what is there, or one of the surfaces is.
        station: Of the middle of each slice, m, `(i,)`.
    """

    real: Bool[np.ndarray, "i j k"]
    first: Bool[np.ndarray, "i j k"]
    second: Bool[np.ndarray, "i j k"]
    known: Bool[np.ndarray, "i j k"]
    station: Float[np.ndarray, " i"]


@until("OCC")
@derived
def occupied(case: Case) -> Occupied:
    """Held-out and synthetic points, and what is known about the voxels near them."""
    edge = EDGE * case.tolerance
    real = returns(case)
    clouds = [_indices(real.local, edge)]
    for draw in ("first", "second"):
        clouds.append(_indices(local_at(case, noisy(case, draw)), edge))
    both = np.concatenate(clouds[:2])
    low, high = both.min(axis=0) - SHELL - 1, both.max(axis=0) + SHELL + 2
    grids = [_filled(cloud, low, high) for cloud in (*clouds, free(case))]
    station = (np.arange(low[0], high[0]) + 0.5) * edge
    return Occupied(grids[0], grids[1], grids[2], grids[0] | grids[1] | grids[3], station)


@of_hold
def free(case: Case) -> Int[np.ndarray, "n 3"]:
    """Indices of voxels through which held-out beams passed in the last metres before their returns."""
    real = returns(case)
    pick = np.linspace(0, len(real.range) - 1, min(len(real.range), _RAYS)).astype(int)
    edge = EDGE * case.tolerance
    before = np.arange(edge, _LAST, _STEP)
    steps = (real.local[pick] - back * real.heading[pick] for back in before)
    return np.unique(np.concatenate([_indices(step, edge) for step in steps]), axis=0)


def dilated(grid: Bool[np.ndarray, "i j k"], by: int = 1) -> Bool[np.ndarray, "i j k"]:
    """A grid grown by whole voxels in every direction."""
    return ndimage.maximum_filter(grid.astype(np.uint8), 2 * by + 1, mode="constant").astype(bool)


def shell(grids: Occupied) -> Bool[np.ndarray, "i j k"]:
    """Known voxels within `SHELL` of either surface."""
    return grids.known & dilated(grids.real | grids.first, SHELL)


def iou(a: Bool[np.ndarray, "..."], b: Bool[np.ndarray, "..."]) -> float:
    """Intersection over union."""
    return float((a & b).sum() / max((a | b).sum(), 1))


def tolerant(grids: Occupied, group: Int[np.ndarray, " i"]) -> Float[np.ndarray, " g"]:
    """F1 with a tolerance of one voxel for each group of slices; 0 where one of the surfaces is not there.

    Args:
        grids: Both surfaces.
        group: Number of the group of each slice.
    """
    counts = [
        np.bincount(group, grid.sum(axis=(1, 2)))
        for grid in (
            grids.real, grids.first, grids.real & dilated(grids.first), grids.first & dilated(grids.real)
        )
    ]  # fmt: skip
    recall, precision = counts[2] / np.maximum(counts[0], 1), counts[3] / np.maximum(counts[1], 1)
    return 2.0 * precision * recall / np.maximum(precision + recall, 1e-12)


def _indices(local: Float[np.ndarray, "n 3"], edge: float) -> Int[np.ndarray, "n 3"]:
    near = local[(np.abs(local[:, 1:]) < _AROUND).all(axis=1)]
    return np.floor(near[np.unique(cells(near, edge), return_index=True)[1]] / edge).astype(np.int64)


def _filled(index: Int[np.ndarray, "n 3"], low: Int[np.ndarray, "3"], high: Int[np.ndarray, "3"]) -> np.ndarray:
    grid = np.zeros(tuple(high - low), bool)
    inside = ((index >= low) & (index < high)).all(axis=1)
    grid[tuple((index[inside] - low).T)] = True
    return grid
