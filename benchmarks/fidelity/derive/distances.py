"""Distances between held-out points and the candidate, both ways."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case, derived, of_hold, until
from benchmarks.fidelity.derive.beams import at, paired, returns
from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.derive.packing import cells
from benchmarks.fidelity.derive.path import sensor_path
from benchmarks.fidelity.derive.surface import lattice, nearest, normals, surface
from benchmarks.fidelity.references import Hold

MOST = 120_000
BOOTSTRAP = 50_000  # samples behind an interval; the value itself uses all
STEEPEST = np.cos(np.deg2rad(80.0))  # beams that graze a surface at more than 80° do not observe it
_CELL = 0.1  # m between samples of the candidate
_SECTORS = 8


@dataclass(frozen=True)
class ToMesh:
    """Held-out points against the candidate.

    Attributes:
        distance: To the nearest point of the candidate, m, `(n,)`.
        signed: The same, positive where the point is on the sensor's side of it, m, `(n,)`.
        station: Along the sensor's path, m, `(n,)`.
        sector: Of eight about the candidate's axis, 0 to its left, 2 its crown, 6 its floor, `(n,)`.
    """

    distance: Float[np.ndarray, " n"]
    signed: Float[np.ndarray, " n"]
    station: Float[np.ndarray, " n"]
    sector: Int[np.ndarray, " n"]


@dataclass(frozen=True)
class ToCloud:
    """Samples of the candidate that held-out beams observed, against the held-out points.

    Attributes:
        distance: To the nearest held-out point, m, `(n,)`.
        station: Along the sensor's path, m, `(n,)`.
    """

    distance: Float[np.ndarray, " n"]
    station: Float[np.ndarray, " n"]


@of_hold
def thinned(case: Case) -> Int[np.ndarray, " k"]:
    """Numbers of at most `MOST` of the returns, evenly spaced in time."""
    count = len(returns(case).range)
    return np.linspace(0, count - 1, min(count, MOST)).astype(int)


@until("DIS")
@of_hold
def cloud_tree(case: Case) -> cKDTree:
    """Of all held-out returns."""
    return cKDTree(returns(case).points, balanced_tree=False)


@until("CMP")
@derived
def to_mesh(case: Case) -> ToMesh:
    """Distances of held-out points to everything visible of the candidate; nothing is registered first."""
    pick, real = thinned(case), returns(case)
    points = real.points[pick]
    distance, closest, face = nearest(case).query(points)
    normal = normals(surface(case), face)
    side = np.einsum("ij,ij->i", normal, points - closest) * np.einsum("ij,ij->i", normal, real.origin[pick] - closest)
    bore = case.candidate.bore
    local = Curve(bore.station, bore.position).local(points)
    sector = np.round(np.arctan2(local[:, 2], local[:, 1]) / (2.0 * np.pi / _SECTORS)).astype(int) % _SECTORS
    return ToMesh(distance, np.copysign(distance, side), real.local[pick, 0], sector)


def mean_distance(case: Case, other: Hold) -> float:
    """Mean distance of another recording's points to the candidate, m."""
    points = other.points
    return float(
        nearest(case).query(points[np.linspace(0, len(points) - 1, min(len(points), MOST)).astype(int)])[0].mean()
    )


@derived
def to_cloud(case: Case) -> ToCloud:
    """One sample in 10 cm of the candidate, of those that a held-out beam cast in it would have hit.

    A sample counts as observed if a beam hits the candidate within 5 cm of it at less than 80° of incidence; half the
    smallest tolerance, so that a return that is there is within reach of it.
    """
    cast = paired(case)
    seen = cast.cosine > STEEPEST
    hits = at(case, cast.range)[seen]
    samples, _ = lattice(surface(case), _CELL)
    samples = samples[:: max(len(samples) // (4 * MOST), 1)]
    if not len(hits) or not len(samples):
        raise ValueError("no held-out beam meets the candidate")
    gap, _ = cKDTree(hits, balanced_tree=False).query(samples, distance_upper_bound=0.05 * case.tolerance)
    samples = samples[np.isfinite(gap)]
    local = sensor_path(case).local(samples)
    even = np.unique(cells(local, _CELL), return_index=True)[1]  # small triangles have more samples than their area's
    even = even[np.linspace(0, len(even) - 1, min(len(even), MOST)).astype(int)]
    distance, _ = cloud_tree(case).query(samples[even])
    return ToCloud(distance, local[even, 0])
