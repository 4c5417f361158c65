"""The wall between profiles some way apart: seen at a few stations, kriged along the station in between.

Each direction of the section is a function of the station. All share one correlation, chosen by its likelihood from
four families and a range of lengths. The roughest family at a great length is linear interpolation, so that this is
one of the choices.

Source: Rasmussen and Williams 2006, *Gaussian Processes for Machine Learning*, chapters 2, 4.2 and 5.4.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_closing, gaussian_filter1d

from scene.fitting.unroll import Grid, cell_means, cell_medians, fill_around, fill_nearest, median_smooth

_FAMILIES = ("exponential", "matern 3/2", "matern 5/2", "gaussian")
_LENGTHS = 0.3 * 1.2 ** np.arange(20)  # m
_NUGGETS = (1e-3, 1e-2, 0.1)  # of the variance
_WINDOW = 40  # observations a likelihood is taken over
_SAMPLES = 72  # windows and directions it is summed over
_VAGUE = 100.0  # variance, in that of the wall, of the line that each window may lie on
_LIMIT = 4.0  # robust standard deviations at which a value stops counting for more
_UNEVEN = 1.3  # times the median deviation of the windows: more is another wall


@dataclass(frozen=True)
class Correlation:
    """Correlation of the wall at two stations."""

    family: str  # One of `exponential`, `matern 3/2`, `matern 5/2`, `gaussian`
    length: float  # Its length, m
    nugget: float  # Variance of the noise, as a share of that of the wall
    sigma: float  # Standard deviation of the wall about its trend, m

    def __call__(self, distance: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Return the correlation at a distance, m, without the noise."""
        return _correlation(self.family, distance / self.length)


def _correlation(family: str, d: np.ndarray) -> np.ndarray:
    if family == "exponential":
        return np.exp(-d)
    if family == "matern 3/2":
        return (1 + np.sqrt(3) * d) * np.exp(-np.sqrt(3) * d)
    if family == "matern 5/2":
        return (1 + np.sqrt(5) * d + 5 * d**2 / 3) * np.exp(-np.sqrt(5) * d)
    return np.exp(-(d**2))


def choose_correlation(station: Float[np.ndarray, "n m"], value: Float[np.ndarray, "n m"]) -> Correlation:
    """Return the correlation under which the values are likeliest.

    Stations grow along the first axis, m; values, m, are NaN where nothing was seen. Each window that the likelihood is
    taken over may lie on a line of its own (restricted likelihood).
    """
    at, y = _samples(station, value)
    seen = np.isfinite(y)
    off = _remove_line(at, y)
    each = np.nanstd(np.where(seen.any(axis=1, keepdims=True), off, 0.0), axis=1)
    even = each <= _UNEVEN * np.median(each)  # a portal that flares says nothing of the walls elsewhere
    at, y, seen, off = at[even], y[even], seen[even], off[even]
    spread = 1.4826 * np.median(np.abs(off[seen])) if seen.any() else 0.0
    y = np.where(seen, np.clip(off, -_LIMIT * spread, _LIMIT * spread), 0.0)
    if spread < 1e-6 or seen.sum() < max(_WINDOW, 3 * len(seen)):
        return Correlation("exponential", float(_LENGTHS[-1]), _NUGGETS[0], max(spread, 1e-6))
    distance = np.abs(at[:, :, None] - at[:, None, :])
    across = at - at.mean(axis=1, keepdims=True)
    across = across / np.maximum(np.abs(across).max(axis=1, keepdims=True), 1e-9)
    line = _VAGUE * (1.0 + across[:, :, None] * across[:, None, :])
    freedom = seen.sum() - 2 * len(seen)
    best, chosen = -np.inf, Correlation("exponential", float(_LENGTHS[-1]), _NUGGETS[0], spread)
    for family, length in product(_FAMILIES, _LENGTHS):
        shape = _correlation(family, distance / length)
        for nugget in _NUGGETS:
            factor = np.linalg.cholesky(_mask_unseen(shape + line, seen, nugget))
            white = np.linalg.solve(factor, y[:, :, None])
            variance = float((white**2).sum() / freedom)
            half_determinant = float(np.log(np.diagonal(factor, axis1=1, axis2=2)).sum())
            likelihood = -0.5 * freedom * np.log(variance) - half_determinant
            if likelihood > best:
                best, chosen = likelihood, Correlation(family, float(length), nugget, float(np.sqrt(variance)))
    return chosen


