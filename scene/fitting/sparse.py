"""The wall between profiles some way apart: seen at a few stations, kriged in between."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.ndimage import binary_closing, gaussian_filter1d

from scene.fitting import kriging, unroll
from scene.fitting.kriging import Correlation
from scene.fitting.unroll import Grid

_ROW = 0.25  # m of station that make one observation
_CABLE = 5  # columns: what is narrower than half of it and stands off the wall is none
_OFF = 0.03  # m
_SIGMA = 0.7  # columns
_TREND = 6.0  # m, standard deviation of the weights of the local line
_OUTLIER = 4.0  # standard deviations of the prediction that leaves the value out
_LEAST_OUTLIER = 0.10  # m
_MOST_OUTLIERS = 0.25  # of a profile: more of it is a wall that steps, not something that stands in front of one
_BLOCK = 20.0  # m predicted at once
_REACH = 8.0  # m of observations beside a block; correlations further off are screened by those between
_BESIDE = 1.0  # m beyond the ends: the outermost profiles may stand aslant
_MIN_COUNT = 2  # points a cell
_MIN_SEEN = 0.1  # of a profile
_BRIDGED = 4  # columns without a return that a profile is drawn straight across


@dataclass(frozen=True)
class Kriged:
    """The wall on a fine grid.

    Attributes:
        wall: m, `(rows, cols)`.
        sigma: Its standard deviation, m, `(rows, cols)`.
        correlation: What it rests on.
    """

    wall: Float[np.ndarray, "rows cols"]
    sigma: Float[np.ndarray, "rows cols"]
    correlation: Correlation


def krige(
    station: Float[np.ndarray, " p"], angle: Float[np.ndarray, " p"], radius: Float[np.ndarray, " p"], fine: Grid
) -> Kriged:
    """The wall through profiles, followed between them as their own likeness along the bore allows.

    Args:
        station: Of the points, m.
        angle: Of the points, rad.
        radius: Of the points, m.
        fine: Where the wall is wanted.
    """
    at, value = _observations(station, angle, radius, fine)
    for last in (False, True):
        about = value - _trend(at, value, at)
        model = kriging.choose(at, value)
        if not last:
            value = _without_outliers(model, at, about, value)
    wall, sigma = np.empty((fine.rows, fine.columns)), np.empty((fine.rows, fine.columns))
    for start in np.arange(0.0, fine.rows * fine.step, _BLOCK):
        rows = slice(round(start / fine.step), round((start + _BLOCK) / fine.step))
        where = fine.station[rows]
        near = _near(at, where[0], where[-1])
        mean, sigma[rows] = kriging.predict(model, at[near], about[near], where)
        wall[rows] = mean + _trend(at, value, np.repeat(where[:, None], fine.columns, axis=1))
    return Kriged(unroll.fill_nearest(wall), sigma, model)


def _near(at: np.ndarray, first: float, last: float) -> slice:
    middle = np.nanmean(at, axis=1)
    rows = np.flatnonzero((middle > first - _REACH) & (middle < last + _REACH))
    return slice(rows[0], rows[-1] + 1) if len(rows) else slice(0, len(middle))


def _observations(
    station: np.ndarray, angle: np.ndarray, radius: np.ndarray, fine: Grid
) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, "n m"]]:
    """Mean station and clean radius of each seen cell of the profiles; rows without any are left out."""
    grid = Grid.over(fine.start - _BESIDE, fine.start + fine.rows * fine.step + _BESIDE, _ROW, fine.columns)
    cell = grid.cell(station, angle)
    value = unroll.medians(grid, cell, radius)
    mean, count = unroll.means(grid, cell, station, np.ones(len(station)))
    value[count < _MIN_COUNT] = np.nan
    rows = np.isfinite(value).mean(axis=1) > _MIN_SEEN
    value, mean = value[rows], np.where(np.isfinite(value), mean, np.nan)[rows]
    seen = np.isfinite(value)
    bridged = binary_closing(np.concatenate([seen] * 3, axis=1), np.ones((1, _BRIDGED + 1), bool))
    seen |= bridged[:, fine.columns : 2 * fine.columns]
    return unroll.fill_along(mean), np.where(seen, _clean_around(unroll.fill_along(value)), np.nan)


def _clean_around(value: np.ndarray) -> np.ndarray:
    """Each profile without what is as thin as a cable, its noise smoothed over neighbouring columns."""
    usual = unroll.median_smooth(value, (1, _CABLE))
    return gaussian_filter1d(np.where(np.abs(value - usual) > _OFF, usual, value), _SIGMA, axis=1, mode="wrap")


def _trend(at: np.ndarray, value: np.ndarray, where: np.ndarray) -> Float[np.ndarray, "k m"]:
    """A line fitted around each place in each direction, so that a flare or a widening is no deviation."""
    seen = np.isfinite(value)
    known, wanted = np.nanmedian(at, axis=1), np.median(where, axis=1)
    apart = known[None] - wanted[:, None]
    weight = np.exp(-0.5 * (apart / _TREND) ** 2) + 1e-9
    y, mask = np.where(seen, value, 0.0), seen.astype(float)
    s0, s1, s2 = (w @ mask for w in (weight, weight * apart, weight * apart**2))
    t0, t1 = weight @ y, (weight * apart) @ y
    spread = s0 * s2 - s1**2
    lean = np.divide(s0 * t1 - s1 * t0, spread, out=np.zeros_like(s0), where=spread > 0.25 * s0**2)
    middle = np.divide(t0 - lean * s1, s0, out=np.full_like(s0, np.nan), where=s0 > 1e-12)
    return middle + lean * (where - wanted[:, None])


def _without_outliers(model: Correlation, at: np.ndarray, about: np.ndarray, value: np.ndarray) -> np.ndarray:
    """The values without those that their neighbours along the bore contradict: people, gaps, pockets."""
    result = value.copy()
    middle = np.median(at, axis=1)
    for start in np.arange(middle[0], middle[-1] + 1e-6, _BLOCK):
        near = _near(at, start, start + _BLOCK)
        miss, deviation = kriging.left_out(model, at[near], about[near])
        outlying = np.abs(miss) > np.maximum(_OUTLIER * deviation, _LEAST_OUTLIER)
        outlying &= outlying.mean(axis=1, keepdims=True) < _MOST_OUTLIERS
        part = result[near]
        part[outlying] = np.nan
    return result
