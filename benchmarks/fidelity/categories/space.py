"""F2D, F3D and NAV: free space and routes through it."""

import numpy as np
from scipy.ndimage import binary_erosion
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import freespace, plane
from benchmarks.fidelity.derive.axis import hold_points, reference_curve
from benchmarks.fidelity.derive.ground import (
    ROBOT_RADIUS,
    Route,
    blocked_metres,
    both_grounds,
    both_routes,
    draw_trips,
    feasible_trips,
    judged_route,
)
from benchmarks.fidelity.derive.sections import lining_radii, sections
from benchmarks.fidelity.derive.surface import surface_nearest
from benchmarks.fidelity.registry import Samples, Value, mean, missing, number, pass_or_fail, percentile, rms
from benchmarks.fidelity.table import B, D, P, U, metric

_EDGE_NEAR = 0.10  # m between two edges that agree
_WIDEST = 20.0  # m in place of an open side
_DEEP_RETURN = 0.20  # m
_RADII_SLACK = 0.05  # m; error of the table of radii at the edge of a pocket
_SENSOR_CLEARANCE = 0.20  # m that a sensor keeps from any surface
_NO_WAY = "the candidate has no way from mouth to mouth"
_NO_REFERENCE = "the reference shows no way from mouth to mouth"


# F2D: free space in the plane of the sensor.


def _agreement(case: Case, among: np.ndarray, both: np.ndarray) -> Samples:
    """Fraction of the cells `among` that are free in `both`, where the reference is known."""
    picked = among & plane.free_plane(case).known
    station = np.broadcast_to(plane.free_plane(case).station[:, None], picked.shape)[picked]
    return Samples(both[picked].astype(float), station)


@metric("occ2d_free_iou", "F2D", U(0.85, 0.99624), gate=True, needs="reference", of=mean)
def occ2d_free_iou(case: Case) -> Samples:
    """Intersection over union of the free cells, where the reference is known."""
    judged, reference = plane.free_plane(case).judged, plane.free_plane(case).reference
    return _agreement(case, judged | reference, judged & reference)


@metric("occ2d_free_precision", "F2D", U(0.9, 0.999462), needs="reference", of=mean)
def occ2d_free_precision(case: Case) -> Samples:
    """Fraction of the candidate's free cells that are free in the reference."""
    return _agreement(case, plane.free_plane(case).judged, plane.free_plane(case).reference)


@metric("occ2d_free_recall", "F2D", U(0.9, 0.99678), needs="reference", of=mean)
def occ2d_free_recall(case: Case) -> Samples:
    """Fraction of the reference's free cells that are free in the candidate."""
    return _agreement(case, plane.free_plane(case).reference, plane.free_plane(case).judged)


@metric("occ2d_boundary_f1", "F2D", U(0.5, 0.999999), needs="reference")
def occ2d_boundary_f1(case: Case) -> Value:
    """F1 of the edges of free space, matched within 10 cm."""
    judged, reference = (  # the free cells beside cells that are not free; the mouths are open
        free & ~binary_erosion(np.pad(free, ((1, 1), (0, 0)), mode="edge"))[1:-1]
        for free in plane.gapless_maps(case)[:2]
    )
    edge, reach = plane.free_plane(case).lattice.edge, _EDGE_NEAR + 1e-9
    precision = mean(plane.cell_distances(judged, reference, edge) <= reach)
    recall = mean(plane.cell_distances(reference, judged, edge) <= reach)
    return number(2 * precision * recall / max(precision + recall, 1e-12), int(judged.sum() + reference.sum()))


@metric("free2d_area_rel_err", "F2D", D(0.269, 8), "%", needs="reference")
def free2d_area_rel_err(case: Case) -> Value:
    """Relative error of the free area, %."""
    judged, reference, _ = plane.gapless_maps(case)
    return number(100.0 * abs(judged.sum() / max(reference.sum(), 1) - 1.0), int(reference.sum()))


@metric("free2d_width_mae", "F2D", D(1e-06, 0.055), "m", needs="reference", of=mean)
def free2d_width_mae(case: Case) -> Samples:
    """Mean absolute error of the free width, m; an open side counts as 20 m."""
    station, judged, reference = plane.free_widths(case)
    return Samples(np.abs(np.minimum(judged, _WIDEST) - np.minimum(reference, _WIDEST)), station)


