"""F3D: free space in three dimensions, unrolled along the reference axis."""

import numpy as np

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import carving
from benchmarks.fidelity.derive.clearances import clearances, headrooms, infringed
from benchmarks.fidelity.derive.grids import air
from benchmarks.fidelity.derive.radii import lining_radii
from benchmarks.fidelity.derive.reference_axis import hold_points, reference_curve
from benchmarks.fidelity.derive.sections import sections
from benchmarks.fidelity.derive.surface import nearest
from benchmarks.fidelity.registry import metric
from benchmarks.fidelity.value import Value, estimate, number

_DEEP = 0.20  # m
_SLACK = 0.05  # m that the table of radii may be off at the edge of a pocket
_CLEAR = 0.20  # m that a sensor keeps from any surface


def mean(values: np.ndarray) -> float:
    """Arithmetic mean."""
    return float(np.mean(values))


def root(squares: np.ndarray) -> float:
    """Root of the mean of squares."""
    return float(np.sqrt(np.mean(squares)))


@metric("free3d_iou", needs="reference")
def free3d_iou(case: Case) -> Value:
    """Intersection over union of free voxels, where the reference knows."""
    both = air(case)
    either = (both.judged | both.reference) & both.known
    station = both.lattice.low[0] + both.lattice.edge * np.nonzero(either)[0]
    return estimate(mean, (both.judged & both.reference)[either].astype(float), station, case.rng("free3d_iou"))


@metric("free3d_volume_rel_err", needs="reference")
def free3d_volume_rel_err(case: Case) -> Value:
    """Relative error of the free volume where the reference knows, %."""
    both = air(case)
    judged, reference = ((side & both.known).sum() for side in (both.judged, both.reference))
    return number(100.0 * abs(judged / max(reference, 1) - 1.0), int(reference))


@metric("free3d_false_free", needs="hold")
def free3d_false_free(case: Case) -> Value:
    """Share of held-out returns deeper than 20 cm in the candidate's air."""
    points, deep = hold_points(case), _DEEP * case.tolerance
    inside = lining_radii(case).depth(points) > deep
    wrong = np.zeros(len(points))
    if inside.any():
        wrong[inside] = nearest(case).query(points[inside])[0] > deep
    station = reference_curve(case).local(points)[:, 0]
    return estimate(mean, wrong, station, case.rng("free3d_false_free"))


@metric("free3d_false_occupied", needs="hold")
def free3d_false_occupied(case: Case) -> Value:
    """Share of the length of held-out beams, up to 20 cm before their returns, that the candidate holds occupied.

    Occupied is what lies 5 cm outside its lining, and what its extra surfaces fill or close off.
    """
    passed, both = carving.carved(case).passed, air(case)
    local = carving.about(case, reference_curve(case))[0]
    outside = lining_radii(case).depth(passed) < -_SLACK
    if len(case.candidate.extra.faces):
        cell, kept = both.lattice.cell(local)
        outside |= kept & both.filled.ravel()[cell]
    # Beyond the ends of the reference a beam still runs in air that nobody reconstructed.
    among = (local[:, 0] > both.lattice.low[0]) & (local[:, 0] < reference_curve(case).station[-1])
    return estimate(mean, outside[among].astype(float), local[among, 0], case.rng("free3d_false_occupied"))


@metric("free3d_esdf_rmse", needs="reference")
def free3d_esdf_rmse(case: Case) -> Value:
    """Root mean square error of the distance to the nearest surface within 1 m of the axis, m."""
    both = clearances(case)
    error = both.judged - both.reference
    station = np.repeat(both.station, error.shape[1])
    return estimate(root, (error**2).ravel(), station, case.rng("free3d_esdf_rmse"))


@metric("free3d_inscribed_err", needs="reference")
def free3d_inscribed_err(case: Case) -> Value:
    """Mean absolute error of the radius of the largest sphere about a place near the axis, m."""
    both = clearances(case)
    error = np.abs(both.judged.max(axis=1) - both.reference.max(axis=1))
    return estimate(mean, error, both.station, case.rng("free3d_inscribed_err"))


@metric("free3d_headroom_rmse", needs="reference")
def free3d_headroom_rmse(case: Case) -> Value:
    """Root mean square error of floor to crown in three lanes, m."""
    station, judged, reference = headrooms(case)
    squares = (judged - reference) ** 2
    return estimate(root, squares.ravel(), np.repeat(station, squares.shape[1]), case.rng("free3d_headroom_rmse"))


@metric("free3d_envelope_agree", needs="reference")
def free3d_envelope_agree(case: Case) -> Value:
    """Share of sections and envelopes in which lining and reference agree whether the envelope is cut into."""
    judged, reference = infringed(case)
    agree = (judged == reference).mean(axis=1)
    return estimate(mean, agree, sections(case).station, case.rng("free3d_envelope_agree"))


@metric("free3d_hold_poses_free", needs="hold")
def free3d_hold_poses_free(case: Case) -> Value:
    """Share of the sensor positions between the reference's mouths that are inside and 20 cm clear of any surface."""
    assert case.hold is not None
    at, curve = case.hold.origin[np.unique(case.hold.scan, return_index=True)[1]], reference_curve(case)
    station = curve.local(at)[:, 0]
    within = (station > curve.station[0]) & (station < curve.station[-1])
    at, station = at[within], station[within]
    free = (lining_radii(case).depth(at) > 0) & (nearest(case).query(at)[0] >= _CLEAR * case.tolerance)
    return estimate(mean, free.astype(float), station, case.rng("free3d_hold_poses_free"))


@metric("free3d_voxel_vs_mesh_vol", needs="reference")
def free3d_voxel_vs_mesh_vol(case: Case) -> Value:
    """Difference between the volume of the voxels inside the lining and that of the solid, %."""
    both, radii = air(case), lining_radii(case)
    inside = both.judged | both.blocked
    share = (both.lattice.shape[0] * both.lattice.edge) / radii.curve.length
    volume = abs(float(case.candidate.solid.volume)) * min(share, 1.0)
    voxels = float(inside.sum()) * both.lattice.edge**3
    return number(100.0 * abs(voxels / volume - 1.0), int(inside.sum()))