def _samples(station: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Windows of some directions, spread evenly over the wall, `(s, w)` each."""
    rows, columns = value.shape
    window = min(_WINDOW, rows)
    starts = np.unique(np.linspace(0, rows - window, max(round(2 * rows / window) - 1, 1)).astype(np.intp))
    stride = max(1, columns * len(starts) // _SAMPLES)
    picked = [(start, column) for start, column in product(starts, range(columns))][::stride]
    return (
        np.stack([station[start : start + window, column] for start, column in picked]),
        np.stack([value[start : start + window, column] for start, column in picked]),
    )


def _remove_line(at: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Subtracts from each window the line fitted to it; NaN stays."""
    mask = np.isfinite(y).astype(float)
    count = np.maximum(mask.sum(axis=1, keepdims=True), 1.0)
    filled = np.where(mask > 0, y, 0.0)
    x = (at - (at * mask).sum(axis=1, keepdims=True) / count) * mask
    slope = (x * filled).sum(axis=1, keepdims=True) / np.maximum((x * x).sum(axis=1, keepdims=True), 1e-9)
    return y - filled.sum(axis=1, keepdims=True) / count - slope * x


def _mask_unseen(shape: np.ndarray, seen: Bool[np.ndarray, "m n"], nugget: float) -> np.ndarray:
    """Covariances of unit variance; an unseen value is independent of the others and so drops out."""
    both = seen[:, :, None] & seen[:, None, :]
    return np.where(both, shape, 0.0) + np.where(seen, nugget, 1.0)[:, :, None] * np.eye(shape.shape[1])


def leave_one_out(
    model: Correlation, station: Float[np.ndarray, "n m"], value: Float[np.ndarray, "n m"]
) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, "n m"]]:
    """Return each value's distance from what the others predict of it, and that prediction's standard deviation, m.

    Both are NaN where nothing was seen.
    """
    at, y = station.T, value.T
    seen = np.isfinite(y)
    inverse = np.linalg.inv(_mask_unseen(model(np.abs(at[:, :, None] - at[:, None, :])), seen, model.nugget))
    own = np.diagonal(inverse, axis1=1, axis2=2)
    miss = np.einsum("mij,mj->mi", inverse, np.where(seen, y, 0.0)) / own
    hidden = np.where(seen, 0.0, np.nan)
    return (miss + hidden).T, (model.sigma / np.sqrt(own) + hidden).T


def predict_wall(
    model: Correlation,
    station: Float[np.ndarray, "n m"],
    value: Float[np.ndarray, "n m"],
    at: Float[np.ndarray, " k"],
) -> tuple[Float[np.ndarray, "k m"], Float[np.ndarray, "k m"]]:
    """Return the wall about its trend at the stations `at`, and its standard deviation, m.

    Values are about their trend, m, and NaN where nothing was seen. Far from all of them the result is 0, with the
    deviation `model.sigma`.
    """
    known, y = station.T, value.T
    seen = np.isfinite(y)
    factor = np.linalg.cholesky(_mask_unseen(model(np.abs(known[:, :, None] - known[:, None, :])), seen, model.nugget))
    cross = np.where(seen[:, :, None], model(np.abs(known[:, :, None] - at[None, None, :])), 0.0)
    half = np.linalg.solve(factor, cross)
    white = np.linalg.solve(factor, np.where(seen, y, 0.0)[:, :, None])
    mean = np.einsum("mnk,mn->mk", half, white[:, :, 0])
    share = np.clip(1.0 - (half**2).sum(axis=1), 0.0, 1.0)
    return mean.T, (model.sigma * np.sqrt(share)).T


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
    """The wall on a fine grid."""

    wall: Float[np.ndarray, "rows cols"]  # m
    sigma: Float[np.ndarray, "rows cols"]  # Its standard deviation, m
    correlation: Correlation  # Correlation that it rests on


