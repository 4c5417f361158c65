"""How much a scan shifted along the tunnel looks like itself, and what registration makes of it."""

import numpy as np
from jaxtyping import Float
from scipy.signal import find_peaks
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case, derived, of_hold
from benchmarks.fidelity.derive.beams import returns, synthetic
from benchmarks.fidelity.derive.noise import Planes, chosen, real_planes, synthetic_planes
from benchmarks.fidelity.derive.path import sensor_path

STEP, FARTHEST = 0.05, 3.0  # m
NEAREST = 0.2  # m; a smaller shift is the same place
_SCANS, _POINTS = 24, 250
_CLIP = 0.3  # m; a point farther from its plane has no counterpart
_PAIRS = 16


@of_hold
def real_alias(case: Case) -> Float[np.ndarray, " s"]:
    """Alias ratios of the held-out scans."""
    return _alias(case, real_planes(case))


@derived
def synthetic_alias(case: Case) -> Float[np.ndarray, " s"]:
    """Alias ratios of the same scans taken in the candidate."""
    return _alias(case, synthetic_planes(case))


def _alias(case: Case, planes: Planes) -> Float[np.ndarray, " s"]:
    """Cost at the best shift of 0.2 to 3 m over the cost at none, of some scans against the map; 1 is a perfect alias.

    The cost is the mean distance from the planes of the nearest map points, cut off at 0.3 m. Scans without a
    minimum of the cost among the shifts count with the smallest cost there.
    """
    numbers, scan = np.unique(returns(case).scan[chosen(case)], return_inverse=True)
    known = np.isfinite(planes.normal[:, 0])
    rows = np.flatnonzero(known & (scan % 2 == 1))  # the map: no scan meets itself in it
    tree = cKDTree(planes.point[rows])
    shifts = np.arange(-FARTHEST, FARTHEST + STEP / 2, STEP)
    same = np.abs(shifts) < NEAREST - STEP / 2
    ratios = []
    even = np.arange(0, len(numbers), 2)
    for index in even[np.linspace(0, len(even) - 1, min(len(even), _SCANS)).astype(int)]:
        own = np.flatnonzero((scan == index) & known)
        if len(own) < 20:
            continue
        own = own[np.linspace(0, len(own) - 1, min(len(own), _POINTS)).astype(int)]
        points = planes.point[own]
        axis = sensor_path(case).frames(sensor_path(case).local(points.mean(axis=0)[None])[:, 0])[1][0]
        moved = (points[None] + shifts[:, None, None] * axis).reshape(-1, 3)
        near = rows[tree.query(moved)[1]]
        off = np.abs(np.einsum("ij,ij->i", planes.normal[near], moved - planes.point[near]))
        cost = np.minimum(off, _CLIP).reshape(len(shifts), -1).mean(axis=1)
        valleys = np.setdiff1d(find_peaks(-cost)[0], np.flatnonzero(same))
        rival = cost[valleys].min() if len(valleys) else cost[~same].min()
        ratios.append(rival / max(cost[same].min(), 1e-9))
    if not ratios:
        raise ValueError("no scan has enough points")
    return np.asarray(ratios)


@of_hold
def real_icp(case: Case) -> Float[np.ndarray, " p"]:
    """Axial errors of scan-to-scan registration of held-out scans, m."""
    return _icp(case, returns(case).points)


@derived
def synthetic_icp(case: Case) -> Float[np.ndarray, " p"]:
    """The same of scans taken in the candidate."""
    return _icp(case, synthetic(case))


def _icp(case: Case, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " p"]:
    """How far along the axis generalised ICP moves each of some scans that lie on their predecessors already, m."""
    import small_gicp

    scan = returns(case).scan
    numbers = np.unique(scan)
    bounds = np.searchsorted(scan, np.append(numbers, numbers[-1] + 1))
    errors = []
    for k in np.linspace(1, len(numbers) - 1, min(len(numbers) - 1, _PAIRS)).astype(int):
        before, here = (points[bounds[i] : bounds[i + 1]] for i in (k - 1, k))
        before, here = (cloud[np.isfinite(cloud[:, 0])] for cloud in (before, here))
        if min(len(before), len(here)) < 200:
            continue
        middle = np.round(here.mean(axis=0))
        found = small_gicp.align(before - middle, here - middle, downsampling_resolution=0.25, num_threads=1)
        axis = sensor_path(case).frames(sensor_path(case).local(here.mean(axis=0)[None])[:, 0])[1][0]
        errors.append(abs(float(found.T_target_source[:3, 3] @ axis)))
    return np.asarray(errors)