@metric("free2d_width_min_err", "F2D", D(1e-06, 0.12), "m", needs="reference")
def free2d_width_min_err(case: Case) -> Value:
    """Absolute error of the narrowest width, m."""
    _, judged, reference = plane.free_widths(case)
    return number(abs(float(np.min(judged)) - float(np.min(reference))), len(judged))


@metric("free2d_edt_rmse", "F2D", D(0.0302, 0.14), "m", needs="reference", of=rms)
def free2d_edt_rmse(case: Case) -> Samples:
    """Root mean square error of the distance to the edge of free space, where either is free, m."""
    judged, reference, rows = plane.gapless_maps(case)
    picked = judged | reference
    edge, clear = plane.free_plane(case).lattice.edge, []
    for free in (judged, reference):
        away = plane.cell_distances(np.ones_like(free), ~free, edge) if free.any() else np.zeros(free.shape)
        clear.append(away.reshape(free.shape))
    return Samples((clear[0] - clear[1])[picked], np.broadcast_to(rows[:, None], picked.shape)[picked])


@metric("free2d_skeleton_p95", "F2D", D(0.101, 0.6), "m", needs="reference")
def free2d_skeleton_p95(case: Case) -> Value:
    """95th percentile of the distance between the medial axes, both ways, m."""
    judged, reference = (plane.medial_axis(free) for free in plane.gapless_maps(case)[:2])
    edge = plane.free_plane(case).lattice.edge
    apart = [plane.cell_distances(judged, reference, edge), plane.cell_distances(reference, judged, edge)]
    return number(float(np.percentile(np.concatenate(apart), 95)), sum(map(len, apart)))


@metric("occ2d_unknown_frac", "F2D", needs="hold")
def occ2d_unknown_frac(case: Case) -> Value:
    """Fraction of the candidate's free cells that no held-out beam shows."""
    return number(plane.unknown_share(case), int(plane.free_plane(case).judged.sum()))


# F3D: free space in three dimensions, along the reference axis.


@metric("free3d_iou", "F3D", U(0.85, 0.998), gate=True, needs="reference", of=mean)
def free3d_iou(case: Case) -> Samples:
    """Intersection over union of free voxels, where the reference is known."""
    both = freespace.air_voxels(case)
    either = (both.judged | both.reference) & both.known
    station = both.lattice.low[0] + both.lattice.edge * np.nonzero(either)[0]
    return Samples((both.judged & both.reference)[either].astype(float), station)


@metric("free3d_volume_rel_err", "F3D", D(0.0161, 8), "%", needs="reference")
def free3d_volume_rel_err(case: Case) -> Value:
    """Relative error of the free volume, where the reference is known, %."""
    both = freespace.air_voxels(case)
    judged, reference = ((side & both.known).sum() for side in (both.judged, both.reference))
    return number(100.0 * abs(judged / max(reference, 1) - 1.0), int(reference))


@metric("free3d_false_free", "F3D", D(1e-06, 0.05), needs="hold", of=mean)
def free3d_false_free(case: Case) -> Samples:
    """Fraction of held-out returns deeper than 20 cm in the candidate's air."""
    points, deep = hold_points(case), _DEEP_RETURN
    inside = lining_radii(case).depth(points) > deep
    wrong = np.zeros(len(points))
    if inside.any():
        wrong[inside] = surface_nearest(case).query(points[inside])[0] > deep
    return Samples(wrong, reference_curve(case).local(points)[:, 0])


@metric("free3d_false_occupied", "F3D", D(1e-06, 0.05), needs="hold", of=mean)
def free3d_false_occupied(case: Case) -> Samples:
    """Fraction of the length of held-out beams, up to 20 cm before their returns, that the candidate holds occupied.

    Occupied is whatever lies 5 cm outside its lining, and what its extra surfaces fill or close off.
    """
    passed, both = freespace.carve_beams(case)[0], freespace.air_voxels(case)
    local = freespace.carved_about(case, reference_curve(case))[0]
    outside = lining_radii(case).depth(passed) < -_RADII_SLACK
    if len(case.candidate.extra.faces):
        cell, kept = both.lattice.cell(local)
        outside |= kept & both.filled.ravel()[cell]
    # Beyond the ends of the reference a beam still runs in air without a reconstruction.
    among = (local[:, 0] > both.lattice.low[0]) & (local[:, 0] < reference_curve(case).station[-1])
    return Samples(outside[among].astype(float), local[among, 0])


