"""Rails where the cloud shows them: two narrow ridges of one height, side by side all along the bore."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter1d, grey_opening, median_filter

from scene.geometry import find_runs

_WINDOWS = (2.0, 6.0)  # m along: so long that a bin of one holds some points
_POINTS, _ENOUGH = 8, 4  # of a bin that are needed, and with which rails are still reported
_LEAST = 100  # points
_BIN = 0.02  # m across
_LOW = (-0.10, 0.80)  # above the floor, m
# Bins: what is broader is a sleeper, a kerb or a walkway; poses a centimetre or two off broaden rails, too.
_NARROW = (9, 13)
_RIDGE = 0.07  # m that a rail stands over what is beside it
_APART = (0.95, 1.80)  # of the middles of two heads, m
_CANT = 0.16  # difference of two heads' heights, m
_ALIKE = 0.04  # m that the distance of two rails may differ by from window to window
_MIN_SEEN = 0.5  # fraction of the windows in which both rails must be seen
_BESIDE = 2.5  # least distance of two tracks, m
_DRIFT = 0.5  # m that a track's place under the axis may change by from window to window
_HEAD = 0.06  # m to each side of the middle of a head
_HEAD_LAYER = 0.02  # above and below the most frequent height, m
_FACE = (0.012, 0.045)  # below the top of the head, m; gauge is measured 14 to 16 mm below it
_CLEAR_FACE = (0.016, 0.032)  # the same of single returns, clear of the rounded edge and of what lies below a head, m
_TOP = 0.010  # above and below the top of the head, m
_FACE_BAND = 0.015  # m between the edge of the top and the face below it
_FACE_BLUR = 0.004  # m
_FACE_RETURNS = 12  # of one face of a head
# m: spread of the returns from the top of a head, 0.021 for 73 mm and 0.024 with a carried LiDAR's noise. Where poses
# blur it more, a face may look sharp that is a centimetre off.
_HEAD_SHARP = 0.025
_FACE_SHARP = 0.006  # m: spread of returns about the face; twice 15 mm of band, evenly filled, have 0.0087
_STRETCH = 8.0  # m of track of which one gauge is measured
_LEAST_STRETCHES = 2  # of track that show a gauge
_SURE = 0.003  # standard error of a gauge that counts as measured, m
_STRETCHES_AGREE = 0.004  # spread of stretches, m: where poses blur the faces all err alike, and more do not help
_FEW_PIECES = 6  # whose spread is their standard deviation: three agree with their median by chance


class LowPoints(NamedTuple):
    """Points low in a bore."""

    station: Float[np.ndarray, " n"]  # m
    lateral: Float[np.ndarray, " n"]  # To the left of the axis, m
    height: Float[np.ndarray, " n"]  # Above the floor, m
    upward: Float[np.ndarray, " n"]  # Above the axis, in which cant is measured, m

    def where(self, rows: Bool[np.ndarray, " n"]) -> "LowPoints":
        return LowPoints(*(column[rows] for column in self))


@dataclass(frozen=True)
class SeenRails:
    """Both rails of one track."""

    station: Float[np.ndarray, " k"]  # m
    offset: Float[np.ndarray, " k"]  # Of the middle of the track to the left of the axis there, m
    cant: Float[np.ndarray, " k"]  # Height of the left head over the right one, m
    apart: float  # Distance of the middles of the heads, about, m
    gauge: float  # Distance of the heads' inner faces below their tops, m; NaN where too few are seen
    spread: float  # Standard deviation of the gauge from stretch to stretch, m
    stretches: int  # Stretches of track that show a gauge
    top: float  # Median height of the heads' tops above the floor, m

    @property
    def measured(self) -> bool:
        """True where the gauge is known within a few millimetres."""
        agree = self.spread < _STRETCHES_AGREE and self.spread / np.sqrt(self.stretches) < _SURE
        return bool(self.stretches >= _LEAST_STRETCHES and agree)

    def offset_at(self, station: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return the place of the track's middle to the left of the axis, m."""
        return np.interp(station, self.station, self.offset)


