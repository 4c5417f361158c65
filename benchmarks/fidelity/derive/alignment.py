"""The lining's axis beside the reference's, and how far features drift along it."""

from dataclasses import dataclass

import numpy as np
import small_gicp
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation
from scipy.stats import theilslopes

from benchmarks.fidelity.case import Case, derived
from benchmarks.fidelity.derive.reference_axis import hold_points, lining_curve, reference_curve
from benchmarks.fidelity.derive.surface import lattice, surface

STEP = 1.0  # m
_SPACING = 0.15  # m between the points that are registered
_REACH = 0.5  # m; correspondences farther apart are none


@dataclass(frozen=True)
class Pair:
    """Two axes at the same reference stations.

    Attributes:
        station: On the reference axis, every metre, `(n,)`.
        left, up: Offset of the lining's axis, m, `(n,)`.
        judged: Points of the lining's axis, m, `(n, 3)`.
        reference: Points of the reference axis, m, `(n, 3)`.
    """

    station: Float[np.ndarray, " n"]
    left: Float[np.ndarray, " n"]
    up: Float[np.ndarray, " n"]
    judged: Float[np.ndarray, "n 3"]
    reference: Float[np.ndarray, "n 3"]


@derived
def pair(case: Case) -> Pair:
    """The two axes where both are there.

    Raises:
        ValueError: They share less than 5 m.
    """
    reference, axis = reference_curve(case), lining_curve(case)
    fine = axis.frames(np.linspace(0.0, axis.length, int(axis.length / 0.25) + 2))[0]
    local = reference.local(fine)
    local = local[np.argsort(local[:, 0], kind="stable")]
    local = local[np.concatenate([[True], np.diff(local[:, 0]) > 1e-6])]
    low, high = max(reference.station[0], local[0, 0]), min(reference.station[-1], local[-1, 0])
    if high - low < 5.0:
        raise ValueError("lining and reference share less than 5 m of chainage")
    station = np.arange(low, high, STEP)
    offset = CubicSpline(local[:, 0], local[:, 1:])(station)
    judged = reference.point(np.column_stack([station, offset]))
    return Pair(station, offset[:, 0], offset[:, 1], judged, reference.frames(station)[0])


def heading(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " m"]:
    """Of the chords over 2 m, rad."""
    chord = points[2:] - points[:-2]
    return np.arctan2(chord[:, 1], chord[:, 0])


def curvature(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Of the plan, by a local parabola over 10 m, 1/m."""
    first, second = (_slope(points[:, :2], order) for order in (1, 2))
    across = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return across / np.linalg.norm(first, axis=1) ** 3


def grade(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Longitudinal slope by a local parabola over 10 m."""
    first = _slope(points, 1)
    return first[:, 2] / np.linalg.norm(first[:, :2], axis=1)


def _slope(values: np.ndarray, order: int) -> np.ndarray:
    window = min(11, len(values) - 1 + len(values) % 2)
    return savgol_filter(values, window, 2, deriv=order, delta=STEP, axis=0)


def drift_slope(judged: Float[np.ndarray, " k"], true: Float[np.ndarray, " t"]) -> float:
    """Robust slope of the axial residual of a sequence of features, m/m.

    Features are matched in order: each to the true one nearest to where the drift so far puts it, so that a drift of
    more than half a spacing is followed, and a constant offset does not count.

    Args:
        judged: Their stations on the reference axis as reconstructed.
        true: The same of the truth.
    """
    reach = 0.5 * float(np.median(np.diff(true)))
    drift, residual = 0.0, np.full(len(judged), np.nan)
    for i, station in enumerate(judged):
        gap = station - drift - true[np.argmin(np.abs(true - (station - drift)))]
        if abs(gap) < 0.8 * reach:
            drift += gap
            residual[i] = drift
    matched = np.isfinite(residual)
    if matched.sum() < 5:
        raise ValueError("fewer than five features match")
    return float(theilslopes(residual[matched], (judged - residual)[matched]).slope)


@derived
def registration(case: Case) -> Float[np.ndarray, "4 4"]:
    """Best rigid motion of the visible surface onto the held-out cloud, about the middle of the cloud."""
    target = hold_points(case)
    centre = np.round(target.mean(axis=0))
    source, _ = lattice(surface(case), 2 * _SPACING)
    low, high = target.min(axis=0) - _REACH, target.max(axis=0) + _REACH
    source = source[((source > low) & (source < high)).all(axis=1)]
    result = small_gicp.align(
        target - centre, source - centre, registration_type="PLANE_ICP",
        downsampling_resolution=_SPACING, max_correspondence_distance=_REACH, num_threads=1,
    )  # fmt: skip
    return np.asarray(result.T_target_source)


def turned(motion: Float[np.ndarray, "4 4"]) -> float:
    """Angle of a rigid motion, degrees."""
    return float(np.rad2deg(Rotation.from_matrix(motion[:3, :3]).magnitude()))
