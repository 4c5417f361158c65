"""OCC, voxel occupancy: held-out points against the candidate seen by the same beams (the paper's Fig. 3)."""

import numpy as np

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.beams import returns
from benchmarks.fidelity.derive.extent import bins
from benchmarks.fidelity.derive.path import mouths
from benchmarks.fidelity.derive.voxels import dilated, iou, occupied, shell, tolerant
from benchmarks.fidelity.registry import metric
from benchmarks.fidelity.value import Value, number

_MOUTH = 2.0  # m
_FEWEST = 200  # returns in a bin that counts


def _projected(case: Case, axis: int) -> Value:
    grids = occupied(case)
    return number(iou(*(np.asarray(grid.any(axis=axis)) for grid in (grids.real, grids.first))), int(grids.real.sum()))


def _at_mouth(case: Case) -> np.ndarray:
    """Which slices lie within 2 m of an end of the candidate, or beyond it."""
    low, high = mouths(case)
    station = occupied(case).station
    return (station < low + _MOUTH) | (station > high - _MOUTH)


@metric("vox_iou_20cm", needs="hold")
def vox_iou_20cm(case: Case) -> Value:
    """IoU of occupied voxels of 20 cm."""
    grids = occupied(case)
    return number(iou(grids.real, grids.first), int(grids.real.sum()))


@metric("vox_iou_norm", needs="hold")
def vox_iou_norm(case: Case) -> Value:
    """The same over the IoU of two noisy draws of the candidate alone."""
    grids = occupied(case)
    return number(iou(grids.real, grids.first) / max(iou(grids.first, grids.second), 1e-12), int(grids.real.sum()))


@metric("vox_precision", needs="hold")
def vox_precision(case: Case) -> Value:
    """Share of the candidate's voxels that the held-out cloud has too."""
    grids = occupied(case)
    return number(float((grids.real & grids.first).sum() / max(grids.first.sum(), 1)), int(grids.first.sum()))


@metric("vox_recall", needs="hold")
def vox_recall(case: Case) -> Value:
    """Share of the held-out cloud's voxels that the candidate has too."""
    grids = occupied(case)
    return number(float((grids.real & grids.first).sum() / max(grids.real.sum(), 1)), int(grids.real.sum()))


@metric("vox_f1_tol1", needs="hold")
def vox_f1_tol1(case: Case) -> Value:
    """F1 with a tolerance of one voxel."""
    grids = occupied(case)
    return number(float(tolerant(grids, np.zeros(len(grids.station), int))[0]), int(grids.real.sum()))


@metric("vox_kappa", needs="hold")
def vox_kappa(case: Case) -> Value:
    """Cohen's kappa over known voxels within 0.6 m of either surface."""
    from sklearn.metrics import cohen_kappa_score

    grids = occupied(case)
    judged = shell(grids)
    return number(float(cohen_kappa_score(grids.real[judged], grids.first[judged])), int(judged.sum()))


@metric("vox_interior_mismatch", needs="hold")
def vox_interior_mismatch(case: Case) -> Value:
    """Share of mismatches farther than one voxel from the other surface and over 2 m from a mouth."""
    grids = occupied(case)
    far = (grids.real & ~dilated(grids.first)) | (grids.first & ~dilated(grids.real))
    far &= ~_at_mouth(case)[:, None, None]
    mismatches = int((grids.real ^ grids.first).sum())
    return number(float(far.sum() / max(mismatches, 1)), mismatches)


@metric("vox_mouth_mismatch", needs="hold")
def vox_mouth_mismatch(case: Case) -> Value:
    """Share of mismatches within 2 m of a mouth."""
    grids = occupied(case)
    mismatch = grids.real ^ grids.first
    return number(float(mismatch[_at_mouth(case)].sum() / max(mismatch.sum(), 1)), int(mismatch.sum()))


@metric("vox_proj_iou_xy", needs="hold")
def vox_proj_iou_xy(case: Case) -> Value:
    """IoU seen from above."""
    return _projected(case, 2)


@metric("vox_proj_iou_xz", needs="hold")
def vox_proj_iou_xz(case: Case) -> Value:
    """IoU seen from the side."""
    return _projected(case, 1)


@metric("vox_proj_iou_yz", needs="hold")
def vox_proj_iou_yz(case: Case) -> Value:
    """IoU seen along the tunnel."""
    return _projected(case, 0)


@metric("vox_chainage_min_f1", needs="hold")
def vox_chainage_min_f1(case: Case) -> Value:
    """Smallest tolerant F1 of a bin of about 10 m."""
    grids = occupied(case)
    total = np.bincount(bins(case, returns(case).local[:, 0]))
    group = bins(case, grids.station)
    score = tolerant(grids, group)
    judged = np.flatnonzero(total >= _FEWEST)
    return number(float(score[judged].min()), int(grids.real.sum()))
