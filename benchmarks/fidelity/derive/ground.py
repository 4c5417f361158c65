"""The ground that a small robot drives on: height, steps, headroom and where it fits, in cells along the axis.

A step of 10 cm stops the robot. Sleepers (6 cm above the ballast) do not, rails (18 cm above the sleepers) do: it
drives between the rails, and may drive beside them, but does not change over.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt

from benchmarks.fidelity.case import Case, derived, of_truth
from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.derive.freeplane import truth_caster
from benchmarks.fidelity.derive.radii import Radii, lining_radii, truth_radii
from benchmarks.fidelity.derive.reference_axis import lining_curve, reference_curve
from benchmarks.fidelity.derive.surface import Caster, intersector

CELL = 0.10  # m
HALF = 3.5  # m to either side
STEP = 0.10  # m; a higher one stops the robot
HEADROOM = 0.80  # m
MOUTH = 0.5  # m at either end that is left out: a track that ends a hand's breadth early is no way around a rail
_EYE = -0.5  # m above the axis: from here rays go up and down
_ACROSS = 5  # rays across a cell, of which the highest hit counts: a rail's head is narrower than a cell
_LEVELS = (0.3, 0.7)  # m above the ground at which the robot would run into something


@dataclass(frozen=True)
class Ground:
    """What lies under and over the robot.

    Attributes:
        station: Of the rows, m, `(n,)`.
        left: Of the columns, m, `(m,)`.
        height: Of the ground above the axis, m; NaN where none is seen, `(n, m)`.
        headroom: Above it, m, `(n, m)`.
        step: Largest difference of height to the four neighbours, m; NaN beside what is not seen, `(n, m)`.
    """

    station: Float[np.ndarray, " n"]
    left: Float[np.ndarray, " m"]
    height: Float[np.ndarray, "n m"]
    headroom: Float[np.ndarray, "n m"]
    step: Float[np.ndarray, "n m"]

    @property
    def cell(self) -> float:
        """Edge, m."""
        return float(self.left[1] - self.left[0])

    @property
    def traversable(self) -> Bool[np.ndarray, "n m"]:
        """Where neither a step nor the roof stops the robot."""
        with np.errstate(invalid="ignore"):
            return (self.step < STEP) & (self.headroom > HEADROOM)

    @property
    def clearance(self) -> Float[np.ndarray, "n m"]:
        """Distance to what is not traversable, m; the mouths are open."""
        free = self.traversable
        return distance_transform_edt(free, self.cell) if not free.all() else np.full(free.shape, HALF)


def frame(case: Case) -> Curve:
    """The reference axis, or the lining's own where there is no reference."""
    return lining_curve(case) if case.truth is None and case.hold is None else reference_curve(case)


def axes(curve: Curve, cell: float) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " m"]]:
    """Stations of the rows and offsets to the left of the columns, m."""
    station = curve.station[0] + MOUTH + cell * (np.arange(int((curve.length - 2 * MOUTH) / cell)) + 0.5)
    columns = int(HALF / cell)
    return station, cell * np.arange(-columns, columns + 1)


@derived
def judged_ground(case: Case) -> Ground:
    """The candidate's, by rays."""
    return _cast(frame(case), CELL * case.tolerance, intersector(case), lining_radii(case))


@of_truth
def true_ground(case: Case) -> Ground:
    """The truth's, by rays."""
    return _cast(frame(case), CELL * case.tolerance, truth_caster(case), truth_radii(case))


def _cast(curve: Curve, cell: float, caster: Caster, radii: Radii) -> Ground:
    station, left = axes(curve, cell)
    position, _, across, up = curve.frames(station)
    fine = (left[:, None] + cell * (np.arange(_ACROSS) - _ACROSS // 2) / _ACROSS).ravel()
    eye = (position[:, None] + fine[None, :, None] * across[:, None] + _EYE * up[:, None]).reshape(-1, 3)
    inside = radii.depth(eye) > 0
    upward = np.repeat(up, len(fine), axis=0)
    shape = (len(station), len(left), _ACROSS)
    height, roof = (_met(caster, eye, sign * upward, inside, sign).reshape(shape) for sign in (-1, 1))
    whole = inside.reshape(shape).all(axis=2)
    highest = np.where(whole, height.max(axis=2), np.nan)
    headroom = np.where(whole, roof.min(axis=2), np.nan) - highest
    return Ground(
        station,
        left,
        highest,
        headroom,
        np.where(_barred(caster, curve, station, left, highest), np.inf, steps(highest)),
    )


def _barred(
    caster: Caster,
    curve: Curve,
    station: Float[np.ndarray, " n"],
    left: Float[np.ndarray, " m"],
    height: Float[np.ndarray, "n m"],
) -> Bool[np.ndarray, "n m"]:
    """Cells from which something stands in the way to the next, along or across: a wall that rays down do not meet."""
    position, tangent, across, up = curve.frames(station)
    cell, known = left[1] - left[0], np.isfinite(height)
    barred = np.zeros(height.shape, bool)
    for above in _LEVELS:
        rise = (np.where(known, height, 0.0) + above)[..., None] * up[:, None]
        eye = (position[:, None] + left[:, None] * across[:, None] + rise)[known]
        for ahead in (tangent, -tangent):
            towards = np.broadcast_to(ahead[:, None], (*height.shape, 3))[known]
            barred[known] |= caster.first(eye, towards)[0] < cell
    return barred


def _met(
    caster: Caster,
    eye: Float[np.ndarray, "k 3"],
    direction: Float[np.ndarray, "k 3"],
    among: Bool[np.ndarray, " k"],
    sign: int,
) -> Float[np.ndarray, " k"]:
    """Height above the axis at which rays up or down end, m; NaN where they do not."""
    reach = np.full(len(eye), np.nan)
    reach[among] = caster.first(eye[among], direction[among])[0]
    return np.where(np.isfinite(reach), _EYE + sign * reach, np.nan)


def steps(height: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
    """Largest difference to the four neighbours, m; beyond the mouths the ground goes on."""
    padded = np.pad(height, ((1, 1), (0, 0)), mode="edge")
    padded = np.pad(padded, ((0, 0), (1, 1)), constant_values=np.nan)
    inner = padded[1:-1, 1:-1]
    shifted = (padded[2:, 1:-1], padded[:-2, 1:-1], padded[1:-1, 2:], padded[1:-1, :-2])
    return np.max([np.abs(inner - other) for other in shifted], axis=0)
