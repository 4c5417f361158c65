"""Statistics of point clouds: local planes, voxel maps, roughness of the wall."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case, kept_until, per_case, per_hold
from benchmarks.fidelity.derive.beams import cloud_tree, local_at, noisy_ranges, returns, synthetic_points
from benchmarks.fidelity.derive.mesh import first_hits, weld_offset, welded_lining
from benchmarks.fidelity.derive.surface import cell_numbers

NEIGHBOURS = 24
_FEW_PER_SCAN = 2000  # points of each scan in the cloud of `smooth_normals`: half of the beams leave more
_SUPPORT = 64  # points of a plane there
_PLANES_AT_ONCE = 20_000
_MOST_PER_SCAN = 1500  # points of each scan at most
_MOST_PLANES = 240_000
_ENTROPY_RADIUS = 0.3  # m
_ENTROPY_POINTS = 4000


@dataclass(frozen=True)
class Planes:
    """Planes through the neighbours of chosen points."""

    point: Float[np.ndarray, "n 3"]  # Chosen points, m
    normal: Float[np.ndarray, "n 3"]  # Normals, unit vectors
    residual: Float[np.ndarray, " n"]  # Distance of the point from its plane, freed of the plane's three parameters, m
    sigma: Float[np.ndarray, " n"]  # Standard deviation of the neighbours about it, m


def fit_planes(cloud: Float[np.ndarray, "m 3"], tree: cKDTree, query: Float[np.ndarray, "n 3"]) -> Planes:
    """Fits a plane through the `NEIGHBOURS` nearest points of a cloud, by principal axes."""
    count = min(NEIGHBOURS, len(cloud))
    middle, spread, axes = _principal_axes(cloud, tree, query, count)
    freed = np.sqrt(count / max(count - 3, 1))
    residual = np.abs(np.einsum("ni,ni->n", query - middle, axes[:, :, 0])) * freed
    return Planes(query, axes[:, :, 0], residual, spread[:, 0] * freed)


def _principal_axes(
    cloud: Float[np.ndarray, "m 3"], tree: cKDTree, query: Float[np.ndarray, "n 3"], count: int
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
    """Return middle, standard deviations (growing) and axes of the points of a cloud that are nearest to each query."""
    parts = []
    for start in range(0, max(len(query), 1), _PLANES_AT_ONCE):
        around = cloud[tree.query(query[start : start + _PLANES_AT_ONCE], count)[1]]
        middle = around.mean(axis=1)
        away = around - middle[:, None]
        spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", away, away) / count)
        parts.append((middle, np.sqrt(np.maximum(spread, 0.0)), axes))
    middles, spreads, all_axes = (np.concatenate(column) for column in zip(*parts, strict=True))
    return middles, spreads, all_axes


@kept_until("DEG", per_hold)
def plane_rows(case: Case) -> Int[np.ndarray, " k"]:
    """Return the numbers of the returns with a plane: the same count of each scan, evenly in time."""
    scan = returns(case).scan
    starts = np.flatnonzero(np.concatenate([[True], np.diff(scan) != 0]))
    ends = np.append(starts[1:], len(scan))
    each = _planes_per_scan(len(starts))
    return np.concatenate([
        np.linspace(a, b - 1, min(b - a, each)).astype(int) for a, b in zip(starts, ends, strict=True)
    ])  # fmt: skip


def _planes_per_scan(scans: int) -> int:
    return int(np.clip(_MOST_PLANES // scans, 50, _MOST_PER_SCAN))


@kept_until("DEG", per_hold)
def real_planes(case: Case) -> Planes:
    points = returns(case).points
    return fit_planes(points, cloud_tree(case), points[plane_rows(case)])


@kept_until("DIS", per_case)
def synthetic_tree(case: Case) -> tuple[Float[np.ndarray, "m 3"], cKDTree]:
    points = synthetic_points(case)
    points = points[np.isfinite(points[:, 0])]
    if len(points) < NEIGHBOURS:
        raise ValueError("held-out beams hardly meet the candidate")
    return points, cKDTree(points, balanced_tree=False)


@per_case
def synthetic_planes(case: Case) -> Planes:
    """Return the planes of the synthetic cloud at `plane_rows`; NaN rows where a beam leaves the candidate."""
    cloud, tree = synthetic_tree(case)
    query = synthetic_points(case)[plane_rows(case)]
    there = np.isfinite(query[:, 0])
    planes = fit_planes(cloud, tree, query[there])
    full = [np.full((len(query), *column.shape[1:]), np.nan) for column in vars(planes).values()]
    for column, values in zip(full, vars(planes).values(), strict=True):
        column[there] = values
    return Planes(*full)


# Normals of a cloud that is as dense whatever the sensor.


@kept_until("DEG", per_hold)
def few_rows(case: Case) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " q"]]:
    """Return the numbers of `_FEW_PER_SCAN` returns of each scan, drawn at random, and of those that get a normal."""
    scan = returns(case).scan
    order = np.lexsort((case.rng("few returns of each scan").random(len(scan)), scan))
    place = np.arange(len(scan)) - np.searchsorted(scan[order], scan[order])
    count = _planes_per_scan(len(np.unique(scan)))
    return np.sort(order[place < _FEW_PER_SCAN]), np.sort(order[place < min(count, _FEW_PER_SCAN)])


def smooth_normals(case: Case, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "q 3"]:
    """Return normals at the second `few_rows` of points on the returned beams; NaN where a beam has no point.

    Planes through a number of nearest points grow with the gaps between them, and the noise of the ranges turns the
    normals of small planes farther. So every scan gives the cloud as many points, and planes are wide.
    """
    cloud, query = (points[rows] for rows in few_rows(case))
    cloud = cloud[np.isfinite(cloud[:, 0])]
    there = np.isfinite(query[:, 0])
    normal = np.full((len(query), 3), np.nan)
    if there.any():
        tree = cKDTree(cloud, balanced_tree=False)
        normal[there] = _principal_axes(cloud, tree, query[there], min(_SUPPORT, len(cloud)))[2][:, :, 0]
    return normal


def mean_entropy(tree: cKDTree, query: Float[np.ndarray, "n 3"]) -> float:
    """Return the mean map entropy: the mean of ½ ln det(2πe Σ) of the points within 0.3 m, nat.

    Source: Razlaw et al. 2015, Evaluation of registration methods for sparse 3D laser scans; MapEval uses it too.
    """
    query = query[np.linspace(0, len(query) - 1, min(len(query), _ENTROPY_POINTS)).astype(int)]
    values = []
    for near in tree.query_ball_point(query, _ENTROPY_RADIUS):
        if len(near) >= 10:
            sign, logdet = np.linalg.slogdet(2.0 * np.pi * np.e * np.cov(tree.data[near].T))
            values.append(0.5 * logdet if sign > 0 else np.nan)
    return float(np.nanmean(values))


# Map statistics after MapEval: voxelised Wasserstein distance and its spatial consistency.

MAP_VOXEL = 0.5  # m
FEWEST_IN_VOXEL = 10  # points of either cloud in a voxel that is compared


@dataclass(frozen=True)
class VoxelMap:
    """Normal distributions of a cloud in voxels."""

    key: Int[np.ndarray, "v 3"]  # Indices of the voxels, sorted
    mean: Float[np.ndarray, "v 3"]  # Mean of the points, m
    covariance: Float[np.ndarray, "v 3 3"]  # Covariance of the points, m²


def voxel_map(local: Float[np.ndarray, "n 3"], edge: float) -> VoxelMap:
    """Return means and covariances of the voxels that hold at least `FEWEST_IN_VOXEL` points."""
    _, first, voxel, count = np.unique(
        cell_numbers(local, edge), return_index=True, return_inverse=True, return_counts=True
    )
    key = np.floor(local[first] / edge).astype(np.int64)
    mean = np.stack([np.bincount(voxel, axis) for axis in local.T], axis=1) / count[:, None]
    away = local - mean[voxel]
    covariance = np.empty((len(key), 3, 3))
    for i in range(3):
        for j in range(3):
            covariance[:, i, j] = np.bincount(voxel, away[:, i] * away[:, j]) / np.maximum(count - 1, 1)
    kept = count >= FEWEST_IN_VOXEL
    return VoxelMap(key[kept], mean[kept], covariance[kept])


def voxel_wasserstein(a: VoxelMap, b: VoxelMap) -> tuple[Int[np.ndarray, "v 3"], Float[np.ndarray, " v"]]:
    """Return the voxels of both clouds and the 2-Wasserstein distance of their normal distributions, m.

    Source: MapEval, arXiv 2411.17928: W² = |μ₁ - μ₂|² + tr(Σ₁ + Σ₂ - 2 (Σ₂^½ Σ₁ Σ₂^½)^½).
    """
    index = {tuple(key): row for row, key in enumerate(b.key)}
    pairs = np.array([(i, index[key]) for i, key in enumerate(map(tuple, a.key)) if key in index]).reshape(-1, 2)
    first, second = pairs.T
    values, axes = np.linalg.eigh(b.covariance[second])
    root = (axes * np.sqrt(np.maximum(values, 0.0))[:, None, :]) @ axes.transpose(0, 2, 1)
    inner = np.linalg.eigvalsh(root @ a.covariance[first] @ root)
    cross = np.sqrt(np.maximum(inner, 0.0)).sum(axis=1)
    trace = np.trace(a.covariance[first] + b.covariance[second], axis1=1, axis2=2)
    squared = np.sum((a.mean[first] - b.mean[second]) ** 2, axis=1) + trace - 2.0 * cross
    return a.key[first], np.sqrt(np.maximum(squared, 0.0))


def spatial_consistency(key: Int[np.ndarray, "v 3"], distance: Float[np.ndarray, " v"]) -> float:
    """Return the spatial consistency score: mean over voxels of deviation over mean of their neighbours' distances."""
    ratios = []
    for near in cKDTree(key.astype(float)).query_ball_point(key.astype(float), 1.8):  # 26 neighbours
        if len(near) >= 3 and (mean := distance[near].mean()) > 0:
            ratios.append(distance[near].std() / mean)
    return float(np.mean(ratios))


