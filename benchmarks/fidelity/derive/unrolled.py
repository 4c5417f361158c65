"""The lining unrolled: how far it lies behind its smooth section, by chainage (5 cm) and direction (1 degree)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import convolve, map_coordinates

from benchmarks.fidelity.case import Case, derived, of_truth
from benchmarks.fidelity.derive import profiles
from benchmarks.fidelity.derive.beams import at, paired
from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.derive.radii import COLUMNS, ROW, Radii, seen_from, truth_radii
from benchmarks.fidelity.derive.reference_axis import hold_local, hold_points, lining_caster, reference_curve

_COARSE = 5  # rows between those that the smooth section is taken from
_LARGEST = 0.40  # m; what lies farther off the smooth section is no lining
_ABOVE_FLOOR = 0.30  # m; below is floor
_BLUR = np.ones((3, 3))


@dataclass(frozen=True)
class Unrolled:
    """A map of depths.

    Attributes:
        station: Of the rows, m, `(n,)`.
        angle: Of the columns, from left towards up, rad, `(m,)`.
        depth: Behind the smooth section along the ray from the axis, m; NaN where not known, `(n, m)`.
        smooth: Radius of the typical smooth section, m, `(m,)`.
        wall: Columns that are wall or roof, not floor, `(m,)`.
    """

    station: Float[np.ndarray, " n"]
    angle: Float[np.ndarray, " m"]
    depth: Float[np.ndarray, "n m"]
    smooth: Float[np.ndarray, " m"]
    wall: Bool[np.ndarray, " m"]

    @property
    def arc(self) -> Float[np.ndarray, " m"]:
        """Length along the section, from the middle of the floor, m, at each column."""
        return np.cumsum(self.pitch)

    @property
    def pitch(self) -> Float[np.ndarray, " m"]:
        """Length along the section that a column covers, m."""
        return self.smooth * 2 * np.pi / COLUMNS / self.slant

    @property
    def slant(self) -> Float[np.ndarray, " m"]:
        """Cosine between the ray and the normal of the section at each column, at least 0.3."""
        change = (np.roll(self.smooth, -2) - np.roll(self.smooth, 2)) / (8 * np.pi / COLUMNS)
        return np.maximum(self.smooth / np.hypot(self.smooth, change), 0.3)


def _unrolled(station: np.ndarray, radius: np.ndarray, smooth: np.ndarray) -> Unrolled:
    angle = profiles.directions(COLUMNS)
    depth = radius - smooth
    depth = np.where(np.abs(depth) < _LARGEST, depth, np.nan)
    typical = profiles.nanmedian(smooth.T)
    height = typical * np.sin(angle)
    wall = np.isfinite(typical) & (height > np.nanmin(height) + _ABOVE_FLOOR)
    return Unrolled(station, angle, depth, np.where(np.isfinite(typical), typical, np.nanmedian(typical)), wall)


def of_radii(radii: Radii) -> Unrolled:
    """A map from a table of radii; its smooth section is the running median over 1.5 m."""
    coarse = profiles.windowed(radii.radius[::_COARSE], _COARSE * ROW)
    return _unrolled(radii.station, radii.radius, _stretched(coarse, len(radii.station), _COARSE))


def _stretched(coarse: Float[np.ndarray, "c m"], rows: int, step: int, first: float = 0.0) -> Float[np.ndarray, "n m"]:
    place = np.clip((np.arange(rows) - first) / step, 0, len(coarse) - 1)
    below = np.minimum(place.astype(int), max(len(coarse) - 2, 0))
    share = (place - below)[:, None]
    return (1 - share) * coarse[below] + share * coarse[np.minimum(below + 1, len(coarse) - 1)]


@derived
def judged_map(case: Case) -> Unrolled:
    """The candidate's lining, from the reference axis."""
    return of_radii(seen_from(reference_curve(case), lining_caster(case)))


@of_truth
def truth_map(case: Case) -> Unrolled:
    """The true lining, from the same axis."""
    return of_radii(truth_radii(case))


