"""Polar profiles about a curve: rays into a mesh, medians of real points, and the middle of a section."""

import numpy as np
from jaxtyping import Bool, Float

from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.derive.surface import Caster

STEP = 0.25  # m between the rows that medians are taken over
WINDOW = 1.5  # m of chainage: pockets take less than half of it along any one direction
SECTOR = np.deg2rad(5.0)
LEAST = 20  # points; a sector with fewer is unknown
SLICE = 0.5  # m
TRACK_HALF = 1.4  # m to either side of the axis where sleepers and rails may stand
_SIDE = np.deg2rad(25.0)
_CROWN = np.deg2rad(5.0)
_FLOOR = np.deg2rad(36.0)


def directions(count: int) -> Float[np.ndarray, " m"]:
    """Angles from left towards up, rad; none of them exactly horizontal or vertical."""
    return (np.arange(count) + 0.5) * 2 * np.pi / count - np.pi


def cast(
    caster: Caster, curve: Curve, station: Float[np.ndarray, " n"], angle: Float[np.ndarray, " m"]
) -> Float[np.ndarray, "n m"]:
    """Distance from the curve to the first surface in its normal plane, m; NaN where there is none."""
    position, _, left, up = curve.frames(station)
    direction = np.cos(angle)[:, None] * left[:, None] + np.sin(angle)[:, None] * up[:, None]
    origin = np.repeat(position, len(angle), axis=0)
    reach, _ = caster.first(origin, direction.reshape(-1, 3))
    return np.where(np.isfinite(reach), reach, np.nan).reshape(len(station), len(angle))


def windowed(profile: Float[np.ndarray, "n m"], step: float, window: float = WINDOW) -> Float[np.ndarray, "n m"]:
    """Running median along the tunnel, by direction; what is unknown does not count."""
    half = max(round(window / step / 2), 1)
    padded = np.pad(profile, ((half, half), (0, 0)), constant_values=np.nan)
    stacked = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=0)
    return nanmedian(stacked)


def nanmedian(values: Float[np.ndarray, "*shape k"]) -> Float[np.ndarray, "*shape"]:
    """Median over the last axis; NaN, without a warning, where nothing is known."""
    ordered = np.sort(values, axis=-1)  # NaN last
    known = np.isfinite(values).sum(axis=-1)
    low = np.maximum((known - 1) // 2, 0)[..., None]
    high = np.minimum(known // 2, values.shape[-1] - 1)[..., None]
    pair = np.take_along_axis(ordered, low, -1) + np.take_along_axis(ordered, high, -1)
    return np.where(known > 0, pair[..., 0] / 2, np.nan)


def of_points(
    local: Float[np.ndarray, "k 3"], station: Float[np.ndarray, " n"], floor: float | None
) -> Float[np.ndarray, "n m"]:
    """Median polar radius of real points by 5 degree sector and 0.5 m slice, m.

    Args:
        local: Station, left, up.
        station: Middles of the slices, `SLICE` apart.
        floor: Height of the floor about the curve: what stands on it as a track may is left out; `None` keeps all.
    """
    count = round(2 * np.pi / SECTOR)
    row = np.round((local[:, 0] - station[0]) / SLICE).astype(int)
    column = np.minimum(((np.arctan2(local[:, 2], local[:, 1]) + np.pi) / SECTOR).astype(int), count - 1)
    inside = (row >= 0) & (row < len(station))
    cell, radius = (row * count + column)[inside], np.hypot(local[inside, 1], local[inside, 2])
    profile = grouped_median(cell, radius, len(station) * count, LEAST).reshape(len(station), count)
    if floor is not None:
        profile[:, towards_track(directions(count), floor)] = np.nan
    return profile


def towards_track(angle: Float[np.ndarray, " m"], floor: float) -> Bool[np.ndarray, " m"]:
    """Which sectors look, with any part of theirs, where sleepers and rails may stand on the floor."""
    off_nadir = np.abs(_wrapped(angle + np.pi / 2))
    return off_nadir - SECTOR / 2 < np.arctan2(TRACK_HALF, abs(floor))


def grouped_median(
    group: np.ndarray, values: Float[np.ndarray, " k"], count: int, least: int = 1, share: float = 0.5
) -> Float[np.ndarray, " count"]:
    """Median of each group, or what another `share` lies below; NaN for one with fewer than `least` members."""
    order = np.lexsort((values, group))
    size = np.bincount(group, minlength=count)
    start = np.cumsum(size) - size
    known = size >= max(least, 1)
    place = share * (size[known] - 1)
    ordered = values[order]
    result = np.full(count, np.nan)
    low, high = start[known] + np.floor(place).astype(int), start[known] + np.ceil(place).astype(int)
    result[known] = (ordered[low] + ordered[high]) / 2
    return result


def middle(profile: Float[np.ndarray, "n m"], angle: Float[np.ndarray, " m"]) -> Float[np.ndarray, "n 2"]:
    """Middle of width and height about the curve, left and up, m.

    The left offset is the median over mirrored directions of half the difference of the distances to the two walls,
    the height's middle that of the crown above the axis and of the flat middle of the floor.
    """
    mirror = (np.pi - angle + np.pi) % (2 * np.pi) - np.pi
    opposite = np.argmin(np.abs(_wrapped(angle[None] - mirror[:, None])), axis=1)
    side = np.flatnonzero(np.abs(angle) < _SIDE)
    left = nanmedian((profile[:, side] - profile[:, opposite[side]]) / 2 * np.cos(angle[side]))
    crown, floor = crown_and_floor(profile, angle)
    return np.column_stack([left, (crown + floor) / 2])


def crown_and_floor(
    profile: Float[np.ndarray, "n m"], angle: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Heights of crown and floor above the curve, m."""
    height = profile * np.sin(angle)
    crown = nanmedian(height[:, np.abs(_wrapped(angle - np.pi / 2)) < _CROWN])
    return crown, nanmedian(height[:, np.abs(_wrapped(angle + np.pi / 2)) < _FLOOR])


def smoothed(values: Float[np.ndarray, "n k"], step: float, window: float) -> Float[np.ndarray, "n k"]:
    """Local straight-line fit in a Gaussian window along the first axis; gaps are bridged, ends are not bent."""
    n = len(values)
    place = np.arange(n) * step
    weight = np.exp(-0.5 * ((place[:, None] - place) / (window / 2)) ** 2)
    result = np.empty_like(values)
    for column in range(values.shape[1]):
        known = np.isfinite(values[:, column])
        w = weight[:, known]
        x = place[known][None] - place[:, None]
        y = values[known, column]
        s0, s1, s2 = w.sum(1), (w * x).sum(1), (w * x * x).sum(1)
        t0, t1 = w @ y, (w * x) @ y
        result[:, column] = (s2 * t0 - s1 * t1) / (s0 * s2 - s1**2)
    return result


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi
