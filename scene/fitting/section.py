"""Cloud and axis in, the section at every station out: wherever the wall goes, at the half-metre scale.

A coarse grid of medians gives a first wall that pockets, rails and people cannot move. The mean residual of small
cells against it, cleaned of such things and smoothed over a few decimetres, gives the wall itself. A flat floor is
fitted as a line under the track, and the walls are run on straight into its corners.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d, median_filter

from scene.axis import Axis
from scene.cloud import Cloud
from scene.errors import FitError
from scene.fitting import floor, profile, unroll
from scene.fitting.unroll import Grid

_COARSE_STEPS = (0.25, 0.5, 1.0, 1.5, 2.0)  # m; the first that leaves hardly a row of the coarse grid unseen
_COARSE_ANGLES = 120
_MIN_ROWS_SEEN = 0.9
_FINE = (0.05, profile.N_ANGLES)
_MEDIAN_WINDOW = (1.25, 5)  # m along, 3° columns around: a pocket fills less than a tenth of it
_SIGMA = (0.15, 1.5)  # m along, columns around
_SIGMA_BETWEEN = 0.4  # of the spacing, where the survey is profiles apart
_NEAR_WALL = 0.05  # cells further than this from the first wall are pockets or clutter
_ON_WALL = 0.035
_DEEPEST = 0.40  # further out is no recess of a lining, m
_FLOOR_STEP = 0.5
_FLOOR_SIGMA = 1.0
_CORNER = (0.15, 0.90)  # heights above the floor between which a wall is fitted to be run on down, m
_SEEN_WEIGHT = 0.02  # returns a cell: with fewer around, the first wall stands
_MIN_COVERAGE = 0.5
_END_COVERAGE = 0.4
_DENSE = 0.7
_OVERRUN = 3.0
_HOLLOW, _MIN_HOLLOW = 0.5, 0.7  # m from the wall, share of the points


@dataclass(frozen=True)
class Sections:
    """The wall on a fine grid, and what was measured of it.

    Attributes:
        grid: Station and angle cells.
        radius: Smooth wall, m, `(rows, cols)`.
        residual: Mean outward distance of each cell's returns from it, m, `(rows, cols)`.
        weight: Returns in each cell, `(rows, cols)`.
        support: Points of the thinned cloud on the wall, `(rows, cols)`.
        deepest: Furthest return behind the wall, m, `(rows, cols)`; 0 where there is none.
        spread: Inlier distance rms of each row, m, `(rows,)`.
        inlier: Cells that the wall was fitted to, `(rows, cols)`.
        flat_floor: Whether the section stands on a flat floor.
        voxel: Thinning of the cloud it was fitted to, m.
    """

    grid: Grid
    radius: Float[np.ndarray, "rows cols"]
    residual: Float[np.ndarray, "rows cols"]
    weight: Float[np.ndarray, "rows cols"]
    support: Float[np.ndarray, "rows cols"]
    deepest: Float[np.ndarray, "rows cols"]
    spread: Float[np.ndarray, " rows"]
    inlier: Bool[np.ndarray, "rows cols"]
    flat_floor: bool
    voxel: float


def fit_sections(cloud: Cloud, axis: Axis) -> Sections:
    """The sections from one end of the seen bore to the other; stations are those of `axis`.

    Args:
        cloud: Registered cloud.
        axis: Its centreline; may stop short of the ends or run over them by 3 m.

    Raises:
        FitError: Less than half of the bore's surface was seen.
    """
    station, lateral, upward = axis.at(np.arange(-_OVERRUN, axis.length + _OVERRUN, _COARSE_STEPS[0])).local(
        cloud.points.astype(np.float64)
    )
    angle, radius = np.arctan2(upward, lateral), np.hypot(lateral, upward)
    start, end = _seen_span(station, angle, axis)
    step = _coarse_step(station, start, end)
    coarse, fine = Grid.over(start, end, step, _COARSE_ANGLES), Grid.over(start, end, *_FINE)
    wall = unroll.medians(coarse, coarse.cell(station, angle), radius)
    if np.isfinite(wall).mean() < _MIN_COVERAGE:
        raise FitError(f"only {np.isfinite(wall).mean():.0%} of the bore's surface was seen; at least half is needed")
    window = (round(_MEDIAN_WINDOW[0] / step) // 2 * 2 + 1, _MEDIAN_WINDOW[1])
    wall = unroll.median_smooth(unroll.fill_nearest(wall), window)
    floors = _floor_lines(station, lateral, upward, start, end)
    if floors is not None:
        wall = _stand_on_floor(wall, coarse, floors)
    first = _resample(wall, coarse, fine)
    if floors is not None:  # exactly, not by interpolation across the corner
        first = _clip_to_floor(first, fine, floors)
    cell = fine.cell(station, angle)
    outward = radius - first.ravel()[np.maximum(cell, 0)]
    hollow = np.mean(np.abs(outward[cell >= 0]) < _HOLLOW)
    if hollow < _MIN_HOLLOW:
        raise FitError(f"no tunnel in the cloud: only {hollow:.0%} of its points lie on a wall around an open middle")
    residual, weight = unroll.means(fine, cell, outward, cloud.weights)
    inlier = (weight > 0) & (np.abs(residual) < _NEAR_WALL)
    spacing = step if step > _COARSE_STEPS[0] else 0.0
    sigma = (max(_SIGMA[0], _SIGMA_BETWEEN * spacing) / fine.step, _SIGMA[1])
    correction, support = unroll.smooth(residual, np.where(inlier, np.minimum(weight, 50.0), 0.0), sigma)
    correction *= np.clip(support / _SEEN_WEIGHT, 0.0, 1.0)
    if floors is not None:
        correction[_is_floor(first, fine, floors)] = 0.0
    outward -= correction.ravel()[np.maximum(cell, 0)]
    on_wall = (np.abs(outward) < _ON_WALL) & (cell >= 0)
    behind = (outward > _ON_WALL) & (outward < _DEEPEST) & (cell >= 0)
    size = fine.rows * fine.columns
    support_on = np.bincount(cell[on_wall], minlength=size).reshape(fine.rows, fine.columns).astype(float)
    deepest = np.zeros(size)
    np.maximum.at(deepest, cell[behind], outward[behind])
    squares = np.bincount(cell[on_wall] // fine.columns, (outward**2)[on_wall], fine.rows)
    spread = np.sqrt(squares / np.maximum(support_on.sum(axis=1), 1e-9))
    return Sections(
        fine, first + correction, residual - correction, weight, support_on, deepest.reshape(support_on.shape), spread,
        inlier, floors is not None, cloud.voxel,
    )  # fmt: skip


def _seen_span(station: np.ndarray, angle: np.ndarray, axis: Axis) -> tuple[float, float]:
    """First and last station where a fair share of the circumference was seen, m."""
    grid = Grid.over(-_OVERRUN, axis.length + _OVERRUN, _COARSE_STEPS[0], 24)
    cell = grid.cell(station, angle)
    count = np.bincount(cell[cell >= 0], minlength=grid.rows * grid.columns).reshape(grid.rows, grid.columns)
    rows = np.flatnonzero((count > 0).mean(axis=1) > _END_COVERAGE)
    if not len(rows):
        raise FitError("no tunnel in the cloud: hardly a section shows most of its circumference")
    first, last = grid.start + rows[0] * grid.step, grid.start + (rows[-1] + 1) * grid.step
    inside = station[(station >= first) & (station <= last)]
    if len(rows) < _DENSE * (rows[-1] - rows[0] + 1):  # profiles apart: the first and the last one are the ends
        return float(inside.min()), float(inside.max())
    return _trimmed(inside, first, 1), -_trimmed(-inside, -last, 1)


def _trimmed(station: np.ndarray, end: float, behind: float) -> float:
    """Where the returns become as many as further inside: noise spills a few of them over a mouth.

    Args:
        station: Growing inwards, m.
        end: Where the first returns are, m.
        behind: How far inside to look, m.
    """
    step = _FINE[0]
    total = np.histogram(station, np.arange(end - 0.5, end + 2 * behind, step))[0]
    reach = round(behind / step)
    full = [k for k in range(len(total) - reach) if 2 * total[k] > np.median(total[k + 1 : k + 1 + reach]) > 0]
    return end - 0.5 + (full[0] if full else 0) * step


def _coarse_step(station: np.ndarray, start: float, end: float) -> float:
    """Row length of the coarse grid, m: longer where the survey is profiles some way apart."""
    inside = station[(station >= start) & (station <= end)]
    for step in _COARSE_STEPS:
        edges = np.arange(start, end, step)
        if np.mean(np.histogram(inside, np.append(edges, end))[0] > 0) >= _MIN_ROWS_SEEN:
            return step
    raise FitError(f"profiles more than {_COARSE_STEPS[-1]:g} m apart leave the wall between them unknown")


@dataclass(frozen=True)
class _Floors:
    station: np.ndarray
    height: np.ndarray
    slope: np.ndarray

    def radius(self, grid: Grid) -> np.ndarray:
        height = np.interp(grid.station, self.station, self.height)[:, None]
        slope = np.interp(grid.station, self.station, self.slope)[:, None]
        descent = np.sin(grid.angle) - slope * np.cos(grid.angle)
        return np.where(descent < -1e-3, height / np.minimum(descent, -1e-3), np.inf)


def _floor_lines(
    station: np.ndarray, lateral: np.ndarray, upward: np.ndarray, start: float, end: float
) -> _Floors | None:
    count = max(int((end - start) / _FLOOR_STEP), 1)
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
    sigma = _FLOOR_SIGMA / (end - start) * count
    height, slope = (
        gaussian_filter1d(median_filter(v, 3, mode="nearest"), sigma, mode="nearest") for v in (height, slope)
    )
    return _Floors(at, height, slope)


def _stand_on_floor(wall: np.ndarray, grid: Grid, floors: _Floors) -> np.ndarray:
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


def _is_floor(wall: np.ndarray, grid: Grid, floors: _Floors) -> np.ndarray:
    return floors.radius(grid) <= wall + 1e-6


def _clip_to_floor(wall: np.ndarray, grid: Grid, floors: _Floors) -> np.ndarray:
    return np.minimum(wall, floors.radius(grid))


def _resample(wall: np.ndarray, coarse: Grid, fine: Grid) -> np.ndarray:
    """Linear interpolation of the coarse wall on the fine grid; the angle wraps, the ends hold."""
    row = np.clip((fine.station - coarse.start) / coarse.step - 0.5, 0, coarse.rows - 1)
    low = np.minimum(row.astype(np.intp), max(coarse.rows - 2, 0))
    share = (row - low)[:, None]
    along = (1 - share) * wall[low] + share * wall[np.minimum(low + 1, coarse.rows - 1)]
    column = (np.arange(fine.columns) + 0.5) * coarse.columns / fine.columns - 0.5
    left = np.floor(column).astype(np.intp)
    part = column - left
    return (1 - part) * along[:, left % coarse.columns] + part * along[:, (left + 1) % coarse.columns]
