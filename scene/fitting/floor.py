"""The flat floor along a bore: a line in each section under sleepers, rails and people, and the foot of the walls."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_opening, gaussian_filter1d, median_filter

from scene.fitting.unroll import Grid
from scene.geometry import Axis

# What lies a little above the line may be track or clutter; what lies below is noise.
_GATES = ((-0.15, 0.10), (-0.08, 0.05), (-0.05, 0.04), (-0.04, 0.04))
_START_PERCENTILE = 20  # of the heights of the lower half, where a line begins
_CLUTTER = 0.45  # m above the floor that track and people explain
_MIN_POINTS = 30  # points of a line
_FLAT_FRACTION = 0.85  # of the bottom that a line explains
_INNER = 0.75  # of the half width: further out are corners
_BESIDE = 0.5  # of the half width: further in is track


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
    line, keep = _settle(line, y, z, half_width)
    beside = keep & (np.abs(y) > _BESIDE * half_width)
    if min((beside & (y > 0)).sum(), (beside & (y < 0)).sum()) >= _MIN_POINTS:
        line = _fit_through(y[beside], z[beside])  # beside the track, where no sleeper lifts it
    residual = z - line[0] - line[1] * y
    explained = (np.abs(residual) < 0.06) | ((residual > 0) & (residual < _CLUTTER))
    support = (np.abs(residual) < 0.06).mean()
    return line if explained.mean() > _FLAT_FRACTION and support > 0.3 else None


_PEAK = (-0.08, 0.08)  # m about a line, in which the height is sought that most points have
_PEAK_BIN, _PEAK_HALF = 0.01, 0.025  # m


def _settle(
    line: tuple[float, float], y: np.ndarray, z: np.ndarray, half_width: float
) -> tuple[tuple[float, float], Bool[np.ndarray, " n"]]:
    """Moves a line to the height that most points near it have: sleepers 6 cm proud would lift it by 1 to 3 cm.

    Returns the line, and the points on it.
    """
    residual = z - line[0] - line[1] * y
    count, edges = np.histogram(residual, np.arange(_PEAK[0], _PEAK[1] + _PEAK_BIN / 2, _PEAK_BIN))
    peak = float(edges[int(np.convolve(count, np.ones(3), mode="same").argmax())]) + _PEAK_BIN / 2
    keep = np.abs(residual - peak) < _PEAK_HALF
    if keep.sum() < _MIN_POINTS or np.ptp(y[keep]) < half_width:
        return line, np.abs(residual) < -_GATES[-1][0]
    return _fit_through(y[keep], z[keep]), keep


_STRIPS = 24  # that the width between the walls is divided into
_OUT = 0.97  # of the half width
_LAYER = 0.02  # m
_SLOPES = np.linspace(-0.06, 0.06, 7)
_LEAST_FRACTION = 0.1  # of the returns of a strip of floor, in a strip that shows it
_LEAST_EXTENT, _MOST_DEEPER = 0.15, 0.2  # of the strips, shown on the floor and below it: a drain is narrower
_BESIDE_PLATFORM, _FLOOR_BESIDE = 0.6, 0.35  # of the strips, near the floor and on it, where a platform stands on it
_LOWER = 0.05  # m that a lower floor lies below the first line
_NEAR = 0.04  # m


def find_lower_line(
    lateral: Float[np.ndarray, " n"], upward: Float[np.ndarray, " n"], above: tuple[float, float] | None
) -> tuple[float, float] | None:
    """Finds the lowest flat surface of one section, under a line that `fit_floor_line` found, if it found one.

    Sleepers and ballast may hide most of a floor, and ghosts of people return more than it does. What tells it is how
    much of the width it is seen on, whatever the number of returns, with nothing flat below. Returns `(a, b)` as
    `fit_floor_line`; `None` where there is no such surface.
    """
    half_width = np.percentile(np.abs(lateral), 95) if len(lateral) >= _MIN_POINTS else 0.0
    low = (upward < 0) & (np.abs(lateral) < _OUT * half_width)
    y, z = lateral[low], upward[low]
    if len(y) < _MIN_POINTS:
        return None
    strip = np.minimum(((y / (_OUT * half_width) + 1) * _STRIPS / 2).astype(np.intp), _STRIPS - 1)
    layer = max((_best_layer(y, z, strip, float(slope)) for slope in _SLOPES), key=lambda layer: layer.worth)
    highest = np.inf if above is None else above[0] - _LOWER
    if layer.worth <= 0.0 or layer.line[0] > highest:
        return None
    line = _refine_line(layer.line, y, z, half_width, 0.0 if above is None else above[1])
    inner = layer.bottoms[np.abs(np.arange(_STRIPS) - (_STRIPS - 1) / 2) < _INNER * _STRIPS / 2]
    clutter = float(((inner > -0.06) & (inner < _CLUTTER)).mean())
    flat = clutter > _FLAT_FRACTION or (clutter > _BESIDE_PLATFORM and layer.extent > _FLOOR_BESIDE)
    return line if flat and line is not None and line[0] < highest else None


@dataclass(frozen=True)
class _Layer:
    """A layer of returns that may be the floor of a section."""

    worth: float  # Score among the layers of all slopes; 0 where it is no floor.
    line: tuple[float, float]  # Height at the axis (m) and slope.
    extent: float  # Fraction of the strips whose lowest returns lie in it.
    # Height of each strip's lowest returns above it, m; `inf` where a strip shows nothing.
    bottoms: Float[np.ndarray, " strips"]


def _best_layer(
    y: Float[np.ndarray, " n"], z: Float[np.ndarray, " n"], strip: Int[np.ndarray, " n"], slope: float
) -> _Layer:
    """Return the layer of a slope that is the lowest on most of the width."""
    layer = np.floor((z - slope * y) / _LAYER).astype(np.intp)
    first = layer.min()
    layers = max(int(layer.max() - first) + 1, 8)
    count = np.bincount(strip * layers + layer - first, minlength=_STRIPS * layers).reshape(_STRIPS, layers)
    thick = count.copy()  # three layers
    thick[:, 1:] += count[:, :-1]
    thick[:, :-1] += count[:, 1:]
    shown = thick >= max(2.0, _LEAST_FRACTION * float(np.median(thick.max(axis=1))))
    bottom = np.where(shown.any(axis=1), np.argmax(shown, axis=1), layers)
    lowest = np.bincount(bottom, minlength=layers + 1)[:layers] / _STRIPS
    extent = np.convolve(lowest, np.ones(3), mode="same")
    total = np.concatenate([np.zeros(3), np.cumsum(lowest), np.full(4, lowest.sum())])
    deeper, close = total[:layers], total[7:] - total[4:-3]  # more than 5 cm below; 3 to 9 cm above
    worth = extent - 3 * deeper - close - abs(slope)
    worth[(extent < _LEAST_EXTENT) | (deeper > _MOST_DEEPER)] = 0.0
    best = int(np.argmax(worth))
    line = ((first + best + 1.5) * _LAYER, slope)
    bottoms = np.where(bottom < layers, (bottom - best) * _LAYER, np.inf)
    return _Layer(float(worth[best]), line, float(extent[best]), bottoms)


def _refine_line(
    line: tuple[float, float], y: np.ndarray, z: np.ndarray, half_width: float, slope: float
) -> tuple[float, float] | None:
    """Fit a line to the returns near it; `slope` is that of a surface seen in the middle alone. `None`: too few."""
    for _ in range(3):
        keep = np.abs(z - line[0] - line[1] * y) < _NEAR
        if keep.sum() < _MIN_POINTS // 2:
            return None
        if np.ptp(y[keep]) > half_width:
            line = _fit_through(y[keep], z[keep])
        else:  # as between two tracks
            line = (float(np.mean(z[keep] - slope * y[keep])), slope)
    return line


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
_NEWTON, _CONVERGED = 6, 0.01  # steps; m


@dataclass(frozen=True)
class Floors:
    """Floor lines of sections."""

    station: Float[np.ndarray, " k"]  # m; a section in which no floor is seen is left out
    height: Float[np.ndarray, " k"]  # On the axis, m
    slope: Float[np.ndarray, " k"]  # Rise for each metre to the left

    def radius(self, grid: Grid) -> Float[np.ndarray, "rows cols"]:
        """Return the distance from the axis to the floor in each direction, m; `inf` where it is not met."""
        height = np.interp(grid.station, self.station, self.height)[:, None]
        slope = np.interp(grid.station, self.station, self.slope)[:, None]
        descent = np.sin(grid.angle) - slope * np.cos(grid.angle)
        return np.where(descent < -1e-3, height / np.minimum(descent, -1e-3), np.inf)


def find_floors(
    station: np.ndarray, lateral: np.ndarray, upward: np.ndarray, start: float, end: float, axis: Axis | None = None
) -> Floors | None:
    """Return a floor line every half metre, smoothed along; `None` where fewer than half of the sections have one.

    A section may show several surfaces: the floor, sleepers on it, a vehicle's roof. Those are taken that run on
    evenly from section to section, the lower before the higher. Where none is seen the floor runs on straight, even
    where the axis does not: what hides a floor may move the axis, too.
    """
    count = max(int((end - start) / _FLOOR_STEP), 1)
    middle = start + (np.arange(count) + 0.5) * (end - start) / count
    order = np.argsort(station, kind="stable")
    inside = int(((station >= start) & (station <= end)).sum())
    needed = _ENOUGH / max(inside, 1) * (end - start)  # more than a section's where a cloud is thin
    half = max(min(needed, _LONGEST_WINDOW), (end - start) / count) / 2
    first, last = (np.searchsorted(station[order], middle + side * half) for side in (-1, 1))
    lines: list[list[tuple[float, float]]] = []
    for k in range(count):
        rows = order[first[k] : last[k]]
        rows = rows[:: max(1, len(rows) // 4000)]
        upper = fit_floor_line(lateral[rows], upward[rows])
        lower = find_lower_line(lateral[rows], upward[rows], upper)
        found = [line for line in (lower, upper) if line is not None]
        lines.append(found or _lines_beside_pit(lateral[rows], upward[rows]))
    sway = np.zeros(count) if axis is None else _sway(np.interp(middle, axis.station, axis.position[:, 2]), middle)
    chosen = _even_run([[line[0] + sway[k] for line in section] for k, section in enumerate(lines)])
    if len(chosen) < 0.5 * count:
        return None
    seen = np.array([k for k, _ in chosen])
    at = middle[seen]
    height, slope = np.array([lines[k][which] for k, which in chosen]).T
    if np.diff(seen).max(initial=1) > _GAP:
        height = np.interp(middle, at, height + sway[seen]) - sway
        slope, at = np.interp(middle, at, slope), middle
    sigma = _FLOOR_SIGMA / (end - start) * count
    height, slope = (
        gaussian_filter1d(median_filter(v, 3, mode="nearest"), sigma, mode="nearest") for v in (height, slope)
    )
    return Floors(at, height, slope)


_ENOUGH, _LONGEST_WINDOW = 1000, 4.0  # points that show a floor beside sleepers; m
_MIDDLE, _PIT, _PIT_FRACTION = 1.2, 0.5, 0.05  # m beside the axis; m below its floor; fraction of the returns that low


def _lines_beside_pit(lateral: np.ndarray, upward: np.ndarray) -> list[tuple[float, float]]:
    """Return the floor about the axis of a section that is much deeper beside it, as under a platform; else nothing."""
    near = np.abs(lateral) < _MIDDLE
    line = fit_floor_line(lateral[near], upward[near])
    if line is None:
        return []
    deep = upward < line[0] + line[1] * lateral - _PIT
    return [line] if deep.mean() > _PIT_FRACTION else []


_GAP = 4  # sections without a floor beyond which it runs on by itself, not beside the axis
_TREND = 12.0  # m


def _sway(height: np.ndarray, station: np.ndarray) -> np.ndarray:
    """Height of the axis above its own smooth course, m: what hides a floor from view moves it."""
    trend = np.polynomial.Polynomial.fit(station, height, 1)(station) if len(station) > 1 else height
    rest = height - trend
    sigma = _TREND / _FLOOR_STEP
    return rest - gaussian_filter1d(median_filter(rest, round(4 * sigma) + 1, mode="nearest"), sigma, mode="nearest")


_SKIP, _HIGHER = 0.6, 0.5  # cost of a section left out, of a surface above another one
_STEADY, _JUMP = 0.03, 0.02  # m that two neighbours may differ by; m beyond it that cost 1
_LONGEST_SKIP = 80  # sections


def _even_run(heights: list[list[float]]) -> list[tuple[int, int]]:
    """Choose at most one of the heights of each section, lowest first, m, so that they run on evenly.

    Returns section and index of each that was chosen, by the shortest path through all of them.
    """
    nodes = [(k, which, height) for k, section in enumerate(heights) for which, height in enumerate(section)]
    if not nodes:
        return []
    section, which, height = (np.array(column) for column in zip(*nodes, strict=True))
    cost, before = np.empty(len(nodes)), np.full(len(nodes), -1)
    first = np.searchsorted(section, section - _LONGEST_SKIP)
    for i in range(len(nodes)):
        j = np.arange(first[i], np.searchsorted(section, section[i]))
        cost[i] = _SKIP * section[i]
        if len(j):
            jump = np.maximum(np.abs(height[i] - height[j]) - _STEADY, 0.0) / _JUMP
            path = cost[j] + jump + _SKIP * (section[i] - section[j] - 1)
            k = int(np.argmin(path))
            if path[k] < cost[i]:
                cost[i], before[i] = path[k], j[k]
        cost[i] += _HIGHER * which[i]
    i = int(np.argmin(cost + _SKIP * (len(heights) - 1 - section)))
    chosen = []
    while i >= 0:
        chosen.append((int(section[i]), int(which[i])))
        i = int(before[i])
    return chosen[::-1]


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
    # Between the feet the floor itself will do, whatever stands on it.
    under = (np.abs(np.cos(grid.angle)) < _BETWEEN) & (np.sin(grid.angle) < 0)
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
        low &= ~_has_walkway(above, out, facing & (np.sin(grid.angle) < 0), grid)[:, None]
        result = np.where(low & known[:, None], foot, result)
    return result


_WALKWAY = (0.08, 1.4)  # of its top above the floor, m
_LEVEL = 0.35  # rise for each metre across
_BROAD, _LONG = 0.3, 4.0  # m
_AT_WALL = 0.25  # m


def _has_walkway(above: np.ndarray, out: np.ndarray, facing: np.ndarray, grid: Grid) -> Bool[np.ndarray, " rows"]:
    """Return the rows in which a level strip lies between floor and wall on one side, for some metres along."""
    columns = np.flatnonzero(facing)
    columns = columns[np.argsort(np.abs(grid.angle[columns] + np.pi / 2), kind="stable")]  # from below outwards
    h, y = above[:, columns], out[:, columns]
    rise, run = np.diff(h, axis=1), np.diff(y, axis=1)
    level = (np.abs(rise) < _LEVEL * np.abs(run)) & (run > 0)
    level &= (h[:, 1:] > _WALKWAY[0]) & (h[:, 1:] < _WALKWAY[1]) & (h[:, :-1] > _WALKWAY[0])
    wall = np.where(h < _WALKWAY[1], y, 0.0).max(axis=1, initial=0.0)
    reaches = (level & (y[:, 1:] > wall[:, None] - np.maximum(run, _AT_WALL))).any(axis=1)  # columns are half a metre
    broad = np.where(level, run, 0.0).sum(axis=1) > _BROAD
    return binary_opening(reaches & broad, np.ones(max(round(_LONG / grid.step), 1), bool))


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
