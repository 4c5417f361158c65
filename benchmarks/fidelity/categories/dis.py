"""DIS, distributions: what a sensor measures in the candidate against what it measured."""

import numpy as np
from scipy.stats import ks_2samp, wasserstein_distance

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.beams import noisy, returns
from benchmarks.fidelity.derive.descriptors import directions, scan_descriptors
from benchmarks.fidelity.derive.distances import cloud_tree
from benchmarks.fidelity.derive.mapstats import inconsistency, map_distances, own_inconsistency
from benchmarks.fidelity.derive.noise import (
    Planes,
    chosen,
    mean_entropy,
    real_planes,
    synthetic_planes,
    synthetic_tree,
)  # fmt: skip
from benchmarks.fidelity.derive.silence import silence
from benchmarks.fidelity.registry import metric
from benchmarks.fidelity.value import Value, missing, number

_BIN = np.deg2rad(5.0)
_FEWEST = 50  # beams in a bin that counts
_FOLDS = 5


def _ranges(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Measured and synthetic ranges, m; each with what it has."""
    reach = noisy(case, "first")
    return returns(case).range, reach[np.isfinite(reach)]


@metric("range_ks", needs="hold")
def range_ks(case: Case) -> Value:
    """Kolmogorov-Smirnov statistic of the ranges."""
    real, synthetic = _ranges(case)
    return number(float(ks_2samp(real, synthetic, method="asymp").statistic), len(real))


@metric("range_w1", needs="hold")
def range_w1(case: Case) -> Value:
    """Wasserstein-1 distance of the ranges, m."""
    real, synthetic = _ranges(case)
    return number(float(wasserstein_distance(real, synthetic)), len(real))


@metric("elevation_w1", needs="hold")
def elevation_w1(case: Case) -> Value:
    """Mean over bins of 5° of elevation of the ranges' Wasserstein-1 distance, m."""
    elevation = np.round(directions(case).elevation / _BIN).astype(int)
    distances = [wasserstein_distance(real, synthetic) for real, synthetic in _binned(case, elevation)]
    return number(float(np.mean(distances)), len(elevation))


@metric("azimuth_profile_rmse", needs="hold")
def azimuth_profile_rmse(case: Case) -> Value:
    """RMS over bins of 5° of azimuth of the difference of median ranges, m."""
    azimuth = np.round(directions(case).azimuth / _BIN).astype(int)
    gaps = [np.median(real) - np.median(synthetic) for real, synthetic in _binned(case, azimuth)]
    return number(float(np.sqrt(np.mean(np.square(gaps)))), len(azimuth))


@metric("incidence_w1", needs="hold")
def incidence_w1(case: Case) -> Value:
    """Wasserstein-1 distance of the incidence angles, normals of both clouds by local planes, °."""
    real, synthetic = (_incidence(case, planes) for planes in (real_planes(case), synthetic_planes(case)))
    return number(float(wasserstein_distance(real, synthetic)), len(real))


@metric("dropout_diff", needs="hold")
def dropout_diff(case: Case) -> Value:
    """Difference between the shares of beams without a return."""
    assert case.hold is not None
    if not case.hold.knows_missing:
        return missing("the recording does not hold the beams that came back with nothing")
    found = silence(case)
    return number(abs(float(np.mean(found.silent)) - float(np.mean(found.expected_silent))), len(found.silent))


@metric("noise_sigma_diff", needs="hold")
def noise_sigma_diff(case: Case) -> Value:
    """Difference of the median spread about local planes, m."""
    sigma = [float(np.nanmedian(planes.sigma)) for planes in (real_planes(case), synthetic_planes(case))]
    return number(abs(sigma[0] - sigma[1]), len(chosen(case)))


@metric("awd", needs="hold")
def awd(case: Case) -> Value:
    """Mean Wasserstein distance of the points in voxels of 0.5 m, m."""
    _, distance = map_distances(case)
    return number(float(np.mean(distance)), len(distance))


@metric("scs_diff", needs="hold")
def scs_diff(case: Case) -> Value:
    """Spatial consistency score against the synthetic map less that of two halves of the held-out cloud."""
    key, distance = map_distances(case)
    return number(abs(inconsistency(key, distance) - own_inconsistency(case)), len(distance))


@metric("mme_diff", needs="hold")
def mme_diff(case: Case) -> Value:
    """Difference of the mean map entropies, nat."""
    cloud, tree = synthetic_tree(case)
    return number(abs(mean_entropy(cloud_tree(case), returns(case).points) - mean_entropy(tree, cloud)))


@metric("c2st_auc", needs="hold")
def c2st_auc(case: Case) -> Value:
    """How well a forest tells real from synthetic scans; a scan and its twin are never on both sides of a fold.

    Blocks of neighbouring scans make the folds, since neighbouring scans are nearly the same scan.
    """
    from sklearn.ensemble import RandomForestClassifier
    from sklearn.metrics import roc_auc_score
    from sklearn.model_selection import GroupKFold, cross_val_predict

    real, synthetic, scan = scan_descriptors(case)
    descriptors = np.concatenate([real, synthetic])
    label = np.repeat([0, 1], len(real))
    block = np.tile(scan * _FOLDS // len(scan), 2)
    forest = RandomForestClassifier(100, min_samples_leaf=3, random_state=case.seed)
    guess = cross_val_predict(
        forest, descriptors, label, groups=block, cv=GroupKFold(_FOLDS), method="predict_proba"
    )[:, 1]  # fmt: skip
    return number(float(roc_auc_score(label, guess)), len(label))


def _incidence(case: Case, planes: Planes) -> np.ndarray:
    cosine = np.abs(np.einsum("ij,ij->i", planes.normal, returns(case).direction[chosen(case)]))
    return np.rad2deg(np.arccos(np.minimum(cosine[np.isfinite(cosine)], 1.0)))


def _binned(case: Case, group: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Measured and synthetic ranges by bin, of bins in which both have enough."""
    reach = noisy(case, "first")
    order = np.argsort(group, kind="stable")
    starts = np.flatnonzero(np.diff(group[order])) + 1
    pairs = []
    for rows in np.split(order, starts):
        cast = reach[rows][np.isfinite(reach[rows])]
        if len(rows) >= _FEWEST and len(cast) >= _FEWEST:
            pairs.append((returns(case).range[rows], cast))
    if not pairs:
        raise ValueError("no bin of directions has enough beams")
    return pairs
