"""Cloud and axis in, the section at every station out: wherever the wall goes, at the half-metre scale.

A coarse grid of medians gives a first wall that pockets, rails and people cannot move. The mean residual of small
cells against it, cleaned of such things and smoothed over a few decimetres, gives the wall itself. Where the survey
is profiles some way apart, the wall between them is kriged instead. A flat floor is fitted as a line under the track,
and the walls are run on straight into its corners.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from scene.axis import Axis
from scene.cloud import Cloud
from scene.errors import FitError
from scene.fitting import bed, profile, sparse, unroll
from scene.fitting.seen import DENSE_STEP, OVERRUN, profile_spacing, seen_span
from scene.fitting.sureness import sure_by_support
from scene.fitting.unroll import Grid

_COARSE_ANGLES = 120
_FINE = (0.05, profile.N_ANGLES)
_MEDIAN_WINDOW = (1.25, 5)  # m along, 3° columns around: a pocket fills less than a tenth of it
_SIGMA = (0.15, 1.5)  # m along, columns around
_NEAR_WALL = 0.05  # cells further than this from the first wall are pockets or clutter
_ON_WALL = 0.035
_DEEPEST = 0.40  # further out is no recess of a lining, m
_SEEN_WEIGHT = 0.02  # returns a cell: with fewer around, the first wall stands
_MIN_COVERAGE = 0.5
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
        sigma: Standard deviation of the wall's radius, m, `(rows, cols)`.
        flat_floor: Whether the section stands on a flat floor.
        voxel: Thinning of the cloud it was fitted to, m.
        spacing: Between the survey's profiles, about, m; 0 where it is a dense cloud.
    """

    grid: Grid
    radius: Float[np.ndarray, "rows cols"]
    residual: Float[np.ndarray, "rows cols"]
    weight: Float[np.ndarray, "rows cols"]
    support: Float[np.ndarray, "rows cols"]
    deepest: Float[np.ndarray, "rows cols"]
    spread: Float[np.ndarray, " rows"]
    inlier: Bool[np.ndarray, "rows cols"]
    sigma: Float[np.ndarray, "rows cols"]
    flat_floor: bool
    voxel: float
    spacing: float


@dataclass(frozen=True)
class _Points:
    """The cloud about its axis: stations, m; directions, rad; distances from the axis, m; returns of each."""

    station: np.ndarray
    angle: np.ndarray
    radius: np.ndarray
    weight: np.ndarray


def fit_sections(cloud: Cloud, axis: Axis) -> Sections:
    """The sections from one end of the seen bore to the other; stations are those of `axis`.

    Args:
        cloud: Registered cloud.
        axis: Its centreline; may stop short of the ends or run over them by 3 m.

    Raises:
        FitError: Less than half of the bore's surface was seen, or its middle is not open.
    """
    station, lateral, upward = axis.at(np.arange(-OVERRUN, axis.length + OVERRUN, DENSE_STEP)).local(
        cloud.points.astype(np.float64)
    )
    points = _Points(station, np.arctan2(upward, lateral), np.hypot(lateral, upward), cloud.weights)
    start, end = seen_span(station, points.angle, axis)
    step = profile_spacing(station, start, end)
    floors = bed.find_floors(station, lateral, upward, start, end)
    fine = Grid.over(start, end, *_FINE)
    wall = _first_wall(points, Grid.over(start, end, step, _COARSE_ANGLES), fine, floors)
    _require_open_middle(points, fine, wall)
    if step > DENSE_STEP:
        kriged = sparse.krige(points.station, points.angle, points.radius, fine)
        wall = kriged.wall if floors is None else _standing(kriged.wall, fine, floors)
        return _measured(points, wall, kriged.sigma, fine, floors is not None, cloud.voxel, step)
    wall, seen = _followed(points, wall, fine, floors)
    return _measured(points, wall, sure_by_support(wall, seen, fine), fine, floors is not None, cloud.voxel, 0.0)