@kept_until("DEG", per_hold)
def real_map(case: Case) -> VoxelMap:
    return voxel_map(returns(case).local, MAP_VOXEL)


@per_case
def map_distances(case: Case) -> tuple[Int[np.ndarray, "v 3"], Float[np.ndarray, " v"]]:
    """Return voxels and Wasserstein distances between held-out and synthetic map."""
    local = local_at(case, noisy_ranges(case, "first"))
    local = local[np.isfinite(local[:, 0])]
    key, distance = voxel_wasserstein(real_map(case), voxel_map(local, MAP_VOXEL))
    if not len(key):
        raise ValueError("held-out and synthetic map share no voxel")
    return key, distance


@per_hold
def own_consistency(case: Case) -> float:
    """Return the spatial consistency score of the odd held-out points against the even ones."""
    local = returns(case).local
    halves = [voxel_map(local[k::2], MAP_VOXEL) for k in (0, 1)]
    return spatial_consistency(*voxel_wasserstein(*halves))


# Roughness of the wall over half a metre. Medians over patches: a mean depends on the few with an edge.

_PATCH_RADIUS = 0.25  # m; planes of 0.5 m
_PATCH_LEAST = 20  # points on a plane
_PATCH_MOST = 60
_MOST_PATCHES = 1500
_FEWEST_PATCHES = 20
_PATCH_STEP = 0.06  # m; a plane from which a point is further away holds a pocket or an edge
_UPRIGHT = 0.8  # |z| of a normal beyond which a plane is floor or crown
_MEDIAN_ERROR = 1.4826 * 1.2533  # times the median absolute deviation over root n: standard error of a median
_PATCHES_AT_ONCE = 100  # planes, whose pairs of points take 26 MB
_CLOSE_PAIR = 0.05  # m; two returns so near to each other differ by their noise