@metric("free3d_esdf_rmse", "F3D", D(1e-06, 0.3), "m", needs="reference", of=rms)
def free3d_esdf_rmse(case: Case) -> Samples:
    """Root mean square error of the distance to the nearest surface within 1 m of the axis, m."""
    station, judged, reference = freespace.axis_clearances(case)
    return Samples((judged - reference).ravel(), np.repeat(station, judged.shape[1]))


@metric("free3d_inscribed_err", "F3D", D(1e-06, 0.3), "m", needs="reference", of=mean)
def free3d_inscribed_err(case: Case) -> Samples:
    """Mean absolute error of the radius of the largest sphere near the axis, m."""
    station, judged, reference = freespace.axis_clearances(case)
    return Samples(np.abs(judged.max(axis=1) - reference.max(axis=1)), station)


@metric("free3d_headroom_rmse", "F3D", D(1e-06, 0.06), "m", needs="reference", of=rms)
def free3d_headroom_rmse(case: Case) -> Samples:
    """Root mean square error of floor to crown in three lanes, m."""
    station, judged, reference = freespace.headrooms(case)
    return Samples((judged - reference).ravel(), np.repeat(station, judged.shape[1]))


@metric("free3d_envelope_agree", "F3D", U(0.9, 0.999999), needs="reference", of=mean)
def free3d_envelope_agree(case: Case) -> Samples:
    """Fraction of sections and envelopes in which lining and reference agree whether the envelope is cut into."""
    judged, reference = freespace.infringements(case)
    return Samples((judged == reference).mean(axis=1), sections(case).station)


@metric("free3d_hold_poses_free", "F3D", U(0.95, 0.999999), gate=True, needs="hold", of=mean)
def free3d_hold_poses_free(case: Case) -> Samples:
    """Fraction of sensor positions between the reference's mouths that are inside and 20 cm clear of any surface."""
    assert case.hold is not None
    at, curve = case.hold.origin[np.unique(case.hold.scan, return_index=True)[1]], reference_curve(case)
    station = curve.local(at)[:, 0]
    within = (station > curve.station[0]) & (station < curve.station[-1])
    at, station = at[within], station[within]
    clear = surface_nearest(case).query(at)[0] >= _SENSOR_CLEARANCE
    free = (lining_radii(case).depth(at) > 0) & clear
    return Samples(free.astype(float), station)


@metric("free3d_voxel_vs_mesh_vol", "F3D", unit="%", needs="reference", evidence="S")
def free3d_voxel_vs_mesh_vol(case: Case) -> Value:
    """Difference between the volume of the voxels inside the lining and that of the solid, %."""
    both, radii = freespace.air_voxels(case), lining_radii(case)
    inside = both.judged | both.blocked
    fraction = (both.lattice.shape[0] * both.lattice.edge) / radii.curve.length
    volume = abs(float(case.candidate.solid.volume)) * min(fraction, 1.0)
    voxels = float(inside.sum()) * both.lattice.edge**3
    return number(100.0 * abs(voxels / volume - 1.0), int(inside.sum()))


# NAV: the ways of a small robot over the candidate's ground and the reference's.


def _both_ways(case: Case) -> tuple[Route, Route] | Value:
    judged, reference = both_routes(case)
    if reference is None:
        return missing(_NO_REFERENCE)
    if judged is None:
        return Value(None, None, 0, _NO_WAY, failed=True)
    return judged, reference


@metric("nav_path_exists", "NAV", P, "bool", gate=True)
def nav_path_exists(case: Case) -> Value:
    """The robot gets from mouth to mouth."""
    exists = judged_route(case) is not None
    return pass_or_fail(exists, "" if exists else _NO_WAY)


