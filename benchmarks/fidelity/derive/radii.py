"""Polar radii of a bore, pockets and all: every 5 cm along its axis, every degree around it; what lies inside."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt

from benchmarks.fidelity.case import Case, derived, of_truth
from benchmarks.fidelity.derive import profiles
from benchmarks.fidelity.derive.curve import Curve, truth_curve
from benchmarks.fidelity.derive.reference_axis import lining_caster, lining_curve
from benchmarks.fidelity.derive.sections import truth_shell
from benchmarks.fidelity.derive.surface import Caster

ROW = 0.05  # m
COLUMNS = 360


@dataclass(frozen=True)
class Radii:
    """A bore seen from its axis.

    Attributes:
        curve: The axis.
        station: Of the rows, m, `(n,)`.
        radius: To the first surface, m; NaN where there is none, `(n, 360)`.
        filled: The same with holes closed by their nearest neighbour, `(n, 360)`.
    """

    curve: Curve
    station: Float[np.ndarray, " n"]
    radius: Float[np.ndarray, "n m"]
    filled: Float[np.ndarray, "n m"]

    def depth(self, points: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, " k"]:
        """How far inside the bore points lie, along the ray from the axis, m; negative outside or past its mouths."""
        return self.depth_local(self.curve.local(points))

    def depth_local(self, local: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, " k"]:
        """The same of points given as station, left and up about `curve`."""
        row = np.clip(np.round((local[:, 0] - self.station[0]) / ROW).astype(int), 0, len(self.station) - 1)
        angle = (np.arctan2(local[:, 2], local[:, 1]) + np.pi) / (2 * np.pi) * COLUMNS
        column = np.minimum(angle.astype(int), COLUMNS - 1)
        inside = self.filled[row, column] - np.hypot(local[:, 1], local[:, 2])
        low, high = self.station[0] - ROW, self.station[-1] + ROW
        beyond = np.maximum(low - local[:, 0], local[:, 0] - high)
        return np.where(beyond > 0, -np.maximum(beyond, 1e-9), inside)


def seen_from(curve: Curve, caster: Caster) -> Radii:
    """Rays from a curve.

    Raises:
        ValueError: Less than half of them meet anything.
    """
    count = max(int(curve.length / ROW), 2)
    station = curve.station[0] + (np.arange(count) + 0.5) * curve.length / count
    radius = profiles.cast(caster, curve, station, profiles.directions(COLUMNS))
    if np.isfinite(radius).mean() < 0.5:
        raise ValueError("most rays from the axis leave the bore")
    return Radii(curve, station, radius, _closed(radius))


def _closed(radius: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
    known = np.isfinite(radius)
    if known.all():
        return radius
    margin = COLUMNS // 8
    around = np.concatenate([radius[:, -margin:], radius, radius[:, :margin]], axis=1)
    nearest = distance_transform_edt(~np.isfinite(around), return_distances=False, return_indices=True)
    return around[tuple(nearest)][:, margin:-margin]


@derived
def lining_radii(case: Case) -> Radii:
    """The candidate's lining from its own axis."""
    return seen_from(lining_curve(case), lining_caster(case))


@of_truth
def truth_radii(case: Case) -> Radii:
    """The true bore, pockets with it and track without, from the true axis."""
    return seen_from(truth_curve(case), truth_shell(case))