@dataclass(frozen=True)
class Patches:
    """Smooth pieces of wall in the held-out recording."""

    beam: Int[np.ndarray, "p k"]  # Numbers of the returns on each plane, -1 as padding
    roughness: float  # Variance about the planes, noise taken off, m²; may come out below 0 where there is hardly any
    noise: float  # Variance of the returns along the normals, m²
    resolved: bool  # True where the roughness stands out of its own standard error

    @property
    def planes(self) -> int:
        return len(self.beam)


@per_hold
def hold_patches(case: Case) -> Patches | None:
    """Return the patches of the held-out wall; `None` where its points lie too far apart."""
    points = returns(case).points - np.floor(returns(case).points.mean(axis=0))
    tree = cKDTree(points)
    seeds = case.rng("tri_roughness_ratio").permutation(len(points))[: 4 * _MOST_PATCHES]
    distance, near = tree.query(points[seeds], k=_PATCH_MOST, distance_upper_bound=_PATCH_RADIUS)
    inside = np.isfinite(distance)
    enough = inside.sum(axis=1) >= _PATCH_LEAST
    near, inside = near[enough], inside[enough]
    if not len(near):
        return None
    place = points[np.where(inside, near, 0)]
    normal, away = _patch_planes(place, inside)
    smooth = (np.abs(normal[:, 2]) < _UPRIGHT) & (np.where(inside, np.abs(away), 0.0).max(axis=1) < _PATCH_STEP)
    smooth &= np.cumsum(smooth) <= _MOST_PATCHES
    if smooth.sum() < _FEWEST_PATCHES:
        return None
    near, inside, normal, away = near[smooth], inside[smooth], normal[smooth], away[smooth]
    whole, noise = _patch_variance(away, inside), _return_noise(points[np.where(inside, near, 0)], inside, normal)
    judged = np.isfinite(noise)
    if judged.sum() < _FEWEST_PATCHES:
        return None
    excess = (whole - noise)[judged]
    middle = float(np.median(excess))
    error = _MEDIAN_ERROR * float(np.median(np.abs(excess - middle))) / np.sqrt(len(excess))
    return Patches(np.where(inside, near, -1)[judged], middle, float(np.median(noise[judged])), middle > 2.0 * error)


