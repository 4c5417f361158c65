"""The flat floor: a line under sleepers, rails and people in each section, and the walls extended into its corners."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d, median_filter

from scene.fitting.unroll import Grid

# What lies a little above the line may be track or clutter; what lies below is noise.
_GATES = ((-0.15, 0.10), (-0.08, 0.05), (-0.05, 0.04), (-0.04, 0.04))
_START_PERCENTILE = 20
_CLUTTER = 0.45
_MIN_POINTS = 30
_FLAT_SHARE = 0.85
_INNER = 0.75
_BESIDE = 0.5


def fit_floor_line(lateral: Float[np.ndarray, " n"], upward: Float[np.ndarray, " n"]) -> tuple[float, float] | None:
    """Fits `(a, b)` of the floor `upward = a + b · lateral` to one section, m; `None` where the bottom is not flat."""
    if len(lateral) < _MIN_POINTS:
        return None
    half_width = np.percentile(np.abs(lateral), 95)
    bottom = (upward < 0) & (np.abs(lateral) < _INNER * half_width)
    y, z = lateral[bottom], upward[bottom]
    if len(y) < _MIN_POINTS:
        return None
    line = (float(np.percentile(z, _START_PERCENTILE)), 0.0)
    for below, above in _GATES:
        residual = z - line[0] - line[1] * y
        keep = (residual > below) & (residual < above)
        if keep.sum() < _MIN_POINTS or np.ptp(y[keep]) < half_width:
            return None
        line = _fit_through(y[keep], z[keep])
    beside = keep & (np.abs(y) > _BESIDE * half_width)
    if min((beside & (y > 0)).sum(), (beside & (y < 0)).sum()) >= _MIN_POINTS:
        line = _fit_through(y[beside], z[beside])  # beside the track, where no sleeper lifts it
    residual = z - line[0] - line[1] * y
    explained = (np.abs(residual) < 0.06) | ((residual > 0) & (residual < _CLUTTER))
    support = (np.abs(residual) < 0.06).mean()
    return line if explained.mean() > _FLAT_SHARE and support > 0.3 else None


def _fit_through(y: np.ndarray, z: np.ndarray) -> tuple[float, float]:
    slope, height = np.polyfit(y, z, 1)
    return float(height), float(slope)


def floor_radius(line: tuple[float, float], angle: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """Return the distance from the axis to the floor in each direction, m; `inf` where it is not met."""
    descent = np.sin(angle) - line[1] * np.cos(angle)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = line[0] / descent
    return np.where((distance > 0) & np.isfinite(distance), distance, np.inf)


_FLOOR_STEP = 0.5  # m
_FLOOR_SIGMA = 1.0  # m
_FITTED = (0.20, 1.10)  # heights above the floor between which a wall is fitted to be run on down, m
_FOOT = 0.45  # below it the fit takes the place of the wall, m
_BETWEEN = 0.3  # |cos| of the directions that meet the floor between the walls
_RAILS = 0.7  # of the distance out to the wall
_NEWTON, _CONVERGED = 6, 0.01


@dataclass(frozen=True)
class Floors:
    """Floor lines of sections."""

    station: Float[np.ndarray, " k"]  # m
    height: Float[np.ndarray, " k"]  # On the axis, m
    slope: Float[np.ndarray, " k"]  # Rise for each metre to the left

    def radius(self, grid: Grid) -> Float[np.ndarray, "rows cols"]:
        """Return the distance from the axis to the floor in each direction, m; `inf` where it is not met."""
        height = np.interp(grid.station, self.station, self.height)[:, None]
        slope = np.interp(grid.station, self.station, self.slope)[:, None]
        descent = np.sin(grid.angle) - slope * np.cos(grid.angle)
        return np.where(descent < -1e-3, height / np.minimum(descent, -1e-3), np.inf)


def find_floors(
    station: np.ndarray, lateral: np.ndarray, upward: np.ndarray, start: float, end: float
) -> Floors | None:
    """Return a floor line every half metre, smoothed along; `None` where fewer than half of the sections have one."""
    count = max(int((end - start) / _FLOOR_STEP), 1)
    middle = start + (np.arange(count) + 0.5) * (end - start) / count
    order = np.argsort(station, kind="stable")
    bounds = np.searchsorted(station[order], start + np.arange(count + 1) * (end - start) / count)
    lines = []
    for k in range(count):
        rows = order[bounds[k] : bounds[k + 1]]
        rows = rows[:: max(1, len(rows) // 4000)]
        line = fit_floor_line(lateral[rows], upward[rows])
        if line is not None:
            lines.append((middle[k], *line))
    if len(lines) < 0.5 * count:
        return None
    at, height, slope = np.asarray(lines).T
    sigma = _FLOOR_SIGMA / (end - start) * count
    height, slope = (
        gaussian_filter1d(median_filter(v, 3, mode="nearest"), sigma, mode="nearest") for v in (height, slope)
    )
    return Floors(at, height, slope)


def extend_to_floor(wall: np.ndarray, grid: Grid, floors: Floors, seen: np.ndarray) -> np.ndarray:
    """Replaces the foot of each wall by the parabola that the wall above it follows, down to the floor.

    `wall` is its distance from the axis, m, and `seen` the same without smoothing around, which would round the corner
    off.
    """
    lateral, upward = seen * np.cos(grid.angle), seen * np.sin(grid.angle)
    height = np.interp(grid.station, floors.station, floors.height)[:, None]
    slope = np.interp(grid.station, floors.station, floors.slope)[:, None]
    above = upward - (height + slope * lateral)
    on_floor = floors.radius(grid)
    # Between the feet the floor itself will do, whatever sleepers and rails stand on it.
    under = (np.abs(np.cos(grid.angle)) < _BETWEEN) & (np.sin(grid.angle) < 0) & (above < _FOOT)
    result = np.where(under, 2 * wall, wall)
    for side in (1, -1):
        facing = side * np.cos(grid.angle) > _BETWEEN
        out = side * lateral
        # Rails are as high as the lower end of the band, but nowhere near the wall.
        band = facing & (above > _FITTED[0]) & (above < _FITTED[1])
        band &= out > _RAILS * np.where(band, out, 0.0).max(axis=1, keepdims=True)
        curve, known = _fit_parabolas(above, out, band)
        foot = _meet_parabola(curve, grid.angle, side, height, slope)
        # A ray that meets the floor inside the foot of the wall meets no wall.
        inside = on_floor * side * np.cos(grid.angle) < curve[0][:, None]
        foot = np.where(np.isnan(foot) & inside, 2 * wall, foot)
        climb = foot * np.sin(grid.angle) - (height + slope * foot * np.cos(grid.angle))
        low = facing & (np.sin(grid.angle) < 0) & (foot > 0) & (climb < _FOOT)
        result = np.where(low & known[:, None], foot, result)
    return result


def _fit_parabolas(above: np.ndarray, out: np.ndarray, band: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fits each row's lateral distance `a + b h + c h²`, `h` m above the floor; also returns the rows fitted."""
    known = band.sum(axis=1) >= 3
    weight = band / np.maximum(band.sum(axis=1, keepdims=True), 1)
    h, y = above - _weighted_mean(above, weight), out - _weighted_mean(out, weight)
    square = h**2 - _weighted_mean(h**2, weight)
    # Least squares for b and c of each row; a row alone says little of c, all rows together say it well.
    hh, hs, ss = (_weighted_mean(x, weight)[:, 0] for x in (h * h, h * square, square * square))
    hy, sy = (_weighted_mean(x, weight)[:, 0] for x in (h * y, square * y))
    bend = (sy * hh - hy * hs) / np.maximum(ss * hh - hs * hs, 1e-12)
    c = float(np.median(bend[known])) if known.any() else 0.0
    b = (hy - c * hs) / np.maximum(hh, 1e-9)
    middle = _weighted_mean(above, weight)[:, 0]
    b = b - 2 * c * middle
    a = _weighted_mean(out - b[:, None] * above - c * above**2, weight)[:, 0]
    return np.stack([a, b, np.full_like(a, c)]), known


