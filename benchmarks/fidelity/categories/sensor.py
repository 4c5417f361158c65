"""BEA, DIS and DEG: paired beams, distributions, degeneracy."""

import numpy as np
from scipy.stats import ks_2samp, norm, spearmanr, trim_mean, wasserstein_distance

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import clouds, degeneracy
from benchmarks.fidelity.derive.beams import (
    beam_directions,
    cast_beams,
    cloud_tree,
    noisy_ranges,
    returns,
    scan_descriptors,
    silence,
)
from benchmarks.fidelity.derive.distances import BOOTSTRAP_SAMPLES, self_cast
from benchmarks.fidelity.registry import Samples, Value, mean_magnitude, missing, number, percentile
from benchmarks.fidelity.table import LOGGED_UP, D, U, metric

_FAR = 0.20  # m
_DIRECTION_BIN = np.deg2rad(5.0)
_FEWEST_BEAMS = 50  # beams in a bin that counts
_BESIDE_THE_MIDDLE = 0.4  # of the ranges of a bin, left out at either end
_FOLDS = 5
_NO_SILENCE = "the recording does not hold the beams that came back with nothing"
_CIRCULAR = "by construction: noise about the same mesh, whatever the mesh"
CONDITION = 10.0  # ratio to the strongest direction from which on a direction is degenerate
SPREAD = 0.05  # of log10 of the axial information of one scan, by the sampling of its normals
LOST = 2.0  # of log10, where the candidate gives a scan next to nothing
_FEWEST_FRAMES = 10


# BEA: recorded held-out beams, cast one by one in the candidate.


