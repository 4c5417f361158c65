"""The tracks that a cloud shows: their rails, and the sleepers that stand out of floor or ballast.

The gauge is read off single returns: in a thinned cloud the mean of a voxel mixes the side of a head with its top.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from scene.bore import Bore
from scene.cloud import Cloud
from scene.fitting.evidence import steadier_than_chance
from scene.fitting.rails import LowPoints, SeenRails, can_show_rails, find_rails, measure_again
from scene.geometry import angle_bins, find_runs

_BIN = 0.01  # m along
_SMOOTH = 0.09  # m, box; well below a sleeper's width
_BETWEEN_RAILS = 0.58  # m each side of the axis
_STEP = 0.03  # a return this far above the bed is on a sleeper, m
_HIGHEST = 0.15  # m above the bed that a sleeper stands out
_LOW_TOP = 0.10  # tops up to here stand out of ballast that lies even, m
_TOPMOST = 0.45  # above the floor, m
_RAIL_LEAST = 0.09  # from the top of a sleeper to that of the rail, m
_LEVEL_BIN = 0.01  # m of height
_LAYER_FRACTION = 0.3  # of the returns of the fullest layer
_WALL = 0.25  # m
_ASIDE = 0.05  # m
_FOOT = 0.15  # from the middle of a rail, m
_MISSING = 1.65  # times the usual distance
_WIDTHS = (0.10, 0.40)  # m along the track, least and largest of a sleeper
_TOP_LAYER = 0.012  # m above and below the top of the sleepers
_MIN_TOP = 10  # returns on the top of a sleeper that tell its middle
_MIN_SEEN = 0.6  # of the sleepers that the median spacing asks for
_SPACINGS = (0.45, 0.80)  # in use, m


@dataclass(frozen=True)
class SeenSleepers:
    """Sleepers of a bore."""

    station: Float[np.ndarray, " k"]  # m
    measured: Bool[np.ndarray, " k"]  # Seen; the others stand where the spacing asks for one
    protrusion: float  # Median height of their tops above the bed, m


@dataclass(frozen=True)
class SeenLine:
    """One track that the cloud shows; `None` for what it does not show of it."""

    sleepers: SeenSleepers | None
    rails: SeenRails | None
    bed: float = 0.0  # Median height of what is seen between the rails, above the floor, m


@dataclass(frozen=True)
class SeenTrack:
    """All tracks that a survey shows."""

    lines: tuple[SeenLine, ...] = ()  # From the right to the left
    sought: bool = False  # False where the survey could not show any, as rings of points on the wall
    thin: bool = False  # True where too few returns lie on the floor to show rails

    @property
    def shows_rails(self) -> bool:
        return any(line.rails is not None for line in self.lines)


def find_track(cloud: Cloud, bore: Bore, flat_floor: bool = True) -> SeenTrack:
    """Finds the tracks in a bore by their rails; where there is no rail, one on its axis by sleepers.

    On a round invert nothing is looked for but rails.
    """
    points = above_floor(cloud.points.astype(np.float64), bore)
    station, lateral, height, _ = points
    lines = []
    for rails in find_rails(points):
        # Sleepers need no better than 5 cm, and so depend on little else.
        across = lateral - np.round(rails.offset_at(station) / _ASIDE) * _ASIDE
        inside = np.abs(across) < min(_BETWEEN_RAILS, rails.apart / 2 - _FOOT)
        between = height[inside]
        sleepers = _find_sleepers(station[inside], between, bore.length, rails.top) if flat_floor else None
        lines.append(SeenLine(sleepers, rails, float(np.median(between)) if len(between) else 0.0))
    if not lines and flat_floor:
        inside = np.abs(lateral) < _BETWEEN_RAILS
        sleepers = _find_sleepers(station[inside], height[inside], bore.length, None)
        lines = [SeenLine(sleepers, None)] if sleepers is not None else []
    return SeenTrack(tuple(lines), sought=True, thin=not can_show_rails(points))


def above_floor(points: Float[np.ndarray, "n 3"], bore: Bore) -> LowPoints:
    """Return the points low in the bore."""
    station, lateral, upward = bore.axis.local(points)
    widest = float(np.median(bore.width)) / 2 - _WALL
    low = (upward < 0) & (np.abs(lateral) < widest) & (station > 0) & (station < bore.length)
    station, lateral, upward = station[low], lateral[low], upward[low]
    angle, radius = np.arctan2(upward, lateral), np.hypot(lateral, upward)
    row = bore.row_of(station)
    column = angle_bins(angle, len(bore.angle))
    lean = angle - bore.angle[column]
    floor = bore.radius[row, column] * np.sin(bore.angle[column]) / np.sin(bore.angle[column] + lean)
    return LowPoints(station, lateral, (floor - radius) * -np.sin(angle), upward)


def _top_level(height: np.ndarray, rail_top: float | None) -> float:
    """Height of the uppermost layer between the rails that many returns lie in, m; 0 without one."""
    highest = min(_TOPMOST, np.inf if rail_top is None else rail_top - _RAIL_LEAST)
    count, edges = np.histogram(height, np.arange(_STEP, highest + _LEVEL_BIN, _LEVEL_BIN))
    if not count.sum():
        return 0.0
    near = np.convolve(count, np.ones(2), mode="same")
    layers = np.flatnonzero(near >= _LAYER_FRACTION * near.max())
    top = int(layers[-1])
    top -= int(np.argmax(near[max(top - 2, 0) : top + 1][::-1]))
    return float(edges[top])


def _find_sleepers(
    station: np.ndarray, height: np.ndarray, length: float, rail_top: float | None
) -> SeenSleepers | None:
    """Finds sleepers among points between the rails, by station and height above the floor, m."""
    level = _top_level(height, rail_top)
    step, highest = (level - _STEP, level + _HIGHEST - _LOW_TOP) if level > _LOW_TOP else (_STEP, _HIGHEST)
    near = (height > -_HIGHEST) & (height < highest)
    if not near.any():
        return None
    bins = max(int(np.ceil(length / _BIN)), 1)
    index = np.minimum((station[near] / _BIN).astype(np.intp), bins - 1)
    box = np.ones(round(_SMOOTH / _BIN))
    total = np.convolve(np.bincount(index, minlength=bins), box, mode="same")
    raised = np.convolve(np.bincount(index[height[near] > step], minlength=bins), box, mode="same")
    fraction = np.divide(raised, total, out=np.zeros(bins), where=total > 2)
    first, last = find_runs(fraction > 0.5).T
    wide = ((last - first) * _BIN > _WIDTHS[0]) & ((last - first) * _BIN < _WIDTHS[1])
    if wide.sum() < 3:
        return None
    centre = (first[wide] + last[wide]) / 2 * _BIN
    apart = np.diff(centre)  # twice as far where a sleeper between was not seen
    spacing = float(np.mean(apart[apart < _MISSING * np.median(apart)]))
    if not _SPACINGS[0] < spacing < _SPACINGS[1] or wide.sum() < _MIN_SEEN * length / spacing:
        return None
    if not steadier_than_chance(apart):
        return None
    owner = _nearest_sleeper(centre, station[near])
    on_top = (np.abs(station[near] - centre[owner]) < 0.06) & (height[near] > step)
    protrusion = float(np.median(height[near][on_top]))
    middles = _sleeper_middles(centre, station[near], height[near], protrusion)
    place, measured = _complete_sleepers(middles, spacing, length)
    return SeenSleepers(place, measured, protrusion)


def _nearest_sleeper(centre: np.ndarray, station: np.ndarray) -> np.ndarray:
    right = np.clip(np.searchsorted(centre, station), 1, len(centre) - 1)
    return np.where(station - centre[right - 1] < centre[right] - station, right - 1, right)


def _sleeper_middles(centre: np.ndarray, station: np.ndarray, height: np.ndarray, protrusion: float) -> np.ndarray:
    """Middle of each sleeper's top; its near face and the shadow behind it would pull a mean to one side."""
    owner = _nearest_sleeper(centre, station)
    top = (np.abs(height - protrusion) < _TOP_LAYER) & (np.abs(station - centre[owner]) < _WIDTHS[1] / 2)
    order = np.lexsort((station[top], owner[top]))
    at, bounds = station[top][order], np.searchsorted(owner[top][order], np.arange(len(centre) + 1))
    middles = centre.copy()
    for k in range(len(centre)):
        seen = at[bounds[k] : bounds[k + 1]]
        if len(seen) >= _MIN_TOP:
            middles[k] = np.mean(np.percentile(seen, [5, 95]))
    return middles


