"""Map statistics after MapEval: voxelised Wasserstein distance and its spatial consistency."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case, derived, of_hold
from benchmarks.fidelity.derive.beams import local_at, noisy, returns
from benchmarks.fidelity.derive.packing import cells

EDGE = 0.5  # m
FEWEST = 10  # points of either cloud in a voxel that is compared


@dataclass(frozen=True)
class Voxelised:
    """Normal distributions of a cloud in voxels.

    Attributes:
        key: Voxel, `(v, 3)`, sorted.
        mean: m, `(v, 3)`.
        covariance: m², `(v, 3, 3)`.
    """

    key: Int[np.ndarray, "v 3"]
    mean: Float[np.ndarray, "v 3"]
    covariance: Float[np.ndarray, "v 3 3"]


def voxelised(local: Float[np.ndarray, "n 3"], edge: float) -> Voxelised:
    """Means and covariances of the voxels that hold at least `FEWEST` points."""
    _, first, voxel, count = np.unique(cells(local, edge), return_index=True, return_inverse=True, return_counts=True)
    key = np.floor(local[first] / edge).astype(np.int64)
    mean = np.stack([np.bincount(voxel, axis) for axis in local.T], axis=1) / count[:, None]
    away = local - mean[voxel]
    covariance = np.empty((len(key), 3, 3))
    for i in range(3):
        for j in range(3):
            covariance[:, i, j] = np.bincount(voxel, away[:, i] * away[:, j]) / np.maximum(count - 1, 1)
    kept = count >= FEWEST
    return Voxelised(key[kept], mean[kept], covariance[kept])


def wasserstein(a: Voxelised, b: Voxelised) -> tuple[Int[np.ndarray, "v 3"], Float[np.ndarray, " v"]]:
    """Voxels that both clouds have, and the 2-Wasserstein distance of their normal distributions, m.

    Source: MapEval, arXiv 2411.17928: W² = |μ₁ - μ₂|² + tr(Σ₁ + Σ₂ - 2 (Σ₂^½ Σ₁ Σ₂^½)^½).
    """
    index = {tuple(key): row for row, key in enumerate(b.key)}
    pairs = np.array([(i, index[key]) for i, key in enumerate(map(tuple, a.key)) if key in index]).reshape(-1, 2)
    first, second = pairs.T
    root = _root(b.covariance[second])
    inner = np.linalg.eigvalsh(root @ a.covariance[first] @ root)
    cross = np.sqrt(np.maximum(inner, 0.0)).sum(axis=1)
    trace = np.trace(a.covariance[first] + b.covariance[second], axis1=1, axis2=2)
    squared = np.sum((a.mean[first] - b.mean[second]) ** 2, axis=1) + trace - 2.0 * cross
    return a.key[first], np.sqrt(np.maximum(squared, 0.0))


def inconsistency(key: Int[np.ndarray, "v 3"], distance: Float[np.ndarray, " v"]) -> float:
    """Spatial consistency score: mean over the voxels of deviation over mean of the distances of their neighbours."""
    ratios = []
    for near in cKDTree(key.astype(float)).query_ball_point(key.astype(float), 1.8):  # 26 neighbours
        if len(near) >= 3 and (mean := distance[near].mean()) > 0:
            ratios.append(distance[near].std() / mean)
    return float(np.mean(ratios))


@of_hold
def real_map(case: Case) -> Voxelised:
    """Of the held-out points."""
    return voxelised(returns(case).local, EDGE * case.tolerance)


@derived
def map_distances(case: Case) -> tuple[Int[np.ndarray, "v 3"], Float[np.ndarray, " v"]]:
    """Voxels and Wasserstein distances between held-out and synthetic map.

    Raises:
        ValueError: They share no voxel.
    """
    local = local_at(case, noisy(case, "first"))
    local = local[np.isfinite(local[:, 0])]
    key, distance = wasserstein(real_map(case), voxelised(local, EDGE * case.tolerance))
    if not len(key):
        raise ValueError("held-out and synthetic map share no voxel")
    return key, distance


@of_hold
def own_inconsistency(case: Case) -> float:
    """Spatial consistency score of the odd held-out points against the even ones."""
    local = returns(case).local
    halves = [voxelised(local[k::2], EDGE * case.tolerance) for k in (0, 1)]
    return inconsistency(*wasserstein(*halves))


def _root(matrix: Float[np.ndarray, "v 3 3"]) -> Float[np.ndarray, "v 3 3"]:
    values, axes = np.linalg.eigh(matrix)
    return (axes * np.sqrt(np.maximum(values, 0.0))[:, None, :]) @ axes.transpose(0, 2, 1)