@derived
def hold_map(case: Case) -> Unrolled:
    """The held-out recording's, from the same axis, each return put into its cell; the mean of each."""
    assert case.hold is not None
    curve = reference_curve(case)
    key = ("unrolled.hold_map", case.truth is None)
    if key not in case.hold.cache:
        local = hold_local(case) if case.truth is None else curve.local(hold_points(case))
        case.hold.cache[key] = of_points(curve, local)
    return case.hold.cache[key]


def of_points(curve: Curve, local: Float[np.ndarray, "k 3"]) -> Unrolled:
    """A map from points given as station, left and up."""
    rows = max(int(curve.length / ROW), 2)
    step = curve.length / rows
    row = (local[:, 0] - curve.station[0]) / step
    angle = (np.arctan2(local[:, 2], local[:, 1]) + np.pi) / (2 * np.pi) * COLUMNS
    kept = (row >= 0) & (row < rows)
    row, angle, radius = row[kept], angle[kept], np.hypot(local[kept, 1], local[kept, 2])
    column = np.minimum(angle.astype(int), COLUMNS - 1)
    coarse_rows = -(-rows // _COARSE)
    group = (row / _COARSE).astype(int) * COLUMNS + column
    coarse = profiles.grouped_median(group, radius, coarse_rows * COLUMNS).reshape(coarse_rows, COLUMNS)
    coarse = profiles.windowed(coarse, _COARSE * ROW)
    smooth = _stretched(coarse, rows, _COARSE, (_COARSE - 1) / 2)
    # Between columns the section slants: a return is compared with the section at its own angle.
    padded = np.concatenate([smooth[:, -1:], smooth, smooth[:, :1]], axis=1)
    expected = map_coordinates(padded, [np.minimum(row, rows - 1), angle + 0.5], order=1, mode="nearest")
    depth = radius - expected
    good = np.isfinite(depth) & (np.abs(depth) < _LARGEST)
    cell = row.astype(int)[good] * COLUMNS + column[good]
    count = np.bincount(cell, minlength=rows * COLUMNS)
    total = np.bincount(cell, depth[good], rows * COLUMNS)
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(rows, COLUMNS)
    return _unrolled(curve.station[0] + (np.arange(rows) + 0.5) * step, smooth + mean, smooth)


@derived
def observed_map(case: Case) -> Unrolled:
    """The candidate's as the held-out beams would have shown it: the same beams, so the same gaps and shadows."""
    points = at(case, paired(case).range)
    return of_points(reference_curve(case), reference_curve(case).local(points[np.isfinite(points).all(axis=1)]))


def both_maps(case: Case) -> tuple[Unrolled, Unrolled]:
    """Candidate and truth, each whole; without a truth candidate and recording by the same held-out beams."""
    return (judged_map(case), truth_map(case)) if case.truth is not None else (observed_map(case), hold_map(case))


def blurred(depth: Float[np.ndarray, "n m"], known: Bool[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
    """Mean over the known cells among nine, m; NaN where there is none."""
    usable = known & np.isfinite(depth)
    weight = convolve(usable.astype(float), _BLUR, mode="constant")
    total = convolve(np.where(usable, depth, 0.0), _BLUR, mode="constant")
    return np.where(weight > 0, total / np.maximum(weight, 1.0), np.nan)


def common_rows(first: Unrolled, second: Unrolled) -> int:
    """Rows of two maps of one axis that are compared."""
    return min(len(first.station), len(second.station))


@derived
def correlated(case: Case) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Stations, and depths of candidate and held-out recording in the cells that beams show of both, m.

    Both are averaged over the same cells of three by three, so that range noise of single returns does not decide.
    """
    judged, hold = observed_map(case), hold_map(case)
    rows = common_rows(judged, hold)
    known = np.isfinite(hold.depth[:rows]) & np.isfinite(judged.depth[:rows]) & hold.wall & judged.wall
    both = [blurred(side.depth[:rows], known)[known] for side in (judged, hold)]
    return np.repeat(hold.station[:rows], known.sum(axis=1)), both[0], both[1]
