"""DEG, degeneracy: whether a scan in the candidate knows its place as well, and as badly, as the real one."""

import numpy as np
from scipy.stats import norm, spearmanr, wasserstein_distance

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.aliasing import real_alias, real_icp, synthetic_alias, synthetic_icp
from benchmarks.fidelity.derive.hessian import Frames, real_frames, synthetic_frames
from benchmarks.fidelity.derive.planarscan import localised
from benchmarks.fidelity.registry import metric
from benchmarks.fidelity.value import Value, estimate, missing, number

CONDITION = 10.0  # a direction this much weaker than the strongest counts as degenerate
SPREAD = 0.05  # of log10 of the axial information from one frame, by the sampling of its normals
LOST = 2.0  # of log10, where the candidate gives a frame next to nothing
_FEWEST = 10  # frames


def _both(case: Case) -> tuple[Frames, Frames]:
    return real_frames(case), synthetic_frames(case)


def _ratio(case: Case, id: str, real: np.ndarray, synthetic: np.ndarray) -> Value:
    log = np.abs(np.log10(synthetic / real))
    log = np.where(np.isfinite(real) & ~np.isfinite(synthetic), LOST, log)
    return estimate(np.median, log, real_frames(case).station, case.rng(id))


@metric("deg_axial_info_logratio", needs="hold")
def deg_axial_info_logratio(case: Case) -> Value:
    """Median over the frames of |log10| of the ratio of axial information."""
    real, synthetic = _both(case)
    return _ratio(case, "deg_axial_info_logratio", real.axial, synthetic.axial)


@metric("deg_cond_logratio", needs="hold")
def deg_cond_logratio(case: Case) -> Value:
    """The same of the condition number of the translation block."""
    conditions = [frames.translation[:, 2] / frames.translation[:, 0] for frames in _both(case)]
    return _ratio(case, "deg_cond_logratio", *conditions)


@metric("deg_weak_angle_diff", needs="hold")
def deg_weak_angle_diff(case: Case) -> Value:
    """Median angle between the weakest directions of translation, °."""
    real, synthetic = _both(case)
    cosine = np.abs(np.einsum("ij,ij->i", real.weakest, synthetic.weakest))
    angle = np.rad2deg(np.arccos(np.minimum(np.nan_to_num(cosine), 1.0)))
    return estimate(np.median, angle, real.station, case.rng("deg_weak_angle_diff"))


@metric("deg_rot_info_logratio", needs="hold")
def deg_rot_info_logratio(case: Case) -> Value:
    """Median of |log10| of the ratio of the information about the weakest rotation."""
    real, synthetic = _both(case)
    return _ratio(case, "deg_rot_info_logratio", real.rotation, synthetic.rotation)


@metric("deg_eig_w1", needs="hold")
def deg_eig_w1(case: Case) -> Value:
    """Wasserstein-1 distance of the distributions of log10 of the smallest eigenvalue."""
    smallest = [np.log10(frames.translation[:, 0]) for frames in _both(case)]
    real, synthetic = (values[np.isfinite(values)] for values in smallest)
    return number(float(wasserstein_distance(real, synthetic)), len(real))


@metric("deg_profile_corr", needs="hold")
def deg_profile_corr(case: Case) -> Value:
    """Spearman correlation along the tunnel of the axial information."""
    real, synthetic = _axial(case)
    return number(float(spearmanr(real, synthetic).statistic), len(real))


@metric("deg_class_kappa", needs="hold")
def deg_class_kappa(case: Case) -> Value:
    """Cohen's kappa of the frames' classes, poor, middling or rich in axial information.

    The classes are the real frames' thirds: X-ICP's fixed cuts put all frames of one tunnel into one class, where
    agreement means nothing. They are ordered, so that being one class off counts half (linear weights).
    """
    from sklearn.metrics import cohen_kappa_score

    real, synthetic = _axial(case)
    cuts = np.quantile(real, [1 / 3, 2 / 3])
    classes = [np.searchsorted(cuts, values, side="right") for values in (real, synthetic)]
    return number(float(cohen_kappa_score(*classes, weights="linear")), len(real))


@metric("deg_landmark_diff", needs="hold")
def deg_landmark_diff(case: Case) -> Value:
    """Difference in stations per 100 m at which the axis is not degenerate.

    A frame near the cut counts by the probability that it lies beyond it.
    """
    counts = []
    for frames in _both(case):
        known = np.isfinite(frames.axial)
        excess = np.log10(CONDITION * frames.axial[known] / frames.translation[known, 2])
        counts.append(100.0 * float(norm.cdf(excess / SPREAD).sum()) / len(known))
    return number(abs(counts[0] - counts[1]), len(real_frames(case).axial))


@metric("deg_alias_diff", needs="hold")
def deg_alias_diff(case: Case) -> Value:
    """Difference of the median alias ratios."""
    real, synthetic = real_alias(case), synthetic_alias(case)
    return number(abs(float(np.median(real)) - float(np.median(synthetic))), len(real))


@metric("deg_icp_axial_logratio", needs="hold")
def deg_icp_axial_logratio(case: Case) -> Value:
    """|log10| of the ratio of median axial errors of scan-to-scan registration."""
    real, synthetic = real_icp(case), synthetic_icp(case)
    if not len(real):
        return missing("no two scans with enough returns")
    return number(abs(float(np.log10(np.median(synthetic) / np.median(real)))), len(real))


@metric("deg_planar_axial_info")
def deg_planar_axial_info(case: Case) -> Value:
    """Share of stations at which the environment's planar scan alone fixes the place along the tunnel."""
    return number(float(np.mean(localised(case))), len(localised(case)))


def _axial(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Axial information of the frames, real and synthetic; a frame that the candidate does not return counts as none.

    Raises:
        ValueError: Too few frames.
    """
    real, synthetic = _both(case)
    known = np.isfinite(real.axial)
    if known.sum() < _FEWEST:
        raise ValueError(f"{known.sum()} frames are too few; {_FEWEST} are needed")
    return real.axial[known], np.nan_to_num(synthetic.axial[known])
