"""C2M, CMP and OCC: distances to the surface, completeness, voxel occupancy."""

import numpy as np

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.beams import mouths_on_path, returns, station_bins
from benchmarks.fidelity.derive.clouds import real_planes
from benchmarks.fidelity.derive.distances import (
    BOOTSTRAP_SAMPLES,
    both_apart,
    cloud_distances,
    density_aware_chamfer,
    dilate,
    iou,
    m3c2_distances,
    mean_distance,
    mesh_distances,
    occupied_voxels,
    phantom_cells,
    shell_voxels,
    tolerant_f1,
)
from benchmarks.fidelity.registry import Samples, Value, mean_magnitude, missing, number, percentile, rms
from benchmarks.fidelity.table import LOGGED_UP, D, U, metric

_FEWEST_IN_GROUP = 50  # points of a bin or sector that counts
_FEWEST_RETURNS = 100  # held-out returns of a bin that counts for completeness
_FEWEST_IN_BIN = 200  # held-out returns of a bin that counts for voxels
_FAR = 0.20  # m
_MOUTH_LENGTH = 2.0  # m


# C2M: held-out points to the candidate, without any registration.


@metric("c2m_mean", "C2M", D(0.0105, 0.048), "m", gate=True, needs="hold", of=np.mean)
@metric("c2m_median", "C2M", D(0.0079, 0.1), "m", needs="hold", of=np.median)
@metric("c2m_rmse", "C2M", D(0.014, 0.063), "m", needs="hold", of=rms)
@metric("c2m_p95", "C2M", D(0.029, 0.13), "m", needs="hold", of=percentile(95))
@metric("c2m_p99", "C2M", unit="m", needs="hold", of=percentile(99))
def mesh_distance(case: Case) -> Samples:
    """Statistic of the distance from held-out points to the surface, m."""
    distances = mesh_distances(case)
    return Samples(distances.distance, distances.station, BOOTSTRAP_SAMPLES)


@metric("c2m_within_5cm", "C2M", U(0.83, 0.99776), needs="hold", of=np.mean, args=(0.05,))
@metric("c2m_within_10cm", "C2M", U(0.949, 0.999999), needs="hold", of=np.mean, args=(0.10,))
def mesh_precision(case: Case, within: float) -> Samples:
    """Fraction of held-out points within a distance of the surface; at 10 cm the paper's figure on unseen points."""
    near = mesh_distances(case).distance <= within
    return Samples(near.astype(float), mesh_distances(case).station, BOOTSTRAP_SAMPLES)


@metric("c2m_signed_bias", "C2M", D(0.000154, 0.08), "m", needs="hold", of=mean_magnitude)
def c2m_signed_bias(case: Case) -> Samples:
    """Magnitude of the mean distance, signed by the side of the sensor, m."""
    distances = mesh_distances(case)
    return Samples(distances.signed, distances.station, BOOTSTRAP_SAMPLES)


@metric("c2m_chainage_worst", "C2M", D(0.0109, 0.049), "m", needs="hold")
def c2m_chainage_worst(case: Case) -> Value:
    """Largest mean distance of a bin of about 10 m, m."""
    return _worst_group(mesh_distances(case).distance, station_bins(case, mesh_distances(case).station))


@metric("c2m_sector_worst", "C2M", D(0.0117, 0.054), "m", needs="hold")
def c2m_sector_worst(case: Case) -> Value:
    """Largest mean distance of eight sectors about the axis, m."""
    return _worst_group(mesh_distances(case).distance, mesh_distances(case).sector)


def _worst_group(distance: np.ndarray, group: np.ndarray) -> Value:
    count = np.bincount(group)
    mean = np.bincount(group, distance) / np.maximum(count, 1)
    full = count >= min(_FEWEST_IN_GROUP, count.max())
    return number(float(mean[full].max()), len(distance))


@metric("c2m_noise_ratio", "C2M", D(0.845, 3.9), needs="hold")
def c2m_noise_ratio(case: Case) -> Value:
    """Median distance over the median residual of the held-out points from their own local planes."""
    return number(float(np.median(mesh_distances(case).distance) / np.median(real_planes(case).residual)))


@metric("c2m_fit_hold_gap", "C2M", D(0.005, 0.05), "m", needs="hold")
def c2m_fit_hold_gap(case: Case) -> Value:
    """Mean distance of held-out points less that of the points that the builder read, m; at least 0."""
    if case.fit is None:
        return missing("the recording that the builder read is not at hand")
    gap = float(np.mean(mesh_distances(case).distance)) - mean_distance(case, case.fit)
    return number(max(gap, 0.0), len(mesh_distances(case).distance))


