"""Sleepers and rails where the cloud shows them: on the floor between the walls, above the ballast."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d

from scene.bore import Bore
from scene.cloud import Cloud

_RAIL_BAND = (0.60, 0.95)  # from the axis, m
_RAIL_LOW, _RAIL_HIGH = 0.12, 0.40  # above the bed, m
_HEAD_LAYER = 0.02  # above and below the most frequent height, m
_FACE = (0.012, 0.045)  # below the top of the head, m; gauge is measured 14 to 16 mm below it
_FACE_BAND = (0.66, 0.80)  # from the axis, m
_FACE_BLUR = 0.003  # m
_SWAY_BLOCK = 1.0  # m
_MIN_RAIL = 0.5  # share of the metres along which a rail must be seen
_MIN_RETURNS = 10  # returns a metre


@dataclass(frozen=True)
class SeenRails:
    """Both rails."""

    gauge: float  # Distance of the heads' inner faces, 12 to 45 mm below their tops, m
    centre: float  # Distance of the track to the left of the axis, m
    top: float  # Height of the heads' tops above the bed, m


def find_rails(station: np.ndarray, lateral: np.ndarray, height: np.ndarray) -> SeenRails | None:
    """Finds both rails among points by station, offset to the left of the axis and height above the bed, m.

    `None` where they are seen along too little of the bore.
    """
    heads = [_find_head(station, side * lateral, height) for side in (1, -1)]
    left, right = heads
    if left is None or right is None:
        return None
    sway = _sway(station, lateral, left, right)
    tops = [float(np.median(height[head])) for head in heads]
    faces = [_inner_face(side * (lateral - sway), height - top) for side, top in zip((1, -1), tops, strict=True)]
    return SeenRails(faces[0] + faces[1], (faces[0] - faces[1]) / 2, float(np.mean(tops)))


def _find_head(station: np.ndarray, across: np.ndarray, height: np.ndarray) -> Bool[np.ndarray, " n"] | None:
    """Returns on the top of one rail; `None` where it is seen along too little of the bore."""
    band = (across > _RAIL_BAND[0]) & (across < _RAIL_BAND[1]) & (height > _RAIL_LOW) & (height < _RAIL_HIGH)
    if len(np.unique(station[band].astype(int))) < _MIN_RAIL * max(np.ptp(station), 1.0):
        return None
    return band & (np.abs(height - _most_frequent(height[band])) < _HEAD_LAYER)


def _sway(station: np.ndarray, lateral: np.ndarray, left: np.ndarray, right: np.ndarray) -> Float[np.ndarray, " n"]:
    """Distance of the track to the left of its mean place under the axis, metre by metre, m.

    Both rails sway together: the axis follows the walls, and poses are a centimetre off here and there. Unless it is
    taken out it blurs the edges of the heads.
    """
    block = (station / _SWAY_BLOCK).astype(np.intp)
    blocks = int(block.max()) + 1
    middles = np.full((2, blocks), np.nan)
    for k, head in enumerate((left, right)):
        order = np.argsort(block[head], kind="stable")
        at, bounds = lateral[head][order], np.searchsorted(block[head][order], np.arange(blocks + 1))
        for i in range(blocks):
            if bounds[i + 1] - bounds[i] >= _MIN_RETURNS:
                middles[k, i] = np.median(at[bounds[i] : bounds[i + 1]])
    middle = middles.mean(axis=0)
    known = np.isfinite(middle)
    if known.sum() < 2:
        return np.zeros(len(station))
    at = (np.flatnonzero(known) + 0.5) * _SWAY_BLOCK
    return np.interp(station, at, middle[known] - np.median(middle[known]))


def _most_frequent(height: np.ndarray) -> float:
    count, edges = np.histogram(height, np.arange(_RAIL_LOW, _RAIL_HIGH, 0.004))
    return float(edges[np.convolve(count, np.ones(3), mode="same").argmax()] + 0.002)


def _inner_face(across: np.ndarray, below: np.ndarray) -> float:
    """Lateral distance where most returns from the side of the head lie, m.

    The side, not the edge of the top: poses that are a little off blur both, and a blurred edge moves outwards, while a
    blurred face stays where it is.
    """
    step = 0.001
    side = (below < -_FACE[0]) & (below > -_FACE[1])
    count, edges = np.histogram(across[side], np.arange(*_FACE_BAND, step))
    smooth = gaussian_filter1d(count.astype(float), _FACE_BLUR / step)
    k = int(np.clip(smooth.argmax(), 1, len(smooth) - 2))
    bend = 2 * (smooth[k - 1] - 2 * smooth[k] + smooth[k + 1])
    return float(edges[k] + step / 2 + (step * (smooth[k - 1] - smooth[k + 1]) / bend if bend else 0.0))


_BIN = 0.01  # m along
_SMOOTH = 0.09  # m, box; well below a sleeper's width
_BETWEEN_RAILS = 0.58  # m each side of the axis
_STEP = 0.03  # a return this far above the bed is on a sleeper, m
_HIGHEST = 0.15
_WIDTHS = (0.10, 0.40)
_TOP_LAYER = 0.012
_MIN_TOP = 10
_MIN_SEEN = 0.6  # of the sleepers that the median spacing asks for
_SPACINGS = (0.45, 0.80)  # in use, m


@dataclass(frozen=True)
class SeenSleepers:
    """Sleepers of a bore."""

    station: Float[np.ndarray, " k"]  # m
    measured: Bool[np.ndarray, " k"]  # Seen; the others stand where the spacing asks for one
    protrusion: float  # Median height of their tops above the bed, m


@dataclass(frozen=True)
class SeenTrack:
    """Track that the cloud shows; `None` for what it does not."""

    sleepers: SeenSleepers | None
    rails: SeenRails | None


def find_track(cloud: Cloud, bore: Bore) -> SeenTrack:
    """Finds sleepers and rails on the flat floor of a bore; a track on a round invert is not looked for."""
    station, lateral, height = _above_floor(cloud, bore)
    return SeenTrack(_find_sleepers(station, lateral, height, bore.length), find_rails(station, lateral, height))


def _above_floor(cloud: Cloud, bore: Bore) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Station, lateral offset and height above the floor of the points low in the bore, m."""
    station, lateral, upward = bore.axis.local(cloud.points.astype(np.float64))
    low = (upward < 0) & (np.abs(lateral) < 1.5) & (station > 0) & (station < bore.length)
    station, lateral, upward = station[low], lateral[low], upward[low]
    angle, radius = np.arctan2(upward, lateral), np.hypot(lateral, upward)
    row = np.clip(np.rint(station / (bore.station[1] - bore.station[0])).astype(np.intp), 0, len(bore.station) - 1)
    column = np.floor((angle + np.pi) / (2 * np.pi) * len(bore.angle)).astype(np.intp) % len(bore.angle)
    lean = angle - bore.angle[column]
    floor = bore.radius[row, column] * np.sin(bore.angle[column]) / np.sin(bore.angle[column] + lean)
    return station, lateral, (floor - radius) * -np.sin(angle)


