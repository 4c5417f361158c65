"""Ring joints by the steps of the wall: segments on either side of a joint stand a few millimetres apart.

One step is lost in the noise. But rings are alike in length, so that the mean square of all steps, folded to one ring,
peaks at the joint, whatever segments and pockets do. A joint is known where that place beats every other, ring by
ring, by more than chance.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import uniform_filter1d

from scene.fitting.section import Sections

_BEFORE = 0.4  # m before and behind a place, over which the wall is averaged
_AROUND = 9  # columns over which steps are averaged: far less than a segment
_MIN_WEIGHT = 6.0  # returns before and behind, at most 50 of a cell
_MOST = 0.02  # m, more than segments stand apart
_BIN = 0.05  # m along a ring
_RIVAL = 0.3  # m from the joint: other places in a ring
_MIN_T = 4.0  # Student's t of the joint against each of them
_PEAK = 0.15  # m about the fullest place, over which it is centred


def find_joints_by_steps(
    sections: Sections, hole: Bool[np.ndarray, "rows cols"], pitch: float
) -> Float[np.ndarray, " r"]:
    """Finds the stations of the ring joints from the start of the grid, m; empty where steps do not tell them.

    `hole` are cells of pockets and other holes, whose rims would be steps; `pitch` is the length of a ring, m.
    """
    grid = sections.grid
    station, step = _mean_square_steps(sections, ~hole)
    bins = max(round(pitch / _BIN), 8)
    ring = np.floor(station / pitch).astype(int)
    place = np.minimum((np.mod(station, pitch) / pitch * bins).astype(int), bins - 1)
    rows = ring.max(initial=-1) + 1
    cell, known = ring * bins + place, np.isfinite(step)
    count = np.bincount(cell[known], minlength=rows * bins).reshape(rows, bins)
    total = np.bincount(cell[known], step[known], rows * bins).reshape(rows, bins)
    if rows < 2 or not (count.sum(axis=0) > 0).all():
        return np.empty(0)
    mean = total.sum(axis=0) / count.sum(axis=0)
    best = int(np.argmax(mean))
    apart = (np.mod(np.arange(bins) - best + bins / 2, bins) - bins / 2) * pitch / bins
    each = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    if min(_student(each[:, best] - each[:, rival]) for rival in np.flatnonzero(np.abs(apart) >= _RIVAL)) < _MIN_T:
        return np.empty(0)
    near = np.abs(apart) < _PEAK
    above = np.maximum(mean[near] - np.median(mean), 0.0)
    joint = (best + 0.5) * pitch / bins + float(above @ apart[near] / above.sum())
    return np.arange(joint % pitch, grid.rows * grid.step, pitch)


def _student(difference: Float[np.ndarray, " r"]) -> float:
    """Return Student's t of a mean that differs from 0; 0 for fewer than three values."""
    difference = difference[np.isfinite(difference)]
    if len(difference) < 3:
        return 0.0
    return float(difference.mean() / (difference.std(ddof=1) + 1e-12) * np.sqrt(len(difference)))


def _mean_square_steps(
    sections: Sections, use: Bool[np.ndarray, "rows cols"]
) -> tuple[Float[np.ndarray, " e"], Float[np.ndarray, " e"]]:
    """Return edges between rows, m from the start of the grid, and the mean square step of the wall there, m².

    It is NaN where too little was seen.
    """
    n = round(_BEFORE / sections.grid.step)
    weight = np.where(sections.inlier & use, np.minimum(sections.weight, 50.0), 0.0)
    wall = sections.radius + sections.residual
    padded = [np.pad(field.cumsum(axis=0), ((1, 0), (0, 0))) for field in (weight, weight * wall)]
    edge = np.arange(n, sections.grid.rows - n + 1)
    before, ahead = ([field[e + n] - field[e] for field in padded] for e in (edge - n, edge))
    seen = (before[0] > _MIN_WEIGHT) & (ahead[0] > _MIN_WEIGHT)
    step = ahead[1] / np.maximum(ahead[0], 1e-9) - before[1] / np.maximum(before[0], 1e-9)
    sure = np.where(seen, before[0] * ahead[0] / np.maximum(before[0] + ahead[0], 1e-9), 0.0)
    total = uniform_filter1d(sure, _AROUND, axis=1, mode="wrap")
    around = uniform_filter1d(sure * step, _AROUND, axis=1, mode="wrap") / np.maximum(total, 1e-9)
    known = total > _MIN_WEIGHT
    square = np.where(known, np.clip(around, -_MOST, _MOST) ** 2, 0.0).sum(axis=1)
    enough = known.sum(axis=1) > sections.grid.columns / 4
    return edge * sections.grid.step, np.where(enough, square / np.maximum(known.sum(axis=1), 1), np.nan)
