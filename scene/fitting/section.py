"""From cloud and axis to the section at every station, at the half-metre scale, and to the bore of them.

A coarse grid of medians gives a first wall that pockets, rails and people cannot move. The mean residual of small
cells against it, cleaned of such things and smoothed over a few decimetres, gives the wall itself. A flat floor is
fitted as a line under the track, and the walls are extended into its corners.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_opening, uniform_filter1d

from scene.bore import POCKET, Bore, uniform_stations
from scene.cloud import Cloud
from scene.errors import FitError, Refusal
from scene.fitting import unroll
from scene.fitting.axis import smooth_axis
from scene.fitting.floor import Floors, clip_to_floor, extend_to_floor, find_floors, is_floor
from scene.fitting.unroll import Grid, fill_sides
from scene.geometry import N_ANGLES, Around, Axis, angle_bins, find_runs, measure_section

DENSE_STEP = 0.25  # m; where fewer than most rows of this length were seen, the survey is a row of profiles
OVERRUN = 3.0  # m beyond the axis that are looked at
_GAP = 2.0  # m unseen along the bore: longer is a gap of the survey, and no distance of its profiles
_END_COVERAGE = 0.4  # fraction of the directions that a row of the bore shows
_DENSE = 0.7  # fraction of the rows that a dense survey shows
_TRIM_STEP = 0.05  # m


def visible_span(station: np.ndarray, angle: np.ndarray, axis: Axis) -> tuple[float, float]:
    """Return first and last station where enough of the circumference was seen, m; raises `FitError` without any."""
    grid = Grid.over(-OVERRUN, axis.length + OVERRUN, DENSE_STEP, 24)
    cell = grid.cell(station, angle)
    count = np.bincount(cell[cell >= 0], minlength=grid.rows * grid.columns).reshape(grid.rows, grid.columns)
    shown = (count > 0).mean(axis=1) > _END_COVERAGE
    rows = np.flatnonzero(shown)
    if not len(rows):
        raise FitError("no tunnel in the cloud: hardly a section shows most of its circumference", Refusal.UNSEEN)
    shown = shown[rows[0] : rows[-1] + 1]
    runs = np.diff(find_runs(~shown), axis=1)  # long ones are the gaps of a survey
    if shown.sum() / (len(shown) - runs[runs > _GAP / DENSE_STEP].sum()) < _DENSE:
        why = f"profiles more than {DENSE_STEP:g} m apart leave the wall between them unknown"
        raise FitError(why, Refusal.UNSEEN)
    first, last = grid.start + rows[0] * grid.step, grid.start + (rows[-1] + 1) * grid.step
    inside = (station >= first) & (station <= last)
    station, angle = station[inside], angle[inside]
    start, end = _trim_end(station, first, 1), -_trim_end(-station, -last, 1)
    return _trim_aslant(station, angle, start), -_trim_aslant(-station, angle, -end)


def _trim_end(station: np.ndarray, end: float, behind: float) -> float:
    """Station where returns become as many as in the `behind` m further in: noise puts a few beyond a mouth.

    Stations grow inwards, m; the first returns are at `end`.
    """
    step = _TRIM_STEP
    total = np.histogram(station, np.arange(end - 0.5, end + 2 * behind, step))[0]
    reach = round(behind / step)
    full = [k for k in range(len(total) - reach) if 2 * total[k] > np.median(total[k + 1 : k + 1 + reach]) > 0]
    return end - 0.5 + (full[0] if full else 0) * step


_ASLANT = 0.10  # m between the mouth on most of the girth and its outermost rim
_MOUTH_COLUMNS = 24  # directions


def _trim_aslant(station: np.ndarray, angle: np.ndarray, end: float) -> float:
    """Station where half of the directions show the wall; `end` where that is not well inside it.

    An axis may meet a mouth aslant, as between rough walls, and then the rim of one side is not its end. Stations grow
    inwards, m.
    """
    near = (station > end - 1.0) & (station < end + 2.0)
    column = angle_bins(angle[near], _MOUTH_COLUMNS)
    outermost = np.full(_MOUTH_COLUMNS, np.inf)
    np.minimum.at(outermost, column, station[near])
    seen = outermost[np.isfinite(outermost)]
    if len(seen) < _MOUTH_COLUMNS / 2:
        return end
    most = float(np.median(seen))
    return most if most > end + _ASLANT else end


_COARSE_ANGLES = 120  # directions of the first wall
_THIN_STEPS = (0.5, 1.0)  # m; rows of the first wall where a cloud is too thin for shorter ones
_FINE = (0.05, N_ANGLES)
_MEDIAN_WINDOW = (1.25, 5)  # m along, 3° columns around: a pocket fills less than a tenth of it
_SIGMA = (0.15, 1.5)  # m along, columns around
_NEAR_WALL = 0.05  # cells further than this from the first wall are pockets or clutter
_ON_WALL = 0.035  # m from the wall: nearer returns are on it
_LARGE_HOLE = 4.0  # cells
_GOES_ON = 1.0  # m that a wall goes on as it was, where it is unseen from there to the end
_ALONG = 1.25  # m before and behind a cell that tell an edge from a pocket
_MOSTLY, _MIN_CELLS = 0.7, 6  # fraction of the cells seen, and how many
_WIDE = 6  # columns
_STEEP, _EDGE = 0.25, 1.0  # of the radius, within 4 columns; m that the first wall may be off there
_DEEPEST = 0.40  # further out is no recess of a lining, m
_SEEN_WEIGHT = 0.02  # returns a cell: with fewer around, the first wall stands
_MIN_COVERAGE = 0.5  # fraction of the cells of the first wall
_HOLLOW, _MIN_HOLLOW = 0.5, 0.7  # m from the wall, fraction of the points


@dataclass(frozen=True)
class Sections:
    """The wall on a fine grid, and what was measured of it."""

    grid: Grid  # Station and angle cells
    radius: Float[np.ndarray, "rows cols"]  # Smooth wall, m
    residual: Float[np.ndarray, "rows cols"]  # Mean outward distance of each cell's returns from it, m
    weight: Float[np.ndarray, "rows cols"]  # Returns in each cell
    support: Float[np.ndarray, "rows cols"]  # Points of the thinned cloud on the wall
    deepest: Float[np.ndarray, "rows cols"]  # Furthest return behind the wall, m; 0 where there is none
    spread: Float[np.ndarray, " rows"]  # Inlier distance rms of each row, m
    inlier: Bool[np.ndarray, "rows cols"]  # Cells that the wall was fitted to
    flat_floor: bool  # True where the section stands on a flat floor
    voxel: float  # Thinning of the cloud it was fitted to, m


@dataclass(frozen=True)
class _Points:
    """The cloud about its axis: stations, m; directions, rad; distances from the axis, m; returns of each."""

    station: np.ndarray
    angle: np.ndarray
    radius: np.ndarray
    weight: np.ndarray

    @classmethod
    def about(cls, around: Around, weight: np.ndarray) -> "_Points":
        return cls(around.station, around.angle, around.radius, weight)

    def medians(self, grid: Grid) -> Float[np.ndarray, "rows cols"]:
        return unroll.cell_medians(grid, grid.cell(self.station, self.angle), self.radius)

    def outward_of(self, wall: np.ndarray, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
        """Return the cell of each point, -1 outside the grid, and its distance outward of the wall, m."""
        cell = grid.cell(self.station, self.angle)
        return cell, self.radius - wall.ravel()[np.maximum(cell, 0)]


def fit_sections(cloud: Cloud, axis: Axis, behind: Float[np.ndarray, "k 3"] | None = None) -> Sections:
    """Fits the sections from one end of the seen bore to the other; stations are those of `axis`.

    The axis may stop short of the ends or run over them by 3 m. `behind` are places of the wall, m, that stand in for
    returns where there are none. Raises `FitError` where less than half of the surface
    was seen, or its middle is not open.
    """
    whole = axis.at(np.arange(-OVERRUN, axis.length + OVERRUN, DENSE_STEP))
    around = whole.local(cloud.points.astype(np.float64))
    points = _Points.about(around, cloud.weights)
    stand_in = None if behind is None or not len(behind) else _Points.about(whole.local(behind), np.ones(len(behind)))
    start, end = visible_span(points.station, points.angle, axis)
    floors = find_floors(*around, start, end, axis)
    fine = Grid.over(start, end, *_FINE)
    grids = [Grid.over(start, end, length, _COARSE_ANGLES) for length in (DENSE_STEP, *_THIN_STEPS)]
    coarse = next((grid for grid in grids if _share_of_cells(points, grid) >= _MIN_COVERAGE), grids[0])
    wall = _first_wall(points, coarse, fine, floors, stand_in)
    _require_open_middle(points, fine, wall)
    return _measure_wall(points, _follow_wall(points, wall, fine, floors), fine, floors is not None, cloud.voxel)


def _share_of_cells(points: _Points, grid: Grid) -> float:
    cell = grid.cell(points.station, points.angle)
    return float((np.bincount(cell[cell >= 0], minlength=grid.rows * grid.columns) > 0).mean())


def _first_wall(
    points: _Points, coarse: Grid, fine: Grid, floors: Floors | None, stand_in: _Points | None
) -> np.ndarray:
    wall = points.medians(coarse)
    if np.isfinite(wall).mean() < _MIN_COVERAGE:
        why = f"only {np.isfinite(wall).mean():.0%} of the bore's surface was seen; at least half is needed"
        raise FitError(why, Refusal.UNSEEN)
    wall = wall if stand_in is None else np.where(np.isnan(wall), stand_in.medians(coarse), wall)
    wall = fill_sides(unroll.fill_holes(wall, _LARGE_HOLE), coarse.angle, round(_GOES_ON / coarse.step))
    window = (round(_MEDIAN_WINDOW[0] / coarse.step) // 2 * 2 + 1, _MEDIAN_WINDOW[1])
    along = unroll.median_smooth(unroll.fill_nearest(wall), (window[0], 1))
    wall = unroll.median_smooth(unroll.fill_nearest(wall), window)
    if floors is None:
        return unroll.resample(wall, coarse, fine)
    # Clipped on the fine grid alone: interpolation between a wall and a floor would cut their corner off.
    return clip_to_floor(unroll.resample(extend_to_floor(wall, coarse, floors, along), coarse, fine), fine, floors)


def _require_open_middle(points: _Points, fine: Grid, wall: np.ndarray) -> None:
    cell, outward = points.outward_of(wall, fine)
    hollow = np.mean(np.abs(outward[cell >= 0]) < _HOLLOW)
    if hollow < _MIN_HOLLOW:
        why = f"no tunnel in the cloud: only {hollow:.0%} of its points lie on a wall around an open middle"
        raise FitError(why, Refusal.NO_BORE)


def _follow_wall(points: _Points, first: np.ndarray, fine: Grid, floors: Floors | None) -> np.ndarray:
    """Return the wall at the half-metre scale."""
    cell, outward = points.outward_of(first, fine)
    residual, weight = unroll.cell_means(fine, cell, outward, points.weight)
    corner = _cut_corners(first, residual, weight, fine)
    if floors is not None:
        corner[is_floor(first, fine, floors)] = 0.0
    first, residual = first + corner, residual - corner
    inlier = (weight > 0) & (np.abs(residual) < _NEAR_WALL)
    weight = np.where(inlier, np.minimum(weight, 50.0), 0.0)
    correction, support = unroll.smooth_cells(residual, weight, (_SIGMA[0] / fine.step, _SIGMA[1]))
    correction *= np.clip(support / _SEEN_WEIGHT, 0.0, 1.0)
    if floors is not None:
        correction[is_floor(first, fine, floors)] = 0.0
    return first + correction


def _cut_corners(first: np.ndarray, residual: np.ndarray, weight: np.ndarray, fine: Grid) -> np.ndarray:
    """Return how far the first wall cuts off edges that run along the bore, m.

    There the returns of one direction lie to one side of it in most of the cells along 2.5 m, which those of pockets do
    not. What is in front of it must be wider than rails and cables, but where the wall nearly follows the ray.
    """
    size = 2 * round(_ALONG / fine.step) + 1

    def along(field: np.ndarray) -> np.ndarray:
        return uniform_filter1d(field.astype(float), size, axis=0, mode="nearest")

    steep = np.abs(np.roll(first, 2, axis=1) - np.roll(first, -2, axis=1)) > _STEEP * first
    known = (weight > 0) & (np.abs(residual) < np.where(steep, _EDGE, _DEEPEST))
    seen = along(known)
    result = np.zeros_like(residual)
    for side in (1, -1):
        there = known & (side * residual > _ON_WALL)
        fraction = along(there)
        edge = (fraction > _MOSTLY * seen) & (seen * size >= _MIN_CELLS)
        if side < 0:
            wrapped = np.concatenate([edge, edge[:, :_WIDE]], axis=1)
            edge &= steep | binary_opening(wrapped, np.ones((1, _WIDE), bool))[:, : fine.columns]
        result[edge] = (along(np.where(there, residual, 0.0)) / np.maximum(fraction, 1e-9))[edge]
    return result


def _measure_wall(points: _Points, wall: np.ndarray, fine: Grid, flat_floor: bool, voxel: float) -> Sections:
    """Measures what the points show of the wall that was fitted to them."""
    cell, outward = points.outward_of(wall, fine)
    residual, weight = unroll.cell_means(fine, cell, outward, points.weight)
    on_wall = (np.abs(outward) < _ON_WALL) & (cell >= 0)
    behind = (outward > _ON_WALL) & (outward < _DEEPEST) & (cell >= 0)
    support = np.bincount(cell[on_wall], minlength=wall.size).reshape(wall.shape).astype(float)
    deepest = np.zeros(wall.size)
    np.maximum.at(deepest, cell[behind], outward[behind])
    squares = np.bincount(cell[on_wall] // fine.columns, (outward**2)[on_wall], fine.rows)
    spread = np.sqrt(squares / np.maximum(support.sum(axis=1), 1e-9))
    inlier = (weight > 0) & (np.abs(residual) < _NEAR_WALL)
    return Sections(
        fine, wall, residual, weight, support, deepest.reshape(wall.shape), spread, inlier, flat_floor, voxel
    )  # fmt: skip


_SHOWN = 0.4  # of the directions, within two rows: with less seen a section counts as filled


def measure_extents(angle: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return width and height of each section, m, `(n,)` each."""
    extents = [measure_section(angle, section) for section in radius]
    return np.array([e.width for e in extents]), np.array([e.height for e in extents])


