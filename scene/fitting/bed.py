"""The flat floor along the whole bore, and the walls run on straight into its corners."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d, median_filter

from scene.fitting import floor
from scene.fitting.unroll import Grid

_STEP = 0.5  # m
_SIGMA = 1.0  # m
_CORNER = (0.15, 0.90)  # heights above the floor between which a wall is fitted to be run on down, m


@dataclass(frozen=True)
class Floors:
    """Floor lines of sections.

    Attributes:
        station: m, `(k,)`.
        height: On the axis, m, `(k,)`.
        slope: Rise for each metre to the left, `(k,)`.
    """

    station: Float[np.ndarray, " k"]
    height: Float[np.ndarray, " k"]
    slope: Float[np.ndarray, " k"]

    def radius(self, grid: Grid) -> Float[np.ndarray, "rows cols"]:
        """Distance from the axis to the floor in each direction, m; `inf` where it is not met."""
        height = np.interp(grid.station, self.station, self.height)[:, None]
        slope = np.interp(grid.station, self.station, self.slope)[:, None]
        descent = np.sin(grid.angle) - slope * np.cos(grid.angle)
        return np.where(descent < -1e-3, height / np.minimum(descent, -1e-3), np.inf)


def find_floors(
    station: np.ndarray, lateral: np.ndarray, upward: np.ndarray, start: float, end: float
) -> Floors | None:
    """A floor line every half metre, smoothed along; `None` where fewer than half of the sections have one."""
    count = max(int((end - start) / _STEP), 1)
    middle = start + (np.arange(count) + 0.5) * (end - start) / count
    order = np.argsort(station, kind="stable")
    bounds = np.searchsorted(station[order], start + np.arange(count + 1) * (end - start) / count)
    lines = []
    for k in range(count):
        rows = order[bounds[k] : bounds[k + 1]]
        rows = rows[:: max(1, len(rows) // 4000)]
        line = floor.fit_line(lateral[rows], upward[rows])
        if line is not None:
            lines.append((middle[k], *line))
    if len(lines) < 0.5 * count:
        return None
    at, height, slope = np.asarray(lines).T
    sigma = _SIGMA / (end - start) * count
    height, slope = (
        gaussian_filter1d(median_filter(v, 3, mode="nearest"), sigma, mode="nearest") for v in (height, slope)
    )
    return Floors(at, height, slope)


def stand_on(wall: np.ndarray, grid: Grid, floors: Floors) -> np.ndarray:
    """Replaces what lies below `_CORNER` by each wall run on straight."""
    lateral, upward = wall * np.cos(grid.angle), wall * np.sin(grid.angle)
    height = np.interp(grid.station, floors.station, floors.height)[:, None]
    slope = np.interp(grid.station, floors.station, floors.slope)[:, None]
    above = upward - (height + slope * lateral)
    result = wall.copy()
    for side in (np.cos(grid.angle) > 0.2, np.cos(grid.angle) < -0.2):
        band = side & (above > _CORNER[0]) & (above < _CORNER[1])
        enough = band.sum(axis=1) >= 3
        weight = band.astype(float)
        mass = np.maximum(weight.sum(axis=1), 1e-9)
        mean_u, mean_l = (weight * upward).sum(1) / mass, (weight * lateral).sum(1) / mass
        du, dl = upward - mean_u[:, None], lateral - mean_l[:, None]
        lean = (weight * du * dl).sum(1) / np.maximum((weight * du * du).sum(1), 1e-6)
        foot = (mean_l - lean * mean_u)[:, None]
        straight = foot / (np.cos(grid.angle) - lean[:, None] * np.sin(grid.angle))
        low = (np.sign(np.cos(grid.angle)) == np.sign(foot)) & (np.sin(grid.angle) < 0) & (straight > 0)
        low &= straight * np.sin(grid.angle) - (height + slope * straight * np.cos(grid.angle)) < _CORNER[0]
        result = np.where(low & enough[:, None], straight, result)
    return result


def is_floor(wall: Float[np.ndarray, "rows cols"], grid: Grid, floors: Floors) -> Bool[np.ndarray, "rows cols"]:
    """Cells where the wall lies on the floor."""
    return floors.radius(grid) <= wall + 1e-6


def clip(wall: Float[np.ndarray, "rows cols"], grid: Grid, floors: Floors) -> Float[np.ndarray, "rows cols"]:
    """The wall where it is nearer than the floor, else the floor."""
    return np.minimum(wall, floors.radius(grid))
