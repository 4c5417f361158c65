"""Kriging along the station: what a wall does between the places where it was seen, and how sure that is.

Each direction of the section is a function of the station. All share one correlation, chosen by its likelihood from
four families and a range of lengths; the roughest family at a great length is linear interpolation, so that this is
one of the choices.

Source: Rasmussen and Williams 2006, *Gaussian Processes for Machine Learning*, chapters 2, 4.2 and 5.4.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float

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
    """How alike the wall is at two stations.

    Attributes:
        family: One of `exponential`, `matern 3/2`, `matern 5/2`, `gaussian`.
        length: Its length, m.
        nugget: Variance of the noise, as a share of that of the wall.
        sigma: Standard deviation of the wall about its trend, m.
    """

    family: str
    length: float
    nugget: float
    sigma: float

    def __call__(self, distance: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Correlation at a distance, m; noise apart."""
        return _correlation(self.family, distance / self.length)


def _correlation(family: str, d: np.ndarray) -> np.ndarray:
    if family == "exponential":
        return np.exp(-d)
    if family == "matern 3/2":
        return (1 + np.sqrt(3) * d) * np.exp(-np.sqrt(3) * d)
    if family == "matern 5/2":
        return (1 + np.sqrt(5) * d + 5 * d**2 / 3) * np.exp(-np.sqrt(5) * d)
    return np.exp(-(d**2))


def choose(station: Float[np.ndarray, "n m"], value: Float[np.ndarray, "n m"]) -> Correlation:
    """The correlation under which the values are likeliest.

    Args:
        station: Of each value, growing along the first axis, m.
        value: m; NaN where nothing was seen. Each window that the likelihood is taken over may lie on a line of
            its own (restricted likelihood).
    """
    at, y = _samples(station, value)
    seen = np.isfinite(y)
    off = _without_line(at, y)
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
            factor = np.linalg.cholesky(_masked(shape + line, seen, nugget))
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


def _without_line(at: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Each window less the line fitted to it; NaN stays."""
    mask = np.isfinite(y).astype(float)
    count = np.maximum(mask.sum(axis=1, keepdims=True), 1.0)
    filled = np.where(mask > 0, y, 0.0)
    x = (at - (at * mask).sum(axis=1, keepdims=True) / count) * mask
    slope = (x * filled).sum(axis=1, keepdims=True) / np.maximum((x * x).sum(axis=1, keepdims=True), 1e-9)
    return y - filled.sum(axis=1, keepdims=True) / count - slope * x


def _masked(shape: np.ndarray, seen: Bool[np.ndarray, "m n"], nugget: float) -> np.ndarray:
    """Covariances with unit variance; what was not seen is independent of all else and so drops out."""
    both = seen[:, :, None] & seen[:, None, :]
    return np.where(both, shape, 0.0) + np.where(seen, nugget, 1.0)[:, :, None] * np.eye(shape.shape[1])


def left_out(
    model: Correlation, station: Float[np.ndarray, "n m"], value: Float[np.ndarray, "n m"]
) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, "n m"]]:
    """Distance of each value from what the others predict of it, and that prediction's standard deviation, m.

    NaN where nothing was seen.
    """
    at, y = station.T, value.T
    seen = np.isfinite(y)
    inverse = np.linalg.inv(_masked(model(np.abs(at[:, :, None] - at[:, None, :])), seen, model.nugget))
    own = np.diagonal(inverse, axis1=1, axis2=2)
    miss = np.einsum("mij,mj->mi", inverse, np.where(seen, y, 0.0)) / own
    hidden = np.where(seen, 0.0, np.nan)
    return (miss + hidden).T, (model.sigma / np.sqrt(own) + hidden).T


def predict(
    model: Correlation,
    station: Float[np.ndarray, "n m"],
    value: Float[np.ndarray, "n m"],
    at: Float[np.ndarray, " k"],
) -> tuple[Float[np.ndarray, "k m"], Float[np.ndarray, "k m"]]:
    """The wall about its trend at other stations, and its standard deviation, m.

    Args:
        model: The correlation.
        station: Of each value, m.
        value: About their trend, m; NaN where nothing was seen.
        at: Where to, m. Far from every value the result is 0 with the deviation `model.sigma`.
    """
    known, y = station.T, value.T
    seen = np.isfinite(y)
    factor = np.linalg.cholesky(_masked(model(np.abs(known[:, :, None] - known[:, None, :])), seen, model.nugget))
    cross = np.where(seen[:, :, None], model(np.abs(known[:, :, None] - at[None, None, :])), 0.0)
    half = np.linalg.solve(factor, cross)
    white = np.linalg.solve(factor, np.where(seen, y, 0.0)[:, :, None])
    mean = np.einsum("mnk,mn->mk", half, white[:, :, 0])
    share = np.clip(1.0 - (half**2).sum(axis=1), 0.0, 1.0)
    return mean.T, (model.sigma * np.sqrt(share)).T
