"""Information of a scan about its own pose: Hessians, shifted scans, the planar scan of the environment."""

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.signal import find_peaks
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case, per_case, per_side
from benchmarks.fidelity.derive import clouds
from benchmarks.fidelity.derive.beams import returns, sensor_path, side_points
from benchmarks.fidelity.derive.curve import interpolate_rows
from subterra_jax.host.tunnelfile import read_fields

_FEWEST_POINTS = 20  # points of a scan
_EIGEN_FLOOR = 1e-6  # of an eigenvalue; less than the noise of any normal


@dataclass(frozen=True)
class ScanInformation:
    """Information of the scans, per point."""

    station: Float[np.ndarray, " s"]  # Station of the sensor, m
    axial: Float[np.ndarray, " s"]  # Information about a shift along the tunnel: mean of (normal · axis)²
    translation: Float[np.ndarray, "s 3"]  # Eigenvalues of the translation block, growing
    weakest: Float[np.ndarray, "s 3"]  # Direction of the smallest of them
    # Smallest eigenvalue of the rotation block, arms in units of the scan's mean range
    rotation: Float[np.ndarray, " s"]


@per_side
def information(case: Case, real: bool) -> ScanInformation:
    """Return Hessians of point-to-plane registration about the sensor, of the held-out scans or the candidate's."""
    points, beams, pick = side_points(case, real), returns(case), clouds.few_rows(case)[1]
    normal, arm, scan = clouds.smooth_normals(case, points), points[pick] - beams.origin[pick], beams.scan[pick]
    starts = np.flatnonzero(np.concatenate([[True], np.diff(scan) != 0]))
    bounds = np.append(starts, len(scan))
    station = sensor_path(case).local(beams.origin[pick[starts]])[:, 0]
    axis = sensor_path(case).frames(station)[1]
    rows = [_scan_information(arm[a:b], normal[a:b], axis[k]) for k, (a, b) in enumerate(itertools.pairwise(bounds))]
    columns = [np.asarray(column) for column in zip(*rows, strict=True)]
    return ScanInformation(station, *columns)


def _scan_information(
    arm: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "n 3"], axis: Float[np.ndarray, "3"]
) -> tuple[float, np.ndarray, np.ndarray, float]:
    known = np.isfinite(normal[:, 0])
    arm, normal = arm[known], normal[known]
    if len(arm) < _FEWEST_POINTS:
        return np.nan, np.full(3, np.nan), np.full(3, np.nan), np.nan
    values, vectors = np.linalg.eigh(normal.T @ normal / len(normal))
    turn = np.cross(arm / np.mean(np.linalg.norm(arm, axis=1)), normal)
    rotation = float(np.linalg.eigvalsh(turn.T @ turn / len(turn))[0])
    along = max(float(np.mean(np.square(normal @ axis))), _EIGEN_FLOOR)
    return along, np.maximum(values, _EIGEN_FLOOR), vectors[:, 0], max(rotation, _EIGEN_FLOOR)


# Aliases: scans shifted along the tunnel, and scan-to-scan registration.

SHIFT_STEP, SHIFT_MOST = 0.05, 3.0  # m
SHIFT_LEAST = 0.2  # m; a smaller shift is the same place
_ALIAS_SCANS, _ALIAS_POINTS = 24, 250
_COST_CLIP = 0.3  # m; a point farther from its plane has no counterpart
_ICP_PAIRS = 16


@per_side
def alias_ratios(case: Case, real: bool) -> Float[np.ndarray, " s"]:
    """Return the cost at the best shift of 0.2 to 3 m over the cost without shift, per scan; 1 is a perfect alias.

    The cost is the mean distance from the planes of the nearest map points, cut off at 0.3 m. Scans without a
    minimum of the cost among the shifts count with the smallest cost there.
    """
    planes = clouds.real_planes(case) if real else clouds.synthetic_planes(case)
    numbers, scan = np.unique(returns(case).scan[clouds.plane_rows(case)], return_inverse=True)
    known = np.isfinite(planes.normal[:, 0])
    rows = np.flatnonzero(known & (scan % 2 == 1))  # the map: no scan meets itself in it
    tree = cKDTree(planes.point[rows])
    shifts = np.arange(-SHIFT_MOST, SHIFT_MOST + SHIFT_STEP / 2, SHIFT_STEP)
    same = np.abs(shifts) < SHIFT_LEAST - SHIFT_STEP / 2
    ratios = []
    even = np.arange(0, len(numbers), 2)
    for index in even[np.linspace(0, len(even) - 1, min(len(even), _ALIAS_SCANS)).astype(int)]:
        own = np.flatnonzero((scan == index) & known)
        if len(own) < 20:
            continue
        own = own[np.linspace(0, len(own) - 1, min(len(own), _ALIAS_POINTS)).astype(int)]
        points = planes.point[own]
        axis = sensor_path(case).frames(sensor_path(case).local(points.mean(axis=0)[None])[:, 0])[1][0]
        moved = (points[None] + shifts[:, None, None] * axis).reshape(-1, 3)
        near = rows[tree.query(moved)[1]]
        off = np.abs(np.einsum("ij,ij->i", planes.normal[near], moved - planes.point[near]))
        cost = np.minimum(off, _COST_CLIP).reshape(len(shifts), -1).mean(axis=1)
        valleys = np.setdiff1d(find_peaks(-cost)[0], np.flatnonzero(same))
        rival = cost[valleys].min() if len(valleys) else cost[~same].min()
        ratios.append(rival / max(cost[same].min(), 1e-9))
    if not ratios:
        raise ValueError("no scan has enough points")
    return np.asarray(ratios)