def lining_roughness(case: Case) -> float:
    """Return the variance of the lining about the same planes, sampled by the same beams, m²; NaN without planes."""
    patches = hold_patches(case)
    if patches is None:
        return float("nan")
    real, beam = returns(case), np.unique(patches.beam[patches.beam >= 0])
    distance = np.full(len(real.range), np.nan)
    origin = real.origin[beam] - weld_offset(case)
    distance[beam] = first_hits(welded_lining(case), origin, real.direction[beam])[1]
    # A beam that meets something else than the wall says nothing about its roughness.
    distance[np.abs(distance - real.range) > 0.5] = np.nan
    reach = np.where(patches.beam >= 0, distance[patches.beam], np.nan)
    inside = np.isfinite(reach)
    full = inside.sum(axis=1) >= _PATCH_LEAST
    patch, inside, reach = patches.beam[full], inside[full], reach[full]
    hit = real.origin[patch] + np.nan_to_num(reach)[..., None] * real.direction[patch]
    return float(np.median(_patch_variance(_patch_planes(hit - hit[:, :1], inside)[1], inside)))


def _patch_planes(points: Float[np.ndarray, "p k 3"], inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal of the plane through each set of points, and their signed distances from it."""
    weight = inside[..., None] / inside.sum(axis=1)[:, None, None]
    centred = np.where(inside[..., None], points - (weight * points).sum(axis=1, keepdims=True), 0.0)
    normal = np.linalg.eigh(np.einsum("pki,pkj->pij", centred, centred))[1][..., 0]
    return normal, np.einsum("pki,pi->pk", centred, normal)


def _patch_variance(away: Float[np.ndarray, "p k"], inside: np.ndarray) -> Float[np.ndarray, " p"]:
    """Return the variance about each plane, three degrees of freedom taken off, m²."""
    return (np.where(inside, away, 0.0) ** 2).sum(axis=1) / (inside.sum(axis=1) - 3)


def _return_noise(
    points: Float[np.ndarray, "p k 3"], inside: np.ndarray, normal: Float[np.ndarray, "p 3"]
) -> Float[np.ndarray, " p"]:
    """Estimates the variance of one return along the normal, from close pairs in the plane, m²; NaN without."""
    points = np.where(inside[..., None], points - points[:, :1], 1e3 * (1.0 + np.arange(points.shape[1]))[:, None])
    parts = [slice(start, start + _PATCHES_AT_ONCE) for start in range(0, len(points), _PATCHES_AT_ONCE)]
    return np.concatenate([_pair_noise(points[part], normal[part]) for part in parts])


def _pair_noise(points: Float[np.ndarray, "p k 3"], normal: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, " p"]:
    gap = points[:, :, None] - points[:, None]
    across = np.einsum("pkli,pi->pkl", gap, normal)
    pair = np.triu(np.sum(gap**2, axis=-1) - across**2 < _CLOSE_PAIR**2, 1)
    with np.errstate(invalid="ignore"):
        return np.sum(pair * across**2, axis=(1, 2)) / (2.0 * pair.sum(axis=(1, 2)))