def find_rails(points: LowPoints) -> list[SeenRails]:
    """Finds pairs of rails: one for each track, from the right to the left; none where not seen along half the bore."""
    found = (_find_pairs(points, narrow) for narrow in _NARROW)
    return max(found, key=len)  # the first of those with as many tracks


def can_show_rails(points: LowPoints) -> bool:
    """Return whether points on a floor lie close enough to tell a rail from what is beside it."""
    low = points.where((points.height > _LOW[0]) & (points.height < _LOW[1]))
    return len(low.station) >= _LEAST and _returns_a_bin(low) * _WINDOWS[1] >= _ENOUGH


def _returns_a_bin(low: LowPoints) -> float:
    """Number of points in a bin across for each metre along."""
    return float(len(low.station) / max(np.ptp(low.station), 1.0) * _BIN / np.ptp(low.lateral))


def _find_pairs(points: LowPoints, narrow: int) -> list[SeenRails]:
    """Finds pairs of ridges that are narrower than some bins; see `find_rails`."""
    low = points.where((points.height > _LOW[0]) & (points.height < _LOW[1]))
    if len(low.station) < _LEAST:
        return []
    station, a_metre = low.station, _returns_a_bin(low)
    count = max(int(np.ptp(station) / np.clip(_POINTS / a_metre, *_WINDOWS)), 1)
    edges = np.linspace(station.min(), station.max() + 1e-6, count + 1)
    order = np.argsort(station, kind="stable")
    bounds = np.searchsorted(station[order], edges)
    pairs = []
    for k in range(count):
        rows = order[bounds[k] : bounds[k + 1]]
        pairs += [(k, *pair) for pair in _pairs_of(*_ridges(low.lateral[rows], low.height[rows], narrow))]
    if not pairs:
        return []
    window, middle, apart, top = np.array(pairs).T
    highest_of = np.full(count, -np.inf)
    np.maximum.at(highest_of, window.astype(np.intp), top)
    usual_top = float(np.median(highest_of[np.isfinite(highest_of)]))
    highest = np.abs(top - usual_top) < _CANT / 2  # sleepers half in shadow look like rails, but lie lower
    window, middle, apart = window[highest], middle[highest], apart[highest]
    often, places = np.histogram(apart, np.arange(_APART[0] - 0.1, _APART[1] + 0.1, 0.01))
    best = places[np.convolve(often, np.ones(5), mode="same").argmax()] + 0.005  # the most frequent distance
    usual = float(np.median(apart[np.abs(apart - best) < _ALIKE]))
    alike = np.abs(apart - usual) < _ALIKE
    tracks = []
    for rows in _follow(window[alike], middle[alike]):
        index = window[alike][rows].astype(np.intp)
        if len(index) >= _MIN_SEEN * count:
            at = (edges[index] + edges[index + 1]) / 2
            offset = median_filter(middle[alike][rows], 3, mode="nearest")
            tracks.append(_measure(low, at, offset, float(usual), _FACE))
    tracks.sort(key=lambda track: -len(track.station))
    alone = [
        track for k, track in enumerate(tracks)
        if all(np.abs(np.median(track.offset_at(other.station) - other.offset)) > _BESIDE for other in tracks[:k])
    ]  # fmt: skip
    return sorted(alone, key=lambda track: float(np.median(track.offset)))


def measure_again(rails: SeenRails, returns: LowPoints) -> SeenRails:
    """Return rails with the gauge that single returns near them show, as they were where these show none sharply.

    Returns from nearer than some metres had better be left out.
    """
    if len(returns.station) < _FACE_RETURNS:
        return rails
    seen = _measure(returns, rails.station, rails.offset, rails.apart, _CLEAR_FACE)
    return replace(rails, gauge=seen.gauge, spread=seen.spread, stretches=seen.stretches) if seen.measured else rails