@per_side
def icp_errors(case: Case, real: bool) -> Float[np.ndarray, " p"]:
    """Return the axial shift by generalised ICP of scans that lie on their predecessors already, m."""
    import small_gicp

    points, scan = side_points(case, real), returns(case).scan
    numbers = np.unique(scan)
    bounds = np.searchsorted(scan, np.append(numbers, numbers[-1] + 1))
    errors = []
    for k in np.linspace(1, len(numbers) - 1, min(len(numbers) - 1, _ICP_PAIRS)).astype(int):
        before, here = (points[bounds[i] : bounds[i + 1]] for i in (k - 1, k))
        before, here = (cloud[np.isfinite(cloud[:, 0])] for cloud in (before, here))
        if min(len(before), len(here)) < 200:
            continue
        middle = np.round(here.mean(axis=0))
        motion = small_gicp.align(before - middle, here - middle, downsampling_resolution=0.25, num_threads=1)
        axis = sensor_path(case).frames(sensor_path(case).local(here.mean(axis=0)[None])[:, 0])[1][0]
        errors.append(abs(float(motion.T_target_source[:3, 3] @ axis)))
    return np.asarray(errors)


# The planar scan of the environment.

PLANAR_BEAMS = 16
PLANAR_SIGMA = 0.05  # m, of a range; the environment's default
PLANAR_REACH = 30.0  # m
LOCALISED_SIGMA = 0.25  # m: standard deviation along the axis from which on a station counts as localised
_STATION_SPACING = 1.0  # m


@per_case
def localised_stations(case: Case) -> Bool[np.ndarray, " s"]:
    """Return True for each metre of `tunnel.npz` where 16 beams on its axis fix the station.

    Shifted along the axis t, a range changes by (n·t)/(n·d) and its distance from the wall by n·t; the standard
    deviation of the shift is σ over the root of the sum of (n·t)² over the beams that return.
    """
    data = read_fields(case.candidate.tunnel)
    lining = "pockets" if "left_pockets" in data else "smooth"
    walls = [data[f"{side}_{lining}"] for side in ("left", "right")]
    station, centre, tangent = (data[name] for name in ("station", "centre", "tangent"))
    start, end = (np.concatenate([wall[part] for wall in walls]) for part in (slice(None, -1), slice(1, None)))
    places = np.arange(station[0] + 0.5 * _STATION_SPACING, station[-1], _STATION_SPACING)
    centres, tangents = (interpolate_rows(places, station, rows) for rows in (centre, tangent))
    information = [
        _axial_information(c, t / np.linalg.norm(t), start, end) for c, t in zip(centres, tangents, strict=True)
    ]
    return np.asarray(information) > (PLANAR_SIGMA / LOCALISED_SIGMA) ** 2


def _axial_information(
    place: Float[np.ndarray, "2"],
    tangent: Float[np.ndarray, "2"],
    start: Float[np.ndarray, "w 2"],
    end: Float[np.ndarray, "w 2"],
) -> float:
    """Return the sum of (n·t)² over the beams from a place."""
    near = np.minimum(np.linalg.norm(start - place, axis=1), np.linalg.norm(end - place, axis=1)) < PLANAR_REACH
    wall, offset = (end - start)[near], start[near] - place
    length = np.linalg.norm(wall, axis=1)
    wall, offset, length = wall[length > 0], offset[length > 0], length[length > 0]
    if not len(wall):
        return 0.0
    angle = np.arctan2(tangent[1], tangent[0]) + 2.0 * np.pi * np.arange(PLANAR_BEAMS) / PLANAR_BEAMS
    beam = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    across = _cross(beam[:, None], wall[None])
    across = np.where(np.abs(across) < 1e-12, np.nan, across)
    reach = _cross(offset[None], wall[None]) / across
    fraction = _cross(offset[None], beam[:, None]) / across
    reach = np.where((reach > 0.0) & (fraction >= 0.0) & (fraction <= 1.0), reach, np.inf)
    first = np.argmin(reach, axis=1)
    returned = reach[np.arange(PLANAR_BEAMS), first] < PLANAR_REACH
    return float(np.sum(np.square(_cross(wall[first], tangent) / length[first])[returned]))


def _cross(a: Float[np.ndarray, "... 2"], b: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "..."]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
