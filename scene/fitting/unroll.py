"""The wall unrolled: a grid over station and angle, and what no scanner saw of it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from scene.geometry import angle_bins, bin_angles

_RADIUS_STEP = 1.0 / (1 << 14)  # 0.06 mm, so that a cell and a radius fit one sortable word
_RADIUS_BITS = 20  # up to 64 m


@dataclass(frozen=True)
class Grid:
    """Cells over station and angle; the angle closes on itself."""

    start: float  # Station of the first cell's near edge, m
    step: float  # Length of a cell, m
    rows: int  # Cells along the station
    columns: int  # Cells around

    @classmethod
    def over(cls, start: float, end: float, step: float, columns: int) -> "Grid":
        return cls(start, step, max(int(np.ceil((end - start) / step)), 1), columns)

    @property
    def station(self) -> Float[np.ndarray, " rows"]:
        """Middle of each row, m."""
        return self.start + (np.arange(self.rows) + 0.5) * self.step

    @property
    def angle(self) -> Float[np.ndarray, " columns"]:
        """Middle of each column, rad in [-π, π)."""
        return bin_angles(self.columns)

    def cell(self, station: Float[np.ndarray, " p"], angle: Float[np.ndarray, " p"]) -> Int[np.ndarray, " p"]:
        """Return the flat index of each point's cell; -1 outside the rows."""
        row = np.floor((station - self.start) / self.step).astype(np.int64)
        column = angle_bins(angle, self.columns)
        return np.where((row >= 0) & (row < self.rows), row * self.columns + column, -1)


def cell_medians(
    grid: Grid, cell: Int[np.ndarray, " p"], radius: Float[np.ndarray, " p"]
) -> Float[np.ndarray, "rows cols"]:
    """Return the median radius of each cell, m; NaN where nothing was seen."""
    inside = cell >= 0
    words = np.minimum(radius[inside] / _RADIUS_STEP, (1 << _RADIUS_BITS) - 1).astype(np.uint64)
    words |= cell[inside].astype(np.uint64) << np.uint64(_RADIUS_BITS)
    words.sort()
    size = grid.rows * grid.columns
    bounds = np.searchsorted(words, np.arange(size + 1, dtype=np.uint64) << np.uint64(_RADIUS_BITS))
    count = np.diff(bounds)
    result = np.full(size, np.nan)
    seen = count > 0
    middle = bounds[:-1][seen] + count[seen] // 2
    result[seen] = (words[middle] & np.uint64((1 << _RADIUS_BITS) - 1)) * _RADIUS_STEP
    return result.reshape(grid.rows, grid.columns)


def cell_means(
    grid: Grid, cell: Int[np.ndarray, " p"], value: Float[np.ndarray, " p"], weight: Float[np.ndarray, " p"]
) -> tuple[Float[np.ndarray, "rows cols"], Float[np.ndarray, "rows cols"]]:
    """Return the weighted mean of each cell (0 where nothing was seen) and its weight."""
    inside = cell >= 0
    size = grid.rows * grid.columns
    total = np.bincount(cell[inside], weight[inside], size)
    summed = np.bincount(cell[inside], (weight * value)[inside], size)
    mean = np.divide(summed, total, out=np.zeros(size), where=total > 0)
    return mean.reshape(grid.rows, grid.columns), total.reshape(grid.rows, grid.columns)


def fill_nearest(field: Float[np.ndarray, "rows cols"]) -> Float[np.ndarray, "rows cols"]:
    """Fills NaN cells with the nearest known value; the angle wraps. A field of NaN stays."""
    unknown = np.isnan(field)
    if not unknown.any() or unknown.all():
        return field
    columns = field.shape[1]
    wrapped = np.concatenate([field, field, field], axis=1)
    nearest = ndimage.distance_transform_edt(np.isnan(wrapped), return_distances=False, return_indices=True)
    return wrapped[tuple(nearest)][:, columns : 2 * columns]


_EVEN = 9  # cells along the bore


def fill_holes(field: Float[np.ndarray, "rows cols"], reach: float) -> Float[np.ndarray, "rows cols"]:
    """Fills holes of NaN that are deeper than `reach` cells from what was seen before and behind, linearly.

    A wall goes on along the bore; what is nearest to the middle of a large hole may be floor or crown. A direction that
    was seen nowhere stays NaN, and so do small holes.
    """
    unknown = np.isnan(field)
    depth = ndimage.distance_transform_edt(unknown)
    patch, count = ndimage.label(unknown)
    large = np.zeros(count + 1, bool)
    large[np.unique(patch[unknown & (depth > reach)])] = True
    hole = large[patch] & unknown
    rows, result = np.arange(len(field)), field.copy()
    for column in np.flatnonzero(hole.any(axis=0) & ~unknown.all(axis=0)):
        seen = ~unknown[:, column]
        at = hole[:, column]
        even = ndimage.median_filter(field[seen, column], _EVEN, mode="nearest")  # one cell at the rim may be off
        result[at, column] = np.interp(rows[at], rows[seen], even)
    return result


