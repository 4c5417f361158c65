"""Curves and sections: a centreline by arc length, and a section as a polygon in polar form about it."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

_VERTICAL = np.array([0.0, 0.0, 1.0])
_BEND_OVER = 10.0  # m


class Around(NamedTuple):
    """Points about an axis."""

    station: Float[np.ndarray, " n"]  # m
    lateral: Float[np.ndarray, " n"]  # To the left of the axis, m
    upward: Float[np.ndarray, " n"]  # Above the axis, m

    @property
    def angle(self) -> Float[np.ndarray, " n"]:
        """Direction from the axis, rad."""
        return np.arctan2(self.upward, self.lateral)

    @property
    def radius(self) -> Float[np.ndarray, " n"]:
        """Distance from the axis, m."""
        return np.hypot(self.lateral, self.upward)


@dataclass(frozen=True)
class Axis:
    """A centreline sampled at uniform stations."""

    station: Float[np.ndarray, " n"]  # Arc length, m
    position: Float[np.ndarray, "n 3"]  # m
    tangent: Float[np.ndarray, "n 3"]  # Unit vectors of growing station
    lateral: Float[np.ndarray, "n 3"]  # Unit vectors, horizontal, to the left
    up: Float[np.ndarray, "n 3"]  # Unit vectors, `tangent × lateral`

    @property
    def length(self) -> float:
        """Length from the first to the last station, m."""
        return float(self.station[-1] - self.station[0])

    @property
    def curvature(self) -> Float[np.ndarray, " n"]:
        """Turn of the heading for each metre in plan, 1/m, positive to the left; the reciprocal of the plan radius.

        Taken over 10 m, or what of them the axis has, so that it is the track's bend and not the fit's noise.
        """
        heading = np.unwrap(np.arctan2(self.tangent[:, 1], self.tangent[:, 0]))
        run = np.hypot(self.tangent[:, 0], self.tangent[:, 1])
        plan = np.concatenate([[0.0], np.cumsum((run[1:] + run[:-1]) / 2 * np.diff(self.station))])
        ends = [np.clip(plan + side * _BEND_OVER / 2, plan[0], plan[-1]) for side in (-1, 1)]
        before, after = (np.interp(end, plan, heading) for end in ends)
        return (after - before) / np.maximum(ends[1] - ends[0], 1e-9)

    @property
    def grade(self) -> Float[np.ndarray, " n"]:
        """Rise for each metre in plan."""
        return self.tangent[:, 2] / np.hypot(self.tangent[:, 0], self.tangent[:, 1])

    def at(self, station: Float[np.ndarray, " k"]) -> "Axis":
        """Return the axis at other stations; beyond its ends it runs on straight."""
        inside = np.clip(station, self.station[0], self.station[-1])
        spline = CubicSpline(self.station, self.position)
        position, tangent = spline(inside), spline(inside, 1)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        return make_axis(station, position + (station - inside)[:, None] * tangent, tangent)

    def reversed(self) -> "Axis":
        """Return the same curve run from the other end, stations from 0."""
        station = self.station[-1] - self.station[::-1]
        return make_axis(station, self.position[::-1], -self.tangent[::-1])

    def in_plan(self) -> "Axis":
        """Return the axis laid flat at z = 0, at its own stations."""
        tangent = self.tangent * [1.0, 1.0, 0.0]
        flat = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
        return make_axis(self.station, self.position * [1.0, 1.0, 0.0], flat)

    def local(self, points: Float[np.ndarray, "p 3"]) -> Around:
        """Return points about the nearest samples of the axis."""
        nearest = cKDTree(self.position).query(points, workers=-1)[1]
        offset = points - self.position[nearest]

        def along(directions: np.ndarray) -> np.ndarray:
            return np.einsum("ij,ij->i", offset, directions[nearest])

        return Around(self.station[nearest] + along(self.tangent), along(self.lateral), along(self.up))


def make_axis(station: np.ndarray, position: np.ndarray, tangent: np.ndarray) -> Axis:
    """Return an axis with its lateral and up vectors; a tangent must not be vertical."""
    lateral = np.cross(_VERTICAL, tangent)
    lateral /= np.linalg.norm(lateral, axis=1, keepdims=True)
    return Axis(station, position, tangent, lateral, np.cross(tangent, lateral))


def arc_length(points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
    """Return the length of the polygon through points up to each of them, m."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def axis_through(points: Float[np.ndarray, "n 3"], spacing: float) -> Axis:
    """Return the cubic spline through points in order, no two alike, m, resampled by arc length from 0.

    Stations are `spacing` m apart, or slightly less.
    """
    chord = arc_length(points)
    spline = CubicSpline(chord, points)
    fine = np.linspace(0.0, chord[-1], 20 * len(points))
    arc = arc_length(spline(fine))
    station = np.linspace(0.0, arc[-1], int(np.ceil(arc[-1] / spacing - 1e-9)) + 1)
    at = np.interp(station, arc, fine)
    tangent = spline(at, 1)
    return make_axis(station, spline(at), tangent / np.linalg.norm(tangent, axis=1, keepdims=True))