def _first_wall(points: _Points, coarse: Grid, fine: Grid, floors: bed.Floors | None) -> np.ndarray:
    wall = unroll.medians(coarse, coarse.cell(points.station, points.angle), points.radius)
    if np.isfinite(wall).mean() < _MIN_COVERAGE:
        raise FitError(f"only {np.isfinite(wall).mean():.0%} of the bore's surface was seen; at least half is needed")
    window = (round(_MEDIAN_WINDOW[0] / coarse.step) // 2 * 2 + 1, _MEDIAN_WINDOW[1])
    along = unroll.median_smooth(unroll.fill_nearest(wall), (window[0], 1))
    wall = unroll.median_smooth(unroll.fill_nearest(wall), window)
    if floors is None:
        return unroll.resample(wall, coarse, fine)
    # Clipped on the fine grid alone: interpolation between a wall and a floor would cut their corner off.
    return bed.clip(unroll.resample(bed.stand_on(wall, coarse, floors, along), coarse, fine), fine, floors)


def _standing(wall: np.ndarray, grid: Grid, floors: bed.Floors) -> np.ndarray:
    return bed.clip(bed.stand_on(wall, grid, floors, wall), grid, floors)


def _require_open_middle(points: _Points, fine: Grid, wall: np.ndarray) -> None:
    cell = fine.cell(points.station, points.angle)
    outward = points.radius - wall.ravel()[np.maximum(cell, 0)]
    hollow = np.mean(np.abs(outward[cell >= 0]) < _HOLLOW)
    if hollow < _MIN_HOLLOW:
        raise FitError(f"no tunnel in the cloud: only {hollow:.0%} of its points lie on a wall around an open middle")


def _followed(
    points: _Points, first: np.ndarray, fine: Grid, floors: bed.Floors | None
) -> tuple[np.ndarray, np.ndarray]:
    """The wall at the half-metre scale, and the cells that it was fitted to."""
    cell = fine.cell(points.station, points.angle)
    outward = points.radius - first.ravel()[np.maximum(cell, 0)]
    residual, weight = unroll.means(fine, cell, outward, points.weight)
    inlier = (weight > 0) & (np.abs(residual) < _NEAR_WALL)
    weight = np.where(inlier, np.minimum(weight, 50.0), 0.0)
    correction, support = unroll.smooth(residual, weight, (_SIGMA[0] / fine.step, _SIGMA[1]))
    correction *= np.clip(support / _SEEN_WEIGHT, 0.0, 1.0)
    if floors is not None:
        correction[bed.is_floor(first, fine, floors)] = 0.0
    return first + correction, inlier


def _measured(
    points: _Points, wall: np.ndarray, sigma: np.ndarray, fine: Grid, flat_floor: bool, voxel: float, spacing: float
) -> Sections:
    """What the points say of the wall that was fitted to them."""
    cell = fine.cell(points.station, points.angle)
    outward = points.radius - wall.ravel()[np.maximum(cell, 0)]
    residual, weight = unroll.means(fine, cell, outward, points.weight)
    on_wall = (np.abs(outward) < _ON_WALL) & (cell >= 0)
    behind = (outward > _ON_WALL) & (outward < _DEEPEST) & (cell >= 0)
    support = np.bincount(cell[on_wall], minlength=wall.size).reshape(wall.shape).astype(float)
    deepest = np.zeros(wall.size)
    np.maximum.at(deepest, cell[behind], outward[behind])
    squares = np.bincount(cell[on_wall] // fine.columns, (outward**2)[on_wall], fine.rows)
    spread = np.sqrt(squares / np.maximum(support.sum(axis=1), 1e-9))
    inlier = (weight > 0) & (np.abs(residual) < _NEAR_WALL)
    return Sections(
        fine, wall, residual, weight, support, deepest.reshape(wall.shape), spread, inlier, sigma, flat_floor, voxel,
        spacing,
    )  # fmt: skip