def median_smooth(field: Float[np.ndarray, "rows cols"], window: tuple[int, int]) -> Float[np.ndarray, "rows cols"]:
    """Return the median over a window of cells; the angle wraps, the ends hold."""
    pad = window[1] // 2
    wrapped = np.concatenate([field[:, field.shape[1] - pad :], field, field[:, :pad]], axis=1)
    return ndimage.median_filter(wrapped, window, mode="nearest")[:, pad : pad + field.shape[1]]


def smooth_cells(
    value: Float[np.ndarray, "rows cols"], weight: Float[np.ndarray, "rows cols"], sigma: tuple[float, float]
) -> tuple[Float[np.ndarray, "rows cols"], Float[np.ndarray, "rows cols"]]:
    """Return the Gaussian mean of the weighted cells, and the weight that each result rests on.

    Weights are not negative; cells of weight 0 are not read. `sigma` is in cells along the station and around.
    """
    modes = ("nearest", "wrap")
    total = ndimage.gaussian_filter(weight, sigma, mode=modes)
    summed = ndimage.gaussian_filter(np.where(weight > 0, value, 0.0) * weight, sigma, mode=modes)
    return np.divide(summed, total, out=np.zeros_like(summed), where=total > 1e-12), total


def resample(wall: np.ndarray, coarse: Grid, fine: Grid) -> np.ndarray:
    """Interpolates the coarse wall linearly on the fine grid; the angle wraps, the ends hold."""
    row = np.clip((fine.station - coarse.start) / coarse.step - 0.5, 0, coarse.rows - 1)
    low = np.minimum(row.astype(np.intp), max(coarse.rows - 2, 0))
    fraction = (row - low)[:, None]
    along = (1 - fraction) * wall[low] + fraction * wall[np.minimum(low + 1, coarse.rows - 1)]
    column = (np.arange(fine.columns) + 0.5) * coarse.columns / fine.columns - 0.5
    left = np.floor(column).astype(np.intp)
    part = column - left
    return (1 - part) * along[:, left % coarse.columns] + part * along[:, (left + 1) % coarse.columns]


_WIDEST_GAP = np.deg2rad(120.0)  # a wider gap has no two ends that a line could join
_LEAST_GAP = np.deg2rad(15.0)  # narrower ones are filled from their neighbours as well as by any line
# |cos| of the middle of a gap: those of walls; a crown is round, and a floor lower than what was seen
_SIDE_OF_WALL = 0.7


def fill_sides(
    radius: Float[np.ndarray, "rows cols"], angle: Float[np.ndarray, " cols"], reach: int = 0
) -> Float[np.ndarray, "rows cols"]:
    """Fills wide gaps of NaN in sections: at an end from the row before, and else walls by the line between their ends.

    The nearest thing seen below a wall is the corner of the floor, half as far again from the axis as the wall is: a
    wall filled from it would stand aside by most of a metre. The line between floor and crown cuts a wall off that
    nobody saw down to its foot, by half a metre: where a scan ends aslant, the wall goes on as it was.

    Args:
        radius: Distance of the wall from the axis, m; NaN where nothing was seen. Other gaps stay NaN.
        angle: Directions from the axis, evenly all around, rad.
        reach: Rows that a wall goes on as it was, where its direction is unseen from there to the end of the bore.
    """
    result, count = radius.copy(), len(angle)
    step = 2 * np.pi / count
    last = _last_rows(np.isfinite(radius), reach)
    for row in np.flatnonzero(np.isnan(radius).any(axis=1) & np.isfinite(radius).any(axis=1)):
        seen = np.flatnonzero(np.isfinite(radius[row]))
        for before, behind in zip(seen, np.append(seen[1:], seen[0] + count), strict=True):
            width = (behind - before) * step
            inside = np.arange(before + 1, behind)
            if width <= _LEAST_GAP:
                continue
            columns = inside % count
            result[row, columns] = radius[last[row, columns], columns]
            inside = inside[np.isnan(result[row, columns])]
            if width >= _WIDEST_GAP or abs(np.cos(angle[before] + width / 2)) < _SIDE_OF_WALL:
                continue
            r0, r1 = radius[row, before], radius[row, behind % count]
            turn = (inside - before) * step
            result[row, inside % count] = r0 * r1 * np.sin(width) / (r0 * np.sin(turn) + r1 * np.sin(width - turn))
    return result


def _last_rows(seen: Bool[np.ndarray, "rows cols"], reach: int) -> Int[np.ndarray, "rows cols"]:
    """Return the row that last showed each direction, where none follows and it is within `reach`; else its own."""
    rows, count = np.arange(len(seen))[:, None], len(seen)
    first, last = np.argmax(seen, axis=0), count - 1 - np.argmax(seen[::-1], axis=0)
    last_seen = np.where(rows > last, last, np.where(rows < first, first, rows))
    return np.where(seen.any(axis=0) & (np.abs(last_seen - rows) <= reach), last_seen, rows)
