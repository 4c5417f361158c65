"""Local planes of a point cloud: normals, roughness, entropy; one estimator for real and synthetic points."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case, derived, of_hold, until
from benchmarks.fidelity.derive.beams import returns, synthetic

NEIGHBOURS = 24
_FRAME = 1500  # points of each scan at most
_MOST = 240_000
_ENTROPY_RADIUS = 0.3  # m
_ENTROPY_POINTS = 4000


@dataclass(frozen=True)
class Planes:
    """A plane through the neighbours of each chosen point.

    Attributes:
        point: m, `(n, 3)`.
        normal: Unit vectors, `(n, 3)`.
        residual: Distance of the point from its plane, freed of the plane's three parameters, m, `(n,)`.
        sigma: Standard deviation of the neighbours about it, m, `(n,)`.
        planarity: (middle - smallest) / largest spread: near 0 for a line or a ball, `(n,)`.
    """

    point: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    residual: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]
    planarity: Float[np.ndarray, " n"]


def planes(cloud: Float[np.ndarray, "m 3"], tree: cKDTree, query: Float[np.ndarray, "n 3"]) -> Planes:
    """Principal axes of the `NEIGHBOURS` nearest points of a cloud."""
    count = min(NEIGHBOURS, len(cloud))
    around = cloud[tree.query(query, count)[1]]
    middle = around.mean(axis=1)
    away = around - middle[:, None]
    spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", away, away) / count)
    freed = np.sqrt(count / max(count - 3, 1))
    spread = np.sqrt(np.maximum(spread, 0.0))
    residual = np.abs(np.einsum("ni,ni->n", query - middle, axes[:, :, 0])) * freed
    planarity = (spread[:, 1] - spread[:, 0]) / np.maximum(spread[:, 2], 1e-9)
    return Planes(query, axes[:, :, 0], residual, spread[:, 0] * freed, planarity)


@of_hold
def chosen(case: Case) -> Int[np.ndarray, " k"]:
    """Numbers of the returns at which planes are fitted: the same count of each scan, evenly in time."""
    scan = returns(case).scan
    starts = np.flatnonzero(np.concatenate([[True], np.diff(scan) != 0]))
    ends = np.append(starts[1:], len(scan))
    each = int(np.clip(_MOST // len(starts), 50, _FRAME))
    return np.concatenate([
        np.linspace(a, b - 1, min(b - a, each)).astype(int) for a, b in zip(starts, ends, strict=True)
    ])  # fmt: skip


@of_hold
def real_planes(case: Case) -> Planes:
    """Of the held-out cloud at `chosen`."""
    from benchmarks.fidelity.derive.distances import cloud_tree

    points = returns(case).points
    return planes(points, cloud_tree(case), points[chosen(case)])


@until("DIS")
@derived
def synthetic_tree(case: Case) -> tuple[Float[np.ndarray, "m 3"], cKDTree]:
    """The synthetic points that there are, and their tree."""
    points = synthetic(case)
    points = points[np.isfinite(points[:, 0])]
    if len(points) < NEIGHBOURS:
        raise ValueError("held-out beams hardly meet the candidate")
    return points, cKDTree(points, balanced_tree=False)


@derived
def synthetic_planes(case: Case) -> Planes:
    """Of the synthetic cloud at `chosen`; rows of a beam that leaves the candidate are not a number."""
    cloud, tree = synthetic_tree(case)
    query = synthetic(case)[chosen(case)]
    there = np.isfinite(query[:, 0])
    found = planes(cloud, tree, query[there])
    full = [np.full((len(query), *column.shape[1:]), np.nan) for column in vars(found).values()]
    for column, values in zip(full, vars(found).values(), strict=True):
        column[there] = values
    return Planes(*full)


def mean_entropy(tree: cKDTree, query: Float[np.ndarray, "n 3"]) -> float:
    """Mean map entropy: the mean of ½ ln det(2πe Σ) of the points within 0.3 m, nat.

    Source: Razlaw et al. 2015, Evaluation of registration methods for sparse 3D laser scans; MapEval uses it too.
    """
    query = query[np.linspace(0, len(query) - 1, min(len(query), _ENTROPY_POINTS)).astype(int)]
    values = []
    for near in tree.query_ball_point(query, _ENTROPY_RADIUS):
        if len(near) >= 10:
            sign, logdet = np.linalg.slogdet(2.0 * np.pi * np.e * np.cov(tree.data[near].T))
            values.append(0.5 * logdet if sign > 0 else np.nan)
    return float(np.nanmean(values))
