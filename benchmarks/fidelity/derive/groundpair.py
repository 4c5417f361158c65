"""The two grounds that are compared: by rays against the truth, by the same beams against a recording."""

from dataclasses import replace

import numpy as np
import shapely
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt

from benchmarks.fidelity.case import Case, derived, of_hold
from benchmarks.fidelity.derive.beams import synthetic
from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.derive.ground import CELL, Ground, axes, judged_ground, steps, true_ground
from benchmarks.fidelity.derive.profiles import grouped_median
from benchmarks.fidelity.derive.reference_axis import hold_curve, hold_local, reference_curve
from benchmarks.fidelity.derive.sections import sections, widths

_SPREAD = (-2, -1, 0, 1, 2)  # rows whose returns a cell shares: one row has too few, and rails run along
_HIGH = 0.8  # of the returns in a cell lie lower than its ground: a rail fills only a part of it
_GAP = 3  # cells without a return that are taken from their neighbours
_WALL = 0.6  # m above the middle of the ground; a return higher up is of the wall
_CORNER = 0.25  # m before the wall
_FOOT = 0.3  # m above the floor where the wall's distance is taken
_FLOOR = -1.0  # m above the axis; returns below it are of the ground


@derived
def both_grounds(case: Case) -> tuple[Ground, Ground]:
    """Candidate and truth, by rays; without a truth candidate and recording by the same held-out beams.

    Beams that graze the ground leave gaps and blur steps; with the same beams and noise they do so on both sides.
    The last 25 cm before the reference's wall are left out: the robot's middle cannot get there.
    """
    if case.truth is not None:
        judged, reference = judged_ground(case), true_ground(case)
    else:
        judged, reference = _observed_ground(case), _seen_ground(case)
    cut = sections(case)
    low = shapely.bounds(cut.reference_outline)[:, 1] + _FOOT
    reach = np.interp(reference.station, cut.station, widths(cut.reference_outline, low) / 2 - _CORNER)
    off = np.abs(reference.left) > reach[:, None]
    left_out = [replace(side, step=np.where(off, np.nan, side.step)) for side in (judged, reference)]
    return left_out[0], left_out[1]


@derived
def _observed_ground(case: Case) -> Ground:
    curve, points = reference_curve(case), synthetic(case)
    return _seen(curve, CELL * case.tolerance, curve.local(points[np.isfinite(points).all(axis=1)]))


@of_hold
def _seen_ground(case: Case) -> Ground:
    return _seen(hold_curve(case), CELL * case.tolerance, hold_local(case))


def _seen(curve: Curve, cell: float, local: Float[np.ndarray, "k 3"]) -> Ground:
    station, left = axes(curve, cell)
    low = local[local[:, 2] < _FLOOR]
    row = np.floor((low[:, 0] - station[0]) / cell + 0.5).astype(int)
    column = np.round(low[:, 1] / cell).astype(int) + len(left) // 2
    spread = np.concatenate([row + shift for shift in _SPREAD])
    column, above = np.tile(column, len(_SPREAD)), np.tile(low[:, 2], len(_SPREAD))
    kept = (spread >= 0) & (spread < len(station)) & (column >= 0) & (column < len(left))
    flat = spread[kept] * len(left) + column[kept]
    height = grouped_median(flat, above[kept], len(station) * len(left), share=_HIGH).reshape(len(station), -1)
    wall = np.nanquantile(height, 0.5) + _WALL
    height = np.where(height < wall, height, np.nan)
    away, nearest = distance_transform_edt(np.isnan(height), return_indices=True)
    height = np.where(away <= _GAP, height[tuple(nearest)], np.nan)
    return Ground(station, left, height, np.where(np.isfinite(height), np.inf, np.nan), steps(height))