def krige_profiles(
    station: Float[np.ndarray, " p"], angle: Float[np.ndarray, " p"], radius: Float[np.ndarray, " p"], fine: Grid
) -> Kriged:
    """Interpolates the wall on the cells of `fine` from points of profiles by station, m, angle, rad, radius, m."""
    at, value = _observations(station, angle, radius, fine)
    for last in (False, True):
        about = value - _trend(at, value, at)
        model = choose_correlation(at, value)
        if not last:
            value = _remove_outliers(model, at, about, value)
    wall, sigma = np.empty((fine.rows, fine.columns)), np.empty((fine.rows, fine.columns))
    for start in np.arange(0.0, fine.rows * fine.step, _BLOCK):
        rows = slice(round(start / fine.step), round((start + _BLOCK) / fine.step))
        where = fine.station[rows]
        near = _rows_near(at, where[0], where[-1])
        mean, sigma[rows] = predict_wall(model, at[near], about[near], where)
        wall[rows] = mean + _trend(at, value, np.repeat(where[:, None], fine.columns, axis=1))
    return Kriged(fill_nearest(wall), sigma, model)


def _rows_near(at: np.ndarray, first: float, last: float) -> slice:
    middle = np.nanmean(at, axis=1)
    rows = np.flatnonzero((middle > first - _REACH) & (middle < last + _REACH))
    return slice(rows[0], rows[-1] + 1) if len(rows) else slice(0, len(middle))


def _observations(
    station: np.ndarray, angle: np.ndarray, radius: np.ndarray, fine: Grid
) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, "n m"]]:
    """Mean station and cleaned radius of each seen cell of the profiles; empty rows are left out."""
    grid = Grid.over(fine.start - _BESIDE, fine.start + fine.rows * fine.step + _BESIDE, _ROW, fine.columns)
    cell = grid.cell(station, angle)
    value = cell_medians(grid, cell, radius)
    mean, count = cell_means(grid, cell, station, np.ones(len(station)))
    value[count < _MIN_COUNT] = np.nan
    rows = np.isfinite(value).mean(axis=1) > _MIN_SEEN
    value, mean = value[rows], np.where(np.isfinite(value), mean, np.nan)[rows]
    seen = np.isfinite(value)
    bridged = binary_closing(np.concatenate([seen] * 3, axis=1), np.ones((1, _BRIDGED + 1), bool))
    seen |= bridged[:, fine.columns : 2 * fine.columns]
    return fill_around(mean), np.where(seen, _remove_cables(fill_around(value)), np.nan)


def _remove_cables(value: np.ndarray) -> np.ndarray:
    """Replaces what is as thin as a cable, and smooths each profile over neighbouring columns."""
    usual = median_smooth(value, (1, _CABLE))
    return gaussian_filter1d(np.where(np.abs(value - usual) > _OFF, usual, value), _SIGMA, axis=1, mode="wrap")


def _trend(at: np.ndarray, value: np.ndarray, where: np.ndarray) -> Float[np.ndarray, "k m"]:
    """Return a line fitted around each place in each direction, so that a flare or a widening is no deviation."""
    seen = np.isfinite(value)
    known, station = np.nanmedian(at, axis=1), np.median(where, axis=1)
    apart = known[None] - station[:, None]
    weight = np.exp(-0.5 * (apart / _TREND) ** 2) + 1e-9
    y, mask = np.where(seen, value, 0.0), seen.astype(float)
    s0, s1, s2 = (w @ mask for w in (weight, weight * apart, weight * apart**2))
    t0, t1 = weight @ y, (weight * apart) @ y
    spread = s0 * s2 - s1**2
    lean = np.divide(s0 * t1 - s1 * t0, spread, out=np.zeros_like(s0), where=spread > 0.25 * s0**2)
    middle = np.divide(t0 - lean * s1, s0, out=np.full_like(s0, np.nan), where=s0 > 1e-12)
    return middle + lean * (where - station[:, None])


def _remove_outliers(model: Correlation, at: np.ndarray, about: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return the values without those that their neighbours along the bore contradict: people, gaps, pockets."""
    result = value.copy()
    middle = np.median(at, axis=1)
    for start in np.arange(middle[0], middle[-1] + 1e-6, _BLOCK):
        near = _rows_near(at, start, start + _BLOCK)
        miss, deviation = leave_one_out(model, at[near], about[near])
        outlying = np.abs(miss) > np.maximum(_OUTLIER * deviation, _LEAST_OUTLIER)
        outlying &= outlying.mean(axis=1, keepdims=True) < _MOST_OUTLIERS
        part = result[near]
        part[outlying] = np.nan
    return result