def _find_sleepers(station: np.ndarray, lateral: np.ndarray, height: np.ndarray, length: float) -> SeenSleepers | None:
    near = (np.abs(lateral) < _BETWEEN_RAILS) & (height > -_HIGHEST) & (height < _HIGHEST)
    bins = max(int(np.ceil(length / _BIN)), 1)
    index = np.minimum((station[near] / _BIN).astype(np.intp), bins - 1)
    box = np.ones(round(_SMOOTH / _BIN))
    total = np.convolve(np.bincount(index, minlength=bins), box, mode="same")
    raised = np.convolve(np.bincount(index[height[near] > _STEP], minlength=bins), box, mode="same")
    share = np.divide(raised, total, out=np.zeros(bins), where=total > 2)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (share > 0.5).astype(int), [0]])))
    first, last = edges[::2], edges[1::2]
    wide = ((last - first) * _BIN > _WIDTHS[0]) & ((last - first) * _BIN < _WIDTHS[1])
    if wide.sum() < 3:
        return None
    centre = (first[wide] + last[wide]) / 2 * _BIN
    spacing = float(np.median(np.diff(centre)))
    if not _SPACINGS[0] < spacing < _SPACINGS[1] or wide.sum() < _MIN_SEEN * length / spacing:
        return None
    owner = _nearest_sleeper(centre, station[near])
    on_top = (np.abs(station[near] - centre[owner]) < 0.06) & (height[near] > _STEP)
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
        missing = round(gap / spacing) - 1
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
