"""How sure a wall is: its standard deviation where it was seen and where it was not, as one probability a station."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_dilation, distance_transform_edt
from scipy.special import erf

from scene.fitting.unroll import Grid

TOLERANCE = 0.05  # m; "known" is known within this
_AROUND = (3, 2)  # cells of 5 cm × 1° that one return speaks for
_SEEN = 0.01  # m, standard deviation of a wall seen in nearly every cell
UNSEEN = 0.02  # m for each metre from the nearest cell seen, however even the wall is elsewhere
_LAGS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # m


def sure_by_support(
    wall: Float[np.ndarray, "rows cols"], seen: Bool[np.ndarray, "rows cols"], grid: Grid
) -> Float[np.ndarray, "rows cols"]:
    """Standard deviation of a wall held over what was not seen, m.

    It is what the same wall changes by, root mean square, over the distance along the bore to the nearest cell that
    was seen; where a whole direction was not seen, over the greatest distance that was tried, 8 m. At least
    2 cm for each metre.

    Args:
        wall: The wall, m.
        seen: Cells with returns on it.
        grid: Its cells.
    """
    near = binary_dilation(seen, np.ones((2 * _AROUND[0] + 1, 2 * _AROUND[1] + 1), bool))
    sampling = (grid.step, 2 * np.pi * float(np.median(wall)) / grid.columns)
    wrapped = np.concatenate([near, near, near], axis=1)
    distance = distance_transform_edt(~wrapped, sampling=sampling)[:, grid.columns : 2 * grid.columns]
    lags = [lag for lag in _LAGS if round(lag / grid.step) < grid.rows] or [grid.step]
    change = [_change(wall, near, max(round(lag / grid.step), 1)) for lag in lags]
    held = np.interp(distance, [0.0, *lags], [0.0, *np.maximum.accumulate(change)])
    return np.hypot(_SEEN, np.maximum(held, UNSEEN * distance))


def _change(wall: np.ndarray, seen: np.ndarray, rows: int) -> float:
    """Root mean square difference of seen cells so many rows apart, m."""
    both = seen[rows:] & seen[:-rows]
    difference = (wall[rows:] - wall[:-rows])[both]
    return float(np.sqrt(np.mean(difference**2))) if len(difference) else 0.0


def known(sigma: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Probability that an error of standard deviation `sigma`, m, is below 5 cm."""
    return erf(TOLERANCE / np.maximum(sigma, 1e-9) / np.sqrt(2))