def _range_error(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Range differences of beams that meet the candidate, and their stations; others count in `beam_late_frac`."""
    hit = cast_beams(case).hit
    return cast_beams(case).difference[hit], returns(case).local[hit, 0]


@metric("beam_range_mae", "BEA", D(0.0157, 0.072), "m", gate=True, needs="hold", of=np.mean)
@metric("beam_range_medae", "BEA", D(0.0132, 0.06), "m", needs="hold", of=np.median)
@metric("beam_range_p95", "BEA", D(0.0385, 0.2), "m", needs="hold", of=percentile(95))
def range_error(case: Case) -> Samples:
    """Statistic of the absolute range difference, m."""
    error, station = _range_error(case)
    return Samples(np.abs(error), station, BOOTSTRAP_SAMPLES)


@metric("beam_range_bias", "BEA", D(4.57e-05, 0.1), "m", needs="hold", of=mean_magnitude)
def beam_range_bias(case: Case) -> Samples:
    """Magnitude of the mean range difference, m."""
    error, station = _range_error(case)
    return Samples(error, station, BOOTSTRAP_SAMPLES)


@metric("beam_rel_medae", "BEA", D(0.298, 1.3), "%", needs="hold", of=np.median)
def beam_rel_medae(case: Case) -> Samples:
    """Median absolute range difference as a fraction of the range, %."""
    error, station = _range_error(case)
    return Samples(100.0 * np.abs(error) / returns(case).range[cast_beams(case).hit], station, BOOTSTRAP_SAMPLES)


@metric("beam_within_10cm", "BEA", U(0.85, 0.999754), needs="hold", of=np.mean)
def beam_within_10cm(case: Case) -> Samples:
    """Fraction of the returns that the candidate gives within 10 cm; a beam that leaves it is not within."""
    return _beam_share(case, np.abs(cast_beams(case).difference) <= 0.10)


@metric("beam_early_frac", "BEA", D(6.93e-05, 0.03), needs="hold", of=np.mean)
def beam_early_frac(case: Case) -> Samples:
    """Fraction of the returns in front of which, by more than 20 cm, the candidate stands."""
    return _beam_share(case, cast_beams(case).difference < -_FAR)


@metric("beam_late_frac", "BEA", D(7.94e-05, 0.05), needs="hold", of=np.mean)
def beam_late_frac(case: Case) -> Samples:
    """Fraction of the returns that the candidate gives more than 20 cm later, or not at all."""
    return _beam_share(case, cast_beams(case).difference > _FAR)


def _beam_share(case: Case, marked: np.ndarray) -> Samples:
    return Samples(marked.astype(float), returns(case).local[:, 0], BOOTSTRAP_SAMPLES)


@metric("beam_return_bacc", "BEA", U(0.85, 0.99223), needs="hold")
def beam_return_bacc(case: Case) -> Value:
    """Balanced accuracy of the prediction whether a beam comes back."""
    assert case.hold is not None
    if not case.hold.knows_missing:
        return missing(_NO_SILENCE)
    silent, expected = silence(case)
    if not silent.any() or silent.all():
        return missing("all beams of the recording came back, or none")
    return number(float(np.mean([np.mean(expected[silent]), np.mean(~expected[~silent])])), len(silent))


@metric("selfcast_p2s_mean", "BEA", unit="m", needs="hold", evidence="C")
def selfcast_p2s_mean(case: Case) -> Value:
    """The paper's headline: mean distance of a cloud cast in the mesh to that mesh, m."""
    return number(float(np.mean(self_cast(case)[0])), len(self_cast(case)[0]), _CIRCULAR)


@metric("selfcast_within_10cm", "BEA", LOGGED_UP, needs="hold", evidence="C")
def selfcast_within_10cm(case: Case) -> Value:
    """The paper's headline: fraction of that cloud within 10 cm."""
    near = self_cast(case)[0] <= 0.10
    return number(float(np.mean(near)), len(near), _CIRCULAR)


@metric("selfcast_noise_ratio", "BEA", needs="hold", evidence="C")
def selfcast_noise_ratio(case: Case) -> Value:
    """That mean over the mean that noise alone gives on a plane; 1: only noise was measured."""
    distance, noise_alone = self_cast(case)
    return number(float(np.mean(distance) / noise_alone), len(distance), _CIRCULAR)


# DIS: the distributions that a sensor measures in the candidate against those of the recording.


def _both_ranges(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Measured ranges, and the synthetic ones that are finite, m."""
    reach = noisy_ranges(case, "first")
    return returns(case).range, reach[np.isfinite(reach)]


@metric("range_ks", "DIS", D(0.00115, 0.1), needs="hold")
def range_ks(case: Case) -> Value:
    """Kolmogorov-Smirnov statistic of the ranges."""
    real, synthetic = _both_ranges(case)
    return number(float(ks_2samp(real, synthetic, method="asymp").statistic), len(real))


@metric("range_w1", "DIS", D(0.00144, 0.25), "m", gate=True, needs="hold")
def range_w1(case: Case) -> Value:
    """Wasserstein-1 distance of the ranges, m."""
    real, synthetic = _both_ranges(case)
    return number(float(wasserstein_distance(real, synthetic)), len(real))


@metric("elevation_w1", "DIS", D(0.00534, 1), "m", needs="hold")
def elevation_w1(case: Case) -> Value:
    """Mean over bins of 5° of elevation of the ranges' Wasserstein-1 distance, m."""
    elevation = np.round(beam_directions(case)[1] / _DIRECTION_BIN).astype(int)
    distances = [wasserstein_distance(real, synthetic) for real, synthetic in _ranges_by_bin(case, elevation)]
    return number(float(np.mean(distances)), len(elevation))


@metric("azimuth_profile_rmse", "DIS", D(0.00191, 0.039), "m", needs="hold")
def azimuth_profile_rmse(case: Case) -> Value:
    """Root mean square over bins of 5° of azimuth of the difference of middle ranges, m."""
    azimuth = np.round(beam_directions(case)[0] / _DIRECTION_BIN).astype(int)
    gaps = [middle_range(real) - middle_range(synthetic) for real, synthetic in _ranges_by_bin(case, azimuth)]
    return number(float(np.sqrt(np.mean(np.square(gaps)))), len(azimuth))


def middle_range(ranges: np.ndarray) -> float:
    """Return the mean of the middle fifth of some ranges, m.

    Along the bore the rings of a scanner leave gaps between the ranges of a bin. A median jumps over such a gap when
    half of the beams are left out, or with other noise; the mean about it does not.
    """
    return float(trim_mean(ranges, _BESIDE_THE_MIDDLE))


def _ranges_by_bin(case: Case, group: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Measured and synthetic ranges by bin, of bins in which both have enough."""
    reach = noisy_ranges(case, "first")
    order = np.argsort(group, kind="stable")
    starts = np.flatnonzero(np.diff(group[order])) + 1
    pairs = []
    for rows in np.split(order, starts):
        cast = reach[rows][np.isfinite(reach[rows])]
        if len(rows) >= _FEWEST_BEAMS and len(cast) >= _FEWEST_BEAMS:
            pairs.append((returns(case).range[rows], cast))
    if not pairs:
        raise ValueError("no bin of directions has enough beams")
    return pairs


@metric("incidence_w1", "DIS", D(0.341, 12), "deg", needs="hold")
def incidence_w1(case: Case) -> Value:
    """Wasserstein-1 distance of the incidence angles, normals of both clouds by local planes, degrees."""
    angles, direction = [], returns(case).direction[clouds.plane_rows(case)]
    for planes in (clouds.real_planes(case), clouds.synthetic_planes(case)):
        cosine = np.abs(np.einsum("ij,ij->i", planes.normal, direction))
        angles.append(np.rad2deg(np.arccos(np.minimum(cosine[np.isfinite(cosine)], 1.0))))
    return number(float(wasserstein_distance(*angles)), len(angles[0]))


@metric("dropout_diff", "DIS", D(0.00356, 0.1), needs="hold")
def dropout_diff(case: Case) -> Value:
    """Difference between the fractions of beams without a return."""
    assert case.hold is not None
    if not case.hold.knows_missing:
        return missing(_NO_SILENCE)
    silent, expected = silence(case)
    return number(abs(float(np.mean(silent)) - float(np.mean(expected))), len(silent))


@metric("noise_sigma_diff", "DIS", D(0.0068, 0.03), "m", needs="hold")
def noise_sigma_diff(case: Case) -> Value:
    """Difference of the median spread about local planes, m."""
    sigma = [float(np.nanmedian(planes.sigma)) for planes in (clouds.real_planes(case), clouds.synthetic_planes(case))]
    return number(abs(sigma[0] - sigma[1]), len(clouds.plane_rows(case)))


@metric("awd", "DIS", D(0.028, 0.4), "m", needs="hold")
def awd(case: Case) -> Value:
    """Mean Wasserstein distance of the points in voxels of 0.5 m, m."""
    _, distance = clouds.map_distances(case)
    return number(float(np.mean(distance)), len(distance))


@metric("scs_diff", "DIS", needs="hold")
def scs_diff(case: Case) -> Value:
    """Spatial consistency score against the synthetic map less that of two halves of the held-out cloud."""
    key, distance = clouds.map_distances(case)
    return number(abs(clouds.spatial_consistency(key, distance) - clouds.own_consistency(case)), len(distance))


@metric("mme_diff", "DIS", D(0.325, 2), "nat", needs="hold")
def mme_diff(case: Case) -> Value:
    """Difference of the mean map entropies, nat."""
    cloud, tree = clouds.synthetic_tree(case)
    return number(abs(clouds.mean_entropy(cloud_tree(case), returns(case).points) - clouds.mean_entropy(tree, cloud)))


@metric("c2st_auc", "DIS", D(0.505, 0.95), needs="hold")
def c2st_auc(case: Case) -> Value:
    """Area under the curve of a forest that separates real from synthetic scans; 0.5: it cannot.

    A scan and its twin are never on both sides of a fold. Blocks of neighbouring scans make the folds, since
    neighbouring scans are nearly the same scan.
    """
    from sklearn.ensemble import RandomForestClassifier
    from sklearn.metrics import roc_auc_score
    from sklearn.model_selection import GroupKFold, cross_val_predict

    real, synthetic, scan = scan_descriptors(case)
    descriptors = np.concatenate([real, synthetic])
    label = np.repeat([0, 1], len(real))
    block = np.tile(scan * _FOLDS // len(scan), 2)
    forest = RandomForestClassifier(100, min_samples_leaf=3, random_state=case.seed)
    folds = GroupKFold(_FOLDS)
    guess = cross_val_predict(forest, descriptors, label, groups=block, cv=folds, method="predict_proba")
    return number(float(roc_auc_score(label, guess[:, 1])), len(label))


# DEG: whether a scan in the candidate fixes its own pose as well, and as badly, as the recorded one.


def _both_information(case: Case) -> tuple[degeneracy.ScanInformation, degeneracy.ScanInformation]:
    return degeneracy.information(case, True), degeneracy.information(case, False)


@metric("deg_axial_info_logratio", "DEG", D(0.0543, 1), gate=True, needs="hold", of=np.median,
        args=(lambda scans: scans.axial,))  # fmt: skip
@metric("deg_cond_logratio", "DEG", D(0.0823, 1), needs="hold", of=np.median,
        args=(lambda scans: scans.translation[:, 2] / scans.translation[:, 0],))  # fmt: skip
@metric("deg_rot_info_logratio", "DEG", D(0.00253, 0.14), needs="hold", of=np.median,
        args=(lambda scans: scans.rotation,))  # fmt: skip
def information_logratio(case: Case, quantity) -> Samples:
    """Median over the scans of |log10| of the ratio of an information, synthetic over real."""
    real, synthetic = (quantity(scans) for scans in _both_information(case))
    log = np.abs(np.log10(synthetic / real))
    log = np.where(np.isfinite(real) & ~np.isfinite(synthetic), LOST, log)
    return Samples(log, degeneracy.information(case, True).station)


@metric("deg_weak_angle_diff", "DEG", D(0.083, 25), "deg", needs="hold", of=np.median)
def deg_weak_angle_diff(case: Case) -> Samples:
    """Median angle between the weakest directions of translation, degrees."""
    real, synthetic = _both_information(case)
    cosine = np.abs(np.einsum("ij,ij->i", real.weakest, synthetic.weakest))
    angle = np.rad2deg(np.arccos(np.minimum(np.nan_to_num(cosine), 1.0)))
    return Samples(angle, real.station)


@metric("deg_eig_w1", "DEG", D(0.0783, 0.8), needs="hold")
def deg_eig_w1(case: Case) -> Value:
    """Wasserstein-1 distance of the distributions of log10 of the smallest eigenvalue."""
    smallest = (np.log10(scans.translation[:, 0]) for scans in _both_information(case))
    real, synthetic = (values[np.isfinite(values)] for values in smallest)
    return number(float(wasserstein_distance(real, synthetic)), len(real))


@metric("deg_profile_corr", "DEG", U(0.2, 0.8), needs="hold")
def deg_profile_corr(case: Case) -> Value:
    """Spearman correlation along the tunnel of the axial information."""
    real, synthetic = _axial_pairs(case)
    return number(float(spearmanr(real, synthetic).statistic), len(real))


@metric("deg_class_kappa", "DEG", LOGGED_UP, needs="hold")
def deg_class_kappa(case: Case) -> Value:
    """Cohen's kappa of the scans' classes: poor, middling or rich in axial information.

    The classes are the real scans' thirds: X-ICP's fixed cuts put all scans of one tunnel into one class, where
    agreement means nothing. They are ordered, so that being one class off counts half (linear weights).
    """
    from sklearn.metrics import cohen_kappa_score

    real, synthetic = _axial_pairs(case)
    cuts = np.quantile(real, [1 / 3, 2 / 3])
    classes = [np.searchsorted(cuts, values, side="right") for values in (real, synthetic)]
    return number(float(cohen_kappa_score(*classes, weights="linear")), len(real))


def _axial_pairs(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Axial information of the scans, real and synthetic; 0 where the candidate returns too little of a scan."""
    real, synthetic = _both_information(case)
    known = np.isfinite(real.axial)
    if known.sum() < _FEWEST_FRAMES:
        raise ValueError(f"{known.sum()} frames are too few; {_FEWEST_FRAMES} are needed")
    return real.axial[known], np.nan_to_num(synthetic.axial[known])


@metric("deg_landmark_diff", "DEG", D(1e-06, 8), "1/100 scans", gate=True, needs="hold")
def deg_landmark_diff(case: Case) -> Value:
    """Difference in stations per 100 scans at which the axis is not degenerate.

    A scan near the cut counts by the probability that it lies beyond it.
    """
    counts = []
    for scans in _both_information(case):
        known = np.isfinite(scans.axial)
        excess = np.log10(CONDITION * scans.axial[known] / scans.translation[known, 2])
        counts.append(100.0 * float(norm.cdf(excess / SPREAD).sum()) / len(known))
    return number(abs(counts[0] - counts[1]), len(degeneracy.information(case, True).axial))


@metric("deg_alias_diff", "DEG", D(0.105, 0.6), needs="hold")
def deg_alias_diff(case: Case) -> Value:
    """Difference of the median alias ratios."""
    real, synthetic = degeneracy.alias_ratios(case, True), degeneracy.alias_ratios(case, False)
    return number(abs(float(np.median(real)) - float(np.median(synthetic))), len(real))


@metric("deg_icp_axial_logratio", "DEG", needs="hold")
def deg_icp_axial_logratio(case: Case) -> Value:
    """|log10| of the ratio of median axial errors of scan-to-scan registration."""
    real, synthetic = degeneracy.icp_errors(case, True), degeneracy.icp_errors(case, False)
    if not len(real):
        return missing("no two scans with enough returns")
    return number(abs(float(np.log10(np.median(synthetic) / np.median(real)))), len(real))


@metric("deg_planar_axial_info", "DEG")
def deg_planar_axial_info(case: Case) -> Value:
    """Fraction of stations at which the environment's planar scan alone fixes the station."""
    return number(float(np.mean(degeneracy.localised_stations(case))), len(degeneracy.localised_stations(case)))