def _ridges(lateral: np.ndarray, height: np.ndarray, narrow: int) -> tuple[np.ndarray, np.ndarray]:
    """Return place across and height of ridges in one window that are narrower than some bins, m."""
    if len(lateral) < 20:
        return np.empty(0), np.empty(0)
    first = lateral.min()
    bins = ((lateral - first) / _BIN).astype(np.intp)
    order = np.lexsort((height, bins))
    used, start, count = np.unique(bins[order], return_index=True, return_counts=True)
    top = np.full(int(used[-1]) + 1, np.nan)
    top[used] = height[order][start + (0.9 * (count - 1)).astype(np.intp)]
    known = np.flatnonzero(np.isfinite(top))
    place = np.searchsorted(known, np.arange(len(top)))
    left = top[known[np.clip(place - 1, 0, len(known) - 1)]]
    right = top[known[np.clip(place, 0, len(known) - 1)]]
    top = np.where(np.isnan(top), np.minimum(left, right), top)  # behind a rail nothing is seen
    padded = np.pad(top, narrow, mode="edge")
    high = (padded - grey_opening(padded, narrow))[narrow:-narrow] > _RIDGE
    ridges = find_runs(high)
    return first + ridges.sum(axis=1) / 2 * _BIN, np.array([np.median(top[a:b]) for a, b in ridges])


def _pairs_of(middle: np.ndarray, top: np.ndarray) -> list[tuple[float, float, float]]:
    """Return middle, distance and mean height of two ridges that may be the rails of one track, m."""
    apart, rise = middle[None] - middle[:, None], np.abs(top[None] - top[:, None])
    a, b = np.nonzero((apart > _APART[0]) & (apart < _APART[1]) & (rise < _CANT))
    return [
        (float(middle[i] + middle[j]) / 2, float(middle[j] - middle[i]), float(top[i] + top[j]) / 2)
        for i, j in zip(a, b, strict=True)
    ]


def _follow(window: np.ndarray, middle: np.ndarray) -> list[np.ndarray]:
    """Return the rows of each track: pairs of rails that follow on one another from window to window."""
    tracks: list[list[int]] = []
    for row in np.lexsort((middle, window)):
        ends = [(abs(middle[row] - middle[track[-1]]), k) for k, track in enumerate(tracks)]
        near = [(gap, k) for gap, k in ends if window[tracks[k][-1]] < window[row]]
        gap, k = min(near, default=(np.inf, -1))
        if gap < _DRIFT:
            tracks[k].append(int(row))
        else:
            tracks.append([int(row)])
    return [np.array(track) for track in tracks]


def _measure(
    points: LowPoints, at: np.ndarray, offset: np.ndarray, apart: float, face: tuple[float, float]
) -> SeenRails:
    """Measures gauge, cant and height of one track, whose middle lies at `offset` where `at` says, m.

    `face` is the layer below the heads' tops that their inner faces are looked for in, m.
    """
    station, lateral, height, upward = points
    for _ in range(2):
        across = lateral - np.interp(station, at, offset)
        block = np.clip(np.searchsorted((at[1:] + at[:-1]) / 2, station), 0, len(at) - 1)
        near = {side: np.abs(side * across - apart / 2) < _HEAD for side in (1, -1)}
        tops = {side: _block_tops(height, block, rows, len(at)) for side, rows in near.items()}
        heads = {side: rows & (np.abs(height - tops[side][block]) < _HEAD_LAYER) for side, rows in near.items()}
        shift = np.mean([_block_medians(across, block, rows, len(at)) for rows in heads.values()], axis=0)
        offset = offset + np.where(np.isfinite(shift), shift, 0.0)
    offset = gaussian_filter1d(offset, 1.0, mode="nearest")
    across = lateral - np.interp(station, at, offset)
    stretches = np.clip((station - at[0]) / _STRETCH, 0, max(int(np.ptp(at) / _STRETCH) - 1, 0)).astype(np.intp)
    below = {side: height - tops[side][block] for side in near}
    gauge = _gauges(across, below, near, stretches, face)
    levels = [_block_medians(upward, block, rows, len(at)) for rows in heads.values()]
    cant = levels[0] - levels[1]
    known = np.isfinite(cant)
    even = np.interp(at, at[known], cant[known]) if known.any() else np.zeros(len(at))
    smooth = median_filter(even, 5, mode="nearest")
    gauge *= np.hypot(1.0, np.median(smooth) / apart)  # along the plane of both heads, not across the level
    return SeenRails(
        at, offset, smooth, apart, float(np.median(gauge)) if len(gauge) else np.nan,
        _robust_spread(gauge), len(gauge),
        float(np.nanmedian(np.concatenate(list(tops.values())))),
    )  # fmt: skip


