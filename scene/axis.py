"""A curve with arc length and frames, and points expressed in them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

_VERTICAL = np.array([0.0, 0.0, 1.0])
_BEND_OVER = 10.0  # m


@dataclass(frozen=True)
class Axis:
    """A centreline sampled at uniform stations.

    Attributes:
        station: Arc length, m, `(n,)`.
        position: m, `(n, 3)`.
        tangent: Unit vectors of growing station, `(n, 3)`.
        lateral: Unit vectors, horizontal, to the left, `(n, 3)`.
        up: Unit vectors, `tangent × lateral`, `(n, 3)`.
    """

    station: Float[np.ndarray, " n"]
    position: Float[np.ndarray, "n 3"]
    tangent: Float[np.ndarray, "n 3"]
    lateral: Float[np.ndarray, "n 3"]
    up: Float[np.ndarray, "n 3"]

    @property
    def length(self) -> float:
        """From the first to the last station, m."""
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
        """The axis at other stations; beyond its ends it runs on straight."""
        inside = np.clip(station, self.station[0], self.station[-1])
        spline = CubicSpline(self.station, self.position)
        position, tangent = spline(inside), spline(inside, 1)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        return with_frames(station, position + (station - inside)[:, None] * tangent, tangent)

    def reversed(self) -> "Axis":
        """The same curve run from the other end, stations from 0."""
        station = self.station[-1] - self.station[::-1]
        return with_frames(station, self.position[::-1], -self.tangent[::-1])

    def local(self, points: Float[np.ndarray, "p 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Station, lateral and upward offset of each point from the nearest sample of the axis, m, `(p,)` each."""
        nearest = cKDTree(self.position).query(points, workers=-1)[1]
        offset = points - self.position[nearest]

        def along(directions: np.ndarray) -> np.ndarray:
            return np.einsum("ij,ij->i", offset, directions[nearest])

        return self.station[nearest] + along(self.tangent), along(self.lateral), along(self.up)


def with_frames(station: np.ndarray, position: np.ndarray, tangent: np.ndarray) -> Axis:
    """An axis with its lateral and up vectors; a tangent must not be vertical."""
    lateral = np.cross(_VERTICAL, tangent)
    lateral /= np.linalg.norm(lateral, axis=1, keepdims=True)
    return Axis(station, position, tangent, lateral, np.cross(tangent, lateral))


def through(points: Float[np.ndarray, "n 3"], spacing: float) -> Axis:
    """The cubic spline through the points, resampled by arc length from 0, every `spacing` m or slightly less.

    Args:
        points: In order, no two alike, m.
        spacing: Largest distance of two stations, m.
    """
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    spline = CubicSpline(chord, points)
    fine = np.linspace(0.0, chord[-1], 20 * len(points))
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(spline(fine), axis=0), axis=1))])
    station = np.linspace(0.0, arc[-1], int(np.ceil(arc[-1] / spacing - 1e-9)) + 1)
    at = np.interp(station, arc, fine)
    tangent = spline(at, 1)
    return with_frames(station, spline(at), tangent / np.linalg.norm(tangent, axis=1, keepdims=True))