@metric("m3c2_signif_frac", "C2M", D(1e-06, 0.5), needs="hold", of=np.mean)
def m3c2_signif_frac(case: Case) -> Samples:
    """Fraction of core points whose M3C2 distance exceeds its level of detection."""
    distances = m3c2_distances(case)
    return Samples(distances.significant, distances.station, BOOTSTRAP_SAMPLES)


# CMP: completeness both ways, of the surface that held-out beams observed.


def _completeness(case: Case, within: float) -> np.ndarray:
    return (cloud_distances(case)[0] <= within).astype(float)


@metric("comp_10cm", "CMP", U(0.86, 0.999836), needs="hold", of=np.mean, args=(0.10,))
@metric("comp_20cm", "CMP", LOGGED_UP, needs="hold", of=np.mean, args=(0.20,))
def completeness(case: Case, within: float) -> Samples:
    """Fraction of the observed surface with a held-out point within a distance."""
    return Samples(_completeness(case, within), cloud_distances(case)[1], BOOTSTRAP_SAMPLES)


@metric("fscore_5cm", "CMP", LOGGED_UP, needs="hold", args=(0.05,))
@metric("fscore_10cm", "CMP", U(0.927, 0.9999181), gate=True, needs="hold", args=(0.10,))
@metric("fscore_20cm", "CMP", U(0.8, 0.999999), needs="hold", args=(0.20,))
def fscore(case: Case, within: float) -> Value:
    """Harmonic mean of precision and completeness at a distance."""
    precision = float(np.mean(mesh_distances(case).distance <= within))
    recall = float(np.mean(_completeness(case, within)))
    return number(2.0 * precision * recall / max(precision + recall, 1e-12), len(cloud_distances(case)[0]))


@metric("chamfer_l1", "CMP", D(0.0211, 0.25), "m", needs="hold")
def chamfer_l1(case: Case) -> Value:
    """Mean of the two directed mean distances, m."""
    return number(float(np.mean(mesh_distances(case).distance) + np.mean(cloud_distances(case)[0])) / 2.0)


@metric("dcd", "CMP", needs="hold")
def dcd(case: Case) -> Value:
    """Density-aware Chamfer distance between held-out and synthetic cloud."""
    return number(density_aware_chamfer(case))


@metric("hausdorff_p99", "CMP", D(0.07, 1.5), "m", needs="hold")
def hausdorff_p99(case: Case) -> Value:
    """Larger of the two directed 99th percentiles, m."""
    both = mesh_distances(case).distance, cloud_distances(case)[0]
    return number(max(float(np.percentile(d, 99)) for d in both))


@metric("comp_chainage_min", "CMP", U(0.86, 0.999536), needs="hold")
def comp_chainage_min(case: Case) -> Value:
    """Smallest `comp_10cm` of a bin of about 10 m; 0 where there are held-out returns but no candidate."""
    group = station_bins(case, cloud_distances(case)[1])
    total = station_bins(case, returns(case).local[:, 0])
    bin_count = int(total.max()) + 1
    count = np.bincount(group, minlength=bin_count)
    fraction = np.bincount(group, _completeness(case, 0.10), minlength=bin_count) / np.maximum(count, 1)
    judged = np.bincount(total, minlength=bin_count) >= _FEWEST_RETURNS
    return number(float(fraction[judged].min()), len(group))


@metric("extra_surface_frac", "CMP", D(6.32e-05, 0.05), gate=True, needs="hold")
def extra_surface_frac(case: Case) -> Value:
    """Fraction of the observable surface through which held-out beams passed."""
    return number(float(np.mean(phantom_cells(case))), len(phantom_cells(case)))


@metric("missing_surface_frac", "CMP", D(1e-06, 0.1), needs="hold", of=np.mean)
def missing_surface_frac(case: Case) -> Samples:
    """Fraction of held-out points with no surface within 20 cm."""
    far = mesh_distances(case).distance > _FAR
    return Samples(far.astype(float), mesh_distances(case).station, BOOTSTRAP_SAMPLES)


# OCC: voxels of held-out points against the candidate seen by the same beams (the paper's Fig. 3).