N_ANGLES = 360
_HEIGHT_STEP = 0.05
_CHORD_WINDOW = 0.4
# Chords this close to the longest share in the middle, so that noise on one of them does not move it.
_LONG_CHORD = 0.97


@dataclass(frozen=True)
class Extents:
    """Sizes of a section, about the point it is drawn from."""

    width: float  # Largest inner width, m
    height: float  # Floor to crown on the axis, m
    middle: tuple[float, float]  # Lateral and upward offset of mid-width and mid-height, m


def section_angles(count: int = N_ANGLES) -> Float[np.ndarray, " m"]:
    """Return directions of a section's radii, from lateral (left) towards up, rad, the first at -π."""
    return -np.pi + 2 * np.pi * np.arange(count) / count


def measure_section(angle: Float[np.ndarray, " m"], radius: Float[np.ndarray, " m"]) -> Extents:
    """Measures the polygon `radius(angle)`."""
    lateral, upward = radius * np.cos(angle), radius * np.sin(angle)
    height_grid = np.arange(upward.min(), upward.max(), _HEIGHT_STEP)
    left, right = (wall_at(side, lateral, upward, height_grid) for side in (1, -1))
    chord = left - right
    # A maximum of noisy values is too large, so chords are averaged over 0.4 m of height; a circle loses 4 mm.
    window = min(round(_CHORD_WINDOW / _HEIGHT_STEP), len(chord))
    width = float(np.convolve(chord, np.full(window, 1 / window), mode="valid").max())
    long = chord >= _LONG_CHORD * width
    across = float(np.mean((left + right)[long]) / 2)
    floor, crown = (wall_at(side, upward, lateral, np.array([across]))[0] for side in (-1, 1))
    return Extents(width, float(crown - floor), (across, float(crown + floor) / 2))


def wall_at(side: int, across: np.ndarray, along: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return `across` of a polygon's half on one side (1 or -1) where `along` is `at`, m."""
    half = np.sign(across) == side
    order = np.argsort(along[half], kind="stable")
    return np.interp(at, along[half][order], across[half][order])


def find_runs(held: Bool[np.ndarray, " n"]) -> Int[np.ndarray, "k 2"]:
    """Return the first row of each run of rows that hold, and the one after its last."""
    return np.flatnonzero(np.diff(np.concatenate([[0], held.astype(int), [0]]))).reshape(-1, 2)


def bin_angles(count: int) -> Float[np.ndarray, " m"]:
    """Return the middles of equal bins of directions, from -π on, rad."""
    return -np.pi + 2 * np.pi * (np.arange(count) + 0.5) / count


def angle_bins(angle: Float[np.ndarray, " n"], count: int) -> Int[np.ndarray, " n"]:
    """Return the bin of each direction, rad; see `bin_angles`."""
    return np.floor((angle + np.pi) / (2 * np.pi) * count).astype(np.intp) % count


def bin_medians(bins: Int[np.ndarray, " n"], value: Float[np.ndarray, " n"], count: int) -> Float[np.ndarray, " m"]:
    """Return the upper median of the values in each of `count` bins; NaN where there is none."""
    order = np.lexsort((value, bins))
    bounds = np.searchsorted(bins[order], np.arange(count + 1))
    held = np.diff(bounds)
    result = np.full(count, np.nan)
    result[held > 0] = value[order][(bounds[:-1] + held // 2)[held > 0]]
    return result
