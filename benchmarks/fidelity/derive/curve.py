"""Coordinates along a curve: station, left and up of points, and back."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case, derived, of_truth

_FINE = 0.1  # m


@dataclass(frozen=True)
class Curve:
    """A centreline with upright frames: `left` is horizontal, `up` completes it.

    Attributes:
        station: Arc length, growing, m, `(n,)`.
        position: m, `(n, 3)`.
    """

    station: Float[np.ndarray, " n"]
    position: Float[np.ndarray, "n 3"]
    _fine: dict[str, Any] = field(default_factory=dict, compare=False, repr=False)

    @property
    def length(self) -> float:
        """Of the curve, m."""
        return float(self.station[-1] - self.station[0])

    def frames(self, station: Float[np.ndarray, " k"]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Position, tangent, left and up at stations, `(k, 3)` each; straight on beyond the ends."""
        spline = CubicSpline(self.station, self.position)
        inside = np.clip(station, self.station[0], self.station[-1])
        tangent = spline(inside, 1)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        left = np.cross([0.0, 0.0, 1.0], tangent)
        left /= np.linalg.norm(left, axis=1, keepdims=True)
        position = spline(inside) + (np.asarray(station) - inside)[:, None] * tangent
        return position, tangent, left, np.cross(tangent, left)

    def local(self, points: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
        """Station, left and up of points, m; beyond the ends the curve goes straight on."""
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
        share = np.clip(np.nan_to_num(along / _FINE), -0.5, 0.5)[:, None]
        ahead = np.clip(nearest + np.where(share[:, 0] >= 0, 1, -1), 0, len(fine["station"]) - 1)
        frame = {name: self._mixed(name, nearest, ahead, np.abs(share)) for name in ("left", "up")}
        inside = np.clip(station, fine["station"][0], fine["station"][-1])
        foot = np.stack([np.interp(inside, fine["station"], axis) for axis in fine["position"].T], axis=1)
        away = points - foot
        return np.column_stack([station, *(np.einsum("ij,ij->i", away, frame[name]) for name in ("left", "up"))])

    def _mixed(self, name: str, here: np.ndarray, there: np.ndarray, share: np.ndarray) -> np.ndarray:
        return (1.0 - share) * self._fine[name][here] + share * self._fine[name][there]

    def point(self, local: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
        """Points at station, left and up."""
        position, _, left, up = self.frames(local[:, 0])
        return position + local[:, 1:2] * left + local[:, 2:3] * up


@derived
def candidate_curve(case: Case) -> Curve:
    """The candidate's centreline."""
    return Curve(case.candidate.bore.station, case.candidate.bore.position)


@of_truth
def truth_curve(case: Case) -> Curve:
    """The true centreline."""
    assert case.truth is not None
    return Curve(case.truth.station, case.truth.position)