@metric("vox_iou_20cm", "OCC", LOGGED_UP, needs="hold")
def vox_iou_20cm(case: Case) -> Value:
    """Intersection over union of occupied voxels of 20 cm."""
    grids = occupied_voxels(case)
    return number(iou(grids.real, grids.first), int(grids.real.sum()))


@metric("vox_iou_norm", "OCC", U(0.934, 0.99511), gate=True, needs="hold")
def vox_iou_norm(case: Case) -> Value:
    """Intersection over union of voxels that tell clouds apart, over what two noisy draws of the candidate reach."""
    real, first, second = occupied_voxels(case).points
    return number(iou(*both_apart(real, first)) / max(iou(*both_apart(first, second)), 1e-12), int(real.sum()))


@metric("vox_precision", "OCC", U(0.951, 0.99356), needs="hold", args=(1,))
@metric("vox_recall", "OCC", U(0.967, 0.999867), needs="hold", args=(0,))
def voxel_share(case: Case, side: int) -> Value:
    """Fraction of the voxels of one side (1 the candidate, 0 the held-out cloud) that the other has too."""
    both = both_apart(*occupied_voxels(case).points[:2])
    own = both[side].sum()
    return number(float((both[0] & both[1]).sum() / max(own, 1)), int(own))


@metric("vox_f1_tol1", "OCC", U(0.8, 0.999999), needs="hold")
def vox_f1_tol1(case: Case) -> Value:
    """F1 with a tolerance of one voxel."""
    grids = occupied_voxels(case)
    return number(float(tolerant_f1(grids, np.zeros(len(grids.station), int))[0]), int(grids.real.sum()))


@metric("vox_kappa", "OCC", U(0.955, 0.99575), needs="hold")
def vox_kappa(case: Case) -> Value:
    """Cohen's kappa over known voxels within 0.6 m of either surface."""
    from sklearn.metrics import cohen_kappa_score

    grids = occupied_voxels(case)
    judged = shell_voxels(grids)
    return number(float(cohen_kappa_score(grids.real[judged], grids.first[judged])), int(judged.sum()))


@metric("vox_interior_mismatch", "OCC", D(1e-06, 0.25), needs="hold")
def vox_interior_mismatch(case: Case) -> Value:
    """Fraction of mismatches farther than one voxel from the other surface and over 2 m from a mouth."""
    grids = occupied_voxels(case)
    far = (grids.real & ~dilate(grids.first)) | (grids.first & ~dilate(grids.real))
    far &= ~_mouth_slices(case)[:, None, None]
    mismatches = int((grids.real ^ grids.first).sum())
    return number(float(far.sum() / max(mismatches, 1)), mismatches)


@metric("vox_mouth_mismatch", "OCC", needs="hold")
def vox_mouth_mismatch(case: Case) -> Value:
    """Fraction of mismatches within 2 m of a mouth."""
    grids = occupied_voxels(case)
    mismatch = grids.real ^ grids.first
    return number(float(mismatch[_mouth_slices(case)].sum() / max(mismatch.sum(), 1)), int(mismatch.sum()))


def _mouth_slices(case: Case) -> np.ndarray:
    """Mark the slices within 2 m of an end of the candidate, or beyond it."""
    low, high = mouths_on_path(case)
    station = occupied_voxels(case).station
    return (station < low + _MOUTH_LENGTH) | (station > high - _MOUTH_LENGTH)


@metric("vox_proj_iou_xy", "OCC", U(0.7, 0.99794), needs="hold", args=(2,))
@metric("vox_proj_iou_xz", "OCC", U(0.7, 0.999816), needs="hold", args=(1,))
@metric("vox_proj_iou_yz", "OCC", U(0.7, 0.9771), needs="hold", args=(0,))
def projected_iou(case: Case, axis: int) -> Value:
    """Intersection over union seen along an axis: 0 the tunnel, 1 from the side, 2 from above."""
    real, first = (grid.sum(axis=axis) for grid in occupied_voxels(case).points[:2])
    return number(iou(*both_apart(real, first)), int(real.sum()))


@metric("vox_chainage_min_f1", "OCC", U(0.5, 0.999999), needs="hold")
def vox_chainage_min_f1(case: Case) -> Value:
    """Smallest tolerant F1 of a bin of about 10 m."""
    grids = occupied_voxels(case)
    total = np.bincount(station_bins(case, returns(case).local[:, 0]))
    score = tolerant_f1(grids, station_bins(case, grids.station))
    judged = np.flatnonzero(total >= _FEWEST_IN_BIN)
    return number(float(score[judged].min()), int(grids.real.sum()))