def bore_from_sections(axis: Axis, sections: Sections) -> Bore:
    """Return the bore over the seen span, from station 0, without lining; raises `FitError` where it holds a room."""
    grid = sections.grid
    start, end = grid.start, grid.start + grid.rows * grid.step
    station = uniform_stations(end - start)
    at = axis.at(station + start)
    rows = np.clip((station + start - grid.start) / grid.step - 0.5, 0, grid.rows - 1)
    low = np.minimum(rows.astype(np.intp), max(grid.rows - 2, 0))
    fraction = (rows - low)[:, None]
    high = np.minimum(low + 1, grid.rows - 1)
    radius = (1 - fraction) * sections.radius[low] + fraction * sections.radius[high]
    width, height = measure_extents(grid.angle, radius)
    require_no_room(station, width)
    seen = sections.weight > 0
    coverage = np.array([seen[max(row - 2, 0) : row + 3].any(axis=0).mean() for row in low])
    padded = np.pad(sections.spread, 2, mode="edge")
    spread = np.mean([padded[low + k] for k in range(5)], axis=0)  # over five rows, one station step
    return Bore(
        station, at.position, at.tangent, at.lateral, at.up, width, height, grid.angle, radius,
        spread, coverage, coverage < _SHOWN,
        np.empty(0), np.empty(0, POCKET),
    )  # fmt: skip