def _complete_sleepers(centre: np.ndarray, spacing: float, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the seen sleepers, and one wherever the spacing asks for one that was not seen."""
    places, measured = [float(centre[0])], [True]
    for following in centre[1:]:
        gap = following - places[-1]
        missing = round(gap / spacing) - 1 if gap > _MISSING * spacing else 0
        if gap < 0.6 * spacing:
            continue
        for k in range(missing):
            places.append(places[-1] + (following - places[-1]) / (missing - k + 1))
            measured.append(False)
        places.append(float(following))
        measured.append(True)
    while places[0] - spacing > 0.1:
        places.insert(0, places[0] - spacing)
        measured.insert(0, False)
    while places[-1] + spacing < length - 0.1:
        places.append(places[-1] + spacing)
        measured.append(False)
    return np.array(places), np.array(measured)


_TALLEST = 0.8  # m above the floor
_BESIDE = 0.10  # m to each side of the middle of a rail
_CHUNK = 500_000  # points; bounds the memory


def measure_gauge(seen: SeenTrack, low: Float[np.ndarray, "n 3"], bore: Bore) -> SeenTrack:
    """Measures the gauge of each track anew by single returns; what they do not show sharply stays.

    `low` are single returns below the LiDAR, in the tunnel frame, m; none of a cloud that came registered.
    """
    if not seen.shows_rails or not len(low):
        return seen
    parts = [_beside_rails(low[k : k + _CHUNK], bore, seen.lines) for k in range(0, len(low), _CHUNK)]
    near = LowPoints(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    lines = (replace(one, rails=measure_again(one.rails, near)) if one.rails else one for one in seen.lines)
    return replace(seen, lines=tuple(lines))


def _beside_rails(points: Float[np.ndarray, "n 3"], bore: Bore, lines: tuple[SeenLine, ...]) -> LowPoints:
    low = above_floor(points, bore)
    near = np.zeros(len(low.station), bool)
    for rails in (line.rails for line in lines if line.rails is not None):
        near |= np.abs(np.abs(low.lateral - rails.offset_at(low.station)) - rails.apart / 2) < _BESIDE
    return low.where(near & (np.abs(low.height) < _TALLEST))
