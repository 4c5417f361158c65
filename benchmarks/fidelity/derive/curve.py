"""Coordinates along a curve, and polar profiles about it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case, per_case, per_truth
from benchmarks.fidelity.derive.surface import Caster

_FINE = 0.1  # m
_AT_ONCE = 300_000  # points


@dataclass(frozen=True, eq=False)
class Curve:
    """Centreline with upright frames: `left` is horizontal, `up` completes it."""

    station: Float[np.ndarray, " n"]  # Arc length, growing, m
    position: Float[np.ndarray, "n 3"]  # Points of the curve, m
    _fine: dict[str, Any] = field(default_factory=dict, compare=False, repr=False)

    @classmethod
    def through(cls, position: Float[np.ndarray, "n 3"]) -> "Curve":
        """Return the curve through points; stations are sums of chords from 0."""
        steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
        return cls(np.concatenate([[0.0], np.cumsum(steps)]), position)

    @property
    def length(self) -> float:
        """Length of the curve, m."""
        return float(self.station[-1] - self.station[0])

    def frames(self, station: Float[np.ndarray, " k"]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return position, tangent, left and up at stations, `(k, 3)` each; straight on beyond the ends."""
        spline = CubicSpline(self.station, self.position)
        inside = np.clip(station, self.station[0], self.station[-1])
        tangent = spline(inside, 1)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        left = np.cross([0.0, 0.0, 1.0], tangent)
        left /= np.linalg.norm(left, axis=1, keepdims=True)
        position = spline(inside) + (np.asarray(station) - inside)[:, None] * tangent
        return position, tangent, left, np.cross(tangent, left)

    def local(self, points: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
        """Return station, left and up of points, m; beyond the ends the curve goes straight on."""
        return by_parts(self._local, points)

    def _local(self, points: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
        if not self._fine:
            count = max(int(self.length / _FINE), 2) + 1
            station = np.linspace(self.station[0], self.station[-1], count)
            names = ("position", "tangent", "left", "up")
            self._fine.update(zip(names, self.frames(station), strict=True), station=station)
            self._fine["tree"] = cKDTree(self._fine["position"])
        fine = self._fine
        nearest = fine["tree"].query(points)[1]
        offset = points - fine["position"][nearest]
        along = np.einsum("ij,ij->i", offset, fine["tangent"][nearest])
        station = fine["station"][nearest] + along
        # One more step: the frame turns on the way from the nearest node to the foot of the perpendicular.
        fraction = np.clip(np.nan_to_num(along / _FINE), -0.5, 0.5)[:, None]
        ahead = np.clip(nearest + np.where(fraction[:, 0] >= 0, 1, -1), 0, len(fine["station"]) - 1)
        fraction = np.abs(fraction)
        frame = {name: (1.0 - fraction) * fine[name][nearest] + fraction * fine[name][ahead] for name in ("left", "up")}
        inside = np.clip(station, fine["station"][0], fine["station"][-1])
        foot = interpolate_rows(inside, fine["station"], fine["position"])
        away = points - foot
        return np.column_stack([station, *(np.einsum("ij,ij->i", away, frame[name]) for name in ("left", "up"))])

    def point(self, local: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
        """Return the points at station, left and up, m."""
        position, _, left, up = self.frames(local[:, 0])
        return position + local[:, 1:2] * left + local[:, 2:3] * up


def by_parts(function: Callable[[np.ndarray], np.ndarray], points: Float[np.ndarray, "k 3"]) -> np.ndarray:
    """Return a function's rows for so many points at a time that what it needs on its way stays below 100 MB."""
    starts = range(0, max(len(points), 1), _AT_ONCE)
    return np.concatenate([function(points[start : start + _AT_ONCE]) for start in starts])


def interpolate_rows(
    at: Float[np.ndarray, " k"], station: Float[np.ndarray, " n"], rows: Float[np.ndarray, "n c"]
) -> Float[np.ndarray, "k c"]:
    """Return rows between those known at stations; the first and the last beyond the ends."""
    return np.stack([np.interp(at, station, column) for column in rows.T], axis=1)


@per_case
def candidate_curve(case: Case) -> Curve:
    return Curve(case.candidate.bore.station, case.candidate.bore.position)


@per_truth
def truth_curve(case: Case) -> Curve:
    assert case.truth is not None
    return Curve(case.truth.station, case.truth.position)


# Polar profiles about a curve: rays into a mesh, medians of points, the middle of a section.

ROW_STEP = 0.25  # m between the rows that medians are taken over
MEDIAN_WINDOW = 1.5  # m of chainage: pockets take less than half of it along any one direction
SECTOR = np.deg2rad(5.0)
LEAST_POINTS = 20  # points; a sector with fewer is unknown
SLICE = 0.5  # m
TRACK_HALF = 1.4  # m to either side of the axis where sleepers and rails may stand
_SIDE_ANGLE = np.deg2rad(25.0)
_CROWN_ANGLE = np.deg2rad(5.0)
_FLOOR_ANGLE = np.deg2rad(36.0)


def section_angles(count: int) -> Float[np.ndarray, " m"]:
    """Return angles from left towards up, rad; none of them is exactly horizontal or vertical."""
    return (np.arange(count) + 0.5) * 2 * np.pi / count - np.pi


def cast_profile(
    caster: Caster,
    curve: Curve,
    station: Float[np.ndarray, " n"],
    angle: Float[np.ndarray, " m"],
    middle: tuple[float, float] = (0.0, 0.0),
) -> Float[np.ndarray, "n m"]:
    """Return the distance from the curve to the first surface in its normal plane, m; NaN where there is none.

    Rays start `middle` (left, up) beside the curve, m.
    """
    position, _, left, up = curve.frames(station)
    direction = np.cos(angle)[:, None] * left[:, None] + np.sin(angle)[:, None] * up[:, None]
    origin = np.repeat(position + middle[0] * left + middle[1] * up, len(angle), axis=0)
    reach, _ = caster.first(origin, direction.reshape(-1, 3))
    return np.where(np.isfinite(reach), reach, np.nan).reshape(len(station), len(angle))


def running_median(
    profile: Float[np.ndarray, "n m"], step: float, window: float = MEDIAN_WINDOW
) -> Float[np.ndarray, "n m"]:
    """Return the running median along the tunnel, by direction; unknown values do not count."""
    half = max(round(window / step / 2), 1)
    padded = np.pad(profile, ((half, half), (0, 0)), constant_values=np.nan)
    stacked = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=0)
    return nanmedian(stacked)


def nanmedian(values: Float[np.ndarray, "*shape k"]) -> Float[np.ndarray, "*shape"]:
    """Return the median over the last axis; NaN, without a warning, where nothing is known."""
    ordered = np.sort(values, axis=-1)  # NaN last
    known = np.isfinite(values).sum(axis=-1)
    low = np.maximum((known - 1) // 2, 0)[..., None]
    high = np.minimum(known // 2, values.shape[-1] - 1)[..., None]
    pair = np.take_along_axis(ordered, low, -1) + np.take_along_axis(ordered, high, -1)
    return np.where(known > 0, pair[..., 0] / 2, np.nan)


def point_profile(
    local: Float[np.ndarray, "k 3"], station: Float[np.ndarray, " n"], floor: float | None
) -> Float[np.ndarray, "n m"]:
    """Return the median polar radius of points by 5 degree sector and 0.5 m slice, m.

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
    profile = grouped_median(cell, radius, len(station) * count, LEAST_POINTS).reshape(len(station), count)
    if floor is not None:  # sectors that look, with any part, where sleepers and rails may stand on it
        off_nadir = np.abs(_wrap(section_angles(count) + np.pi / 2))
        profile[:, off_nadir - SECTOR / 2 < np.arctan2(TRACK_HALF, abs(floor))] = np.nan
    return profile


def grouped_median(
    group: np.ndarray, values: Float[np.ndarray, " k"], count: int, least: int = 1, fraction: float = 0.5
) -> Float[np.ndarray, " count"]:
    """Return the median of each group, or another quantile; NaN for a group of fewer than `least` members."""
    order = np.lexsort((values, group))
    size = np.bincount(group, minlength=count)
    start = np.cumsum(size) - size
    known = size >= max(least, 1)
    place = fraction * (size[known] - 1)
    ordered = values[order]
    result = np.full(count, np.nan)
    low, high = start[known] + np.floor(place).astype(int), start[known] + np.ceil(place).astype(int)
    result[known] = (ordered[low] + ordered[high]) / 2
    return result


def section_middle(profile: Float[np.ndarray, "n m"], angle: Float[np.ndarray, " m"]) -> Float[np.ndarray, "n 2"]:
    """Return the middle of width and height about the curve, left and up, m.

    The left offset is the median over mirrored directions of half the difference of the distances to the two walls,
    the height's middle that of the crown above the axis and of the flat middle of the floor.
    """
    mirror = (np.pi - angle + np.pi) % (2 * np.pi) - np.pi
    opposite = np.argmin(np.abs(_wrap(angle[None] - mirror[:, None])), axis=1)
    side = np.flatnonzero(np.abs(angle) < _SIDE_ANGLE)
    left = nanmedian((profile[:, side] - profile[:, opposite[side]]) / 2 * np.cos(angle[side]))
    crown, floor = crown_and_floor(profile, angle)
    return np.column_stack([left, (crown + floor) / 2])


def crown_and_floor(
    profile: Float[np.ndarray, "n m"], angle: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the heights of crown and floor above the curve, m."""
    height = profile * np.sin(angle)
    crown = nanmedian(height[:, np.abs(_wrap(angle - np.pi / 2)) < _CROWN_ANGLE])
    return crown, nanmedian(height[:, np.abs(_wrap(angle + np.pi / 2)) < _FLOOR_ANGLE])


def smooth_along(values: Float[np.ndarray, "n k"], step: float, window: float) -> Float[np.ndarray, "n k"]:
    """Fits straight lines in a Gaussian window along the first axis; gaps are bridged, ends are not bent."""
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


def _wrap(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi
