"""What each scan alone can tell about its own pose: the point-to-plane Hessian, real and synthetic."""

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.fidelity.case import Case, derived, of_hold
from benchmarks.fidelity.derive.beams import returns
from benchmarks.fidelity.derive.noise import Planes, chosen, real_planes, synthetic_planes
from benchmarks.fidelity.derive.path import sensor_path

_FEWEST = 20  # points of a scan
_FLOOR = 1e-6  # of an eigenvalue; less than the noise of any normal


@dataclass(frozen=True)
class Frames:
    """Information of the scans, a point's share of it each.

    Attributes:
        station: Of the sensor, m, `(s,)`.
        axial: Of a shift along the tunnel: mean of (normal · axis)², `(s,)`.
        translation: Eigenvalues of the translation block, growing, `(s, 3)`.
        weakest: Direction of the smallest of them, `(s, 3)`.
        rotation: Smallest eigenvalue of the rotation block, arms in units of the scan's mean range, `(s,)`.
        strong: Share of points whose normal lies within 60° of the axis, `(s,)`.
    """

    station: Float[np.ndarray, " s"]
    axial: Float[np.ndarray, " s"]
    translation: Float[np.ndarray, "s 3"]
    weakest: Float[np.ndarray, "s 3"]
    rotation: Float[np.ndarray, " s"]
    strong: Float[np.ndarray, " s"]


@of_hold
def real_frames(case: Case) -> Frames:
    """Of the held-out scans."""
    return _frames(case, real_planes(case))


@derived
def synthetic_frames(case: Case) -> Frames:
    """Of the same scans taken in the candidate."""
    return _frames(case, synthetic_planes(case))


def _frames(case: Case, planes: Planes) -> Frames:
    """Hessians of point-to-plane registration about the sensor, from normals by local planes on either side."""
    real, pick = returns(case), chosen(case)
    scan = real.scan[pick]
    starts = np.flatnonzero(np.concatenate([[True], np.diff(scan) != 0]))
    bounds = np.append(starts, len(scan))
    station = sensor_path(case).local(real.origin[pick[starts]])[:, 0]
    axis = sensor_path(case).frames(station)[1]
    rows = [
        _one(planes.point[a:b] - real.origin[pick[a:b]], planes.normal[a:b], axis[k])
        for k, (a, b) in enumerate(itertools.pairwise(bounds))
    ]
    columns = [np.asarray(column) for column in zip(*rows, strict=True)]
    return Frames(station, *columns)


def _one(
    arm: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "n 3"], axis: Float[np.ndarray, "3"]
) -> tuple[float, np.ndarray, np.ndarray, float, float]:
    known = np.isfinite(normal[:, 0])
    arm, normal = arm[known], normal[known]
    if len(arm) < _FEWEST:
        return np.nan, np.full(3, np.nan), np.full(3, np.nan), np.nan, np.nan
    values, vectors = np.linalg.eigh(normal.T @ normal / len(normal))
    turn = np.cross(arm / np.mean(np.linalg.norm(arm, axis=1)), normal)
    rotation = float(np.linalg.eigvalsh(turn.T @ turn / len(turn))[0])
    along = np.square(normal @ axis)
    return (
        max(float(np.mean(along)), _FLOOR), np.maximum(values, _FLOOR), vectors[:, 0],
        max(rotation, _FLOOR), float(np.mean(along > 0.25)),
    )  # fmt: skip