def _gauges(
    across: np.ndarray,
    below: dict[int, np.ndarray],
    near: dict[int, np.ndarray],
    stretches: np.ndarray,
    face: tuple[float, float],
) -> Float[np.ndarray, " k"]:
    """Measures the gauge of each stretch of track that shows both inner faces, m.

    `across` is to the left of the track's middle; `below`, height above the head's top, and `near` are given by side.
    """
    gauges = np.zeros(int(stretches.max()) + 1)
    for stretch in range(len(gauges)):
        for side, rows in near.items():
            inside = rows & (stretches == stretch)
            gauges[stretch] += _inner_edge((side * across)[inside], below[side][inside], face)
    return gauges[np.isfinite(gauges)]


def _robust_spread(values: np.ndarray) -> float:
    """Standard deviation, of many values by the median distance from the median; NaN for fewer than two values."""
    if len(values) < _FEW_PIECES:
        return float(np.std(values, ddof=1)) if len(values) > 1 else np.nan
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def _block_tops(height: np.ndarray, block: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """Most frequent height near the top of each block's points, m."""
    result = np.full(count, np.nan)
    for k, own in _blocks(block, rows, count):
        one = height[own]
        if len(one) >= 5:
            upper = one[one > np.percentile(one, 90) - 0.04]
            result[k] = np.median(upper[upper > np.percentile(upper, 30)])
    known = np.isfinite(result)
    return np.interp(np.arange(count), np.flatnonzero(known), result[known]) if known.any() else np.zeros(count)


def _block_medians(value: np.ndarray, block: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """Median of each block's values, less the middle of both sides where it is an offset; NaN where few are there."""
    result = np.full(count, np.nan)
    for k, own in _blocks(block, rows, count):
        if len(own) >= 5:
            result[k] = np.median(value[own])
    return result


def _blocks(block: np.ndarray, rows: np.ndarray, count: int) -> Iterator[tuple[int, Int[np.ndarray, " k"]]]:
    """Yields the number of each block, and those of its points that are among `rows`."""
    order = np.flatnonzero(rows)[np.argsort(block[rows], kind="stable")]
    return enumerate(np.split(order, np.searchsorted(block[order], np.arange(1, count))))


def _inner_edge(across: np.ndarray, above: np.ndarray, face: tuple[float, float]) -> float:
    """Distance from the track's middle where a head ends on its inner side, m.

    NaN where too few returns show it, or poses blur it.

    It is where most returns from the side of the head lie. The edge of the top, where that side is out of sight, would
    be up to a centimetre off: poses that are a little off move it outwards, while a blurred face stays where it is.
    """
    top = across[np.abs(above) < _TOP]
    if len(top) < _FACE_RETURNS or np.std(top) > _HEAD_SHARP:
        return np.nan
    edge = float(np.mean(top) - np.sqrt(3.0) * np.std(top))  # of what is spread evenly over a head
    side = across[(above < -face[0]) & (above > -face[1])]
    side = side[np.abs(side - edge) < _FACE_BAND]
    if len(side) < _FACE_RETURNS or np.std(side) > _FACE_SHARP:
        return np.nan
    step = 0.001
    count, edges = np.histogram(side, np.arange(side.min() - 0.01, side.max() + 0.01, step))
    smooth = gaussian_filter1d(count.astype(float), _FACE_BLUR / step)
    mode = edges[smooth.argmax()] + step / 2
    for _ in range(5):
        weight = np.exp(-0.5 * ((side - mode) / (1.5 * _FACE_BLUR)) ** 2)
        mode = float(np.sum(weight * side) / np.sum(weight))
    return mode