def _weighted_mean(field: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return (weight * field).sum(axis=1, keepdims=True)


def _meet_parabola(
    curve: np.ndarray, angle: np.ndarray, side: int, height: np.ndarray, slope: np.ndarray
) -> np.ndarray:
    """Distance from the axis to the parabola in each direction, m (Newton's method); NaN without a solution."""
    a, b, c = (coefficient[:, None] for coefficient in curve)
    across, descent = side * np.cos(angle), np.sin(angle) - slope * np.cos(angle)
    r = a / np.maximum(across, _BETWEEN)
    for _ in range(_NEWTON):
        h = np.clip(r * descent - height, -1.0, _FITTED[1])
        steepness = across - (b + 2 * c * h) * descent
        r = r - (r * across - (a + b * h + c * h * h)) / np.where(np.abs(steepness) < 0.05, 0.05, steepness)
        r = np.clip(r, 0.0, 4 * np.maximum(a, 0.1))
    h = r * descent - height
    return np.where(np.abs(r * across - (a + b * h + c * h * h)) < _CONVERGED, r, np.nan)


def is_floor(wall: Float[np.ndarray, "rows cols"], grid: Grid, floors: Floors) -> Bool[np.ndarray, "rows cols"]:
    """Return the cells where the wall lies on the floor."""
    return floors.radius(grid) <= wall + 1e-6


def clip_to_floor(wall: Float[np.ndarray, "rows cols"], grid: Grid, floors: Floors) -> Float[np.ndarray, "rows cols"]:
    """Return the wall where it is nearer than the floor, else the floor."""
    return np.minimum(wall, floors.radius(grid))