@metric("nav_path_len_ratio", "NAV", B(1, 1e-06, 0.08), needs="reference")
def nav_path_len_ratio(case: Case) -> Value:
    """Length of the way over the length of the reference's."""
    ways = _both_ways(case)
    return ways if isinstance(ways, Value) else number(ways[0].length / ways[1].length, len(ways[0].place))


@metric("nav_path_dev_p95", "NAV", D(1e-06, 0.8), "m", needs="reference", of=percentile(95))
def nav_path_dev_p95(case: Case) -> Value | Samples:
    """95th percentile of the distance from the way to the reference's, m."""
    ways = _both_ways(case)
    if isinstance(ways, Value):
        return ways
    apart = cKDTree(ways[1].place).query(ways[0].place)[0]
    return Samples(apart, ways[0].place[:, 0])


@metric("nav_clearance_min_err", "NAV", D(1e-06, 0.4), "m", needs="reference", args=(np.min,))
@metric("nav_clearance_mean_err", "NAV", D(1e-06, 0.3), "m", needs="reference", args=(mean,))
def way_clearance_error(case: Case, statistic) -> Value:
    """Absolute error of the least or mean clearance on the way, m."""
    ways = _both_ways(case)
    if isinstance(ways, Value):
        return ways
    judged, reference = (statistic(way.clearance) for way in ways)
    return number(abs(float(judged - reference)), len(ways[0].place))


@metric("nav_drivable_width_mae", "NAV", D(1e-06, 0.13), "m", needs="reference", of=mean)
def nav_drivable_width_mae(case: Case) -> Samples:
    """Mean absolute error of the drivable width, m."""
    judged, reference = both_grounds(case)
    return Samples(np.abs(judged.width - reference.width), judged.station)


@metric("nav_feasible_agree", "NAV", U(0.9, 0.999999), needs="reference")
def nav_feasible_agree(case: Case) -> Value:
    """Fraction of 1,000 random starts, goals and inflations that are feasible on both grounds or on neither.

    The mean over ten lattices of cells, with 1,000 in each.
    """
    rng, agree = case.rng("nav_feasible_agree"), []
    for judged, reference in zip(*(ground.lattices() for ground in both_grounds(case)), strict=True):
        trips = draw_trips(reference, rng)
        agree.append(feasible_trips(judged, trips) == feasible_trips(reference, trips))
    return number(mean(np.concatenate(agree).astype(float)), sum(map(len, agree)))


@metric("nav_blocked_diff", "NAV", D(1e-06, 4), "count", gate=True, needs="reference")
def nav_blocked_diff(case: Case) -> Value:
    """Absolute difference in the number of blocked metres between the rails."""
    judged, reference = both_grounds(case)
    return number(abs(blocked_metres(judged) - blocked_metres(reference)), 1)


@metric("nav_traversable_iou", "NAV", U(0.964, 0.999999), needs="reference", of=mean)
def nav_traversable_iou(case: Case) -> Samples:
    """Intersection over union of traversable cells, where the reference sees the ground."""
    judged, reference = both_grounds(case)
    free = [judged.traversable, reference.traversable]
    among = free[0] | free[1]
    if case.truth is None:
        among &= np.isfinite(reference.step) & np.isfinite(judged.step)
    station = np.broadcast_to(judged.station[:, None], among.shape)[among]
    return Samples((free[0] & free[1])[among].astype(float), station)


@metric("nav_step_p95_err", "NAV", D(1e-06, 0.12), "m", needs="reference")
def nav_step_p95_err(case: Case) -> Value:
    """Absolute error of the 95th percentile of the step between neighbouring cells, m, its mean over ten lattices."""
    steps, count = [], 0
    for judged, reference in zip(*(ground.lattices() for ground in both_grounds(case)), strict=True):
        among = np.isfinite(judged.step) & np.isfinite(reference.step)
        steps.append(np.percentile([judged.step[among], reference.step[among]], 95, axis=1))
        count += int(among.sum())
    return number(abs(float(np.diff(np.mean(steps, axis=0))[0])), count)


@metric("nav_footprint_margin", "NAV", unit="m")
def nav_footprint_margin(case: Case) -> Value:
    """Least clearance on the way less the robot's radius, m."""
    way = judged_route(case)
    return missing(_NO_WAY) if way is None else number(float(way.clearance.min()) - ROBOT_RADIUS, len(way.place))
