"""Sleepers and rails where the cloud shows them: on the floor between the walls, above the ballast."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from scene.bore import Bore
from scene.cloud import Cloud
from scene.fitting.railsseen import SeenRails, find_rails

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
    """Sleepers of a bore.

    Attributes:
        station: m, `(k,)`.
        measured: Seen; the others stand where the spacing asks for one, `(k,)`.
        protrusion: Of their tops out of the bed, median, m.
    """

    station: Float[np.ndarray, " k"]
    measured: Bool[np.ndarray, " k"]
    protrusion: float


@dataclass(frozen=True)
class SeenTrack:
    """What of a track the cloud shows; `None` for what it does not."""

    sleepers: SeenSleepers | None
    rails: SeenRails | None


def find_track(cloud: Cloud, bore: Bore) -> SeenTrack:
    """Sleepers and rails on the floor of the bore.

    Args:
        cloud: Registered cloud in the bore's frame.
        bore: With a flat floor; a track on a round invert is not looked for.
    """
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
    owner = _nearest(centre, station[near])
    on_top = (np.abs(station[near] - centre[owner]) < 0.06) & (height[near] > _STEP)
    protrusion = float(np.median(height[near][on_top]))
    place, measured = _complete(_middles(centre, station[near], height[near], protrusion), spacing, length)
    return SeenSleepers(place, measured, protrusion)


def _nearest(centre: np.ndarray, station: np.ndarray) -> np.ndarray:
    right = np.clip(np.searchsorted(centre, station), 1, len(centre) - 1)
    return np.where(station - centre[right - 1] < centre[right] - station, right - 1, right)


def _middles(centre: np.ndarray, station: np.ndarray, height: np.ndarray, protrusion: float) -> np.ndarray:
    """Middle of each sleeper's top; its near face and the shadow behind it would pull a mean to one side."""
    owner = _nearest(centre, station)
    top = (np.abs(height - protrusion) < _TOP_LAYER) & (np.abs(station - centre[owner]) < _WIDTHS[1] / 2)
    order = np.lexsort((station[top], owner[top]))
    at, bounds = station[top][order], np.searchsorted(owner[top][order], np.arange(len(centre) + 1))
    moved = centre.copy()
    for k in range(len(centre)):
        seen = at[bounds[k] : bounds[k + 1]]
        if len(seen) >= _MIN_TOP:
            moved[k] = np.mean(np.percentile(seen, [5, 95]))
    return moved


def _complete(centre: np.ndarray, spacing: float, length: float) -> tuple[np.ndarray, np.ndarray]:
    """The seen sleepers, and one wherever the spacing asks for one that was not seen."""
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