_STRAIGHTER = 3  # times that an axis is smoothed over twice the length


def fit_unfolded(
    cloud: Cloud, axis: Axis, cutoff: float, behind: Float[np.ndarray, "k 3"] | None = None
) -> tuple[Sections, Bore]:
    """Fits sections to an axis, which is smoothed further where they fold: at a jump of the wall it may bend sharply.

    `cutoff` is the wavelength that the axis is smooth over, m; see `fit_sections` for `behind`.
    """
    for power in range(1, _STRAIGHTER + 2):
        sections = fit_sections(cloud, axis, behind)
        bore = bore_from_sections(axis, sections)
        if power > _STRAIGHTER or bore.find_fold() is None:
            break
        axis = smooth_axis(axis.position, cutoff * 2**power)
    return sections, bore


_PORTAL = 6.0  # m from an end within which a bore may flare open
_ROOM, _ROOM_LENGTH = 2.0, 5.0  # times the median width; m, longer than a niche


def require_no_room(station: Float[np.ndarray, " n"], width: Float[np.ndarray, " n"]) -> None:
    """Refuses a bore that is twice as wide as usual over more than 5 m; raises `FitError`.

    Stations are uniform, m. What widens within 6 m of an end is a portal.
    """
    usual = float(np.median(width))
    wide = (width > _ROOM * usual) & (station > _PORTAL) & (station < station[-1] - _PORTAL)
    for first, last in find_runs(wide) - np.array([0, 1]):
        if station[last] - station[first] > _ROOM_LENGTH:
            raise FitError(
                f"from station {station[first]:.0f} to {station[last]:.0f} m the bore is "
                f"{width[first : last + 1].max():.0f} m wide where it is {usual:.1f} m elsewhere: a room, not a tunnel",
                Refusal.ROOM,
            )
