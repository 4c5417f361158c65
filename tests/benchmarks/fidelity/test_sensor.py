"""Surface and sensor metrics on tubes of known error, and the distances that they rest on."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.categories import sensor
from benchmarks.fidelity.derive import distances
from benchmarks.fidelity.derive.beams import returns, sensor_path
from benchmarks.fidelity.derive.clouds import fit_planes, mean_entropy, voxel_map, voxel_wasserstein
from benchmarks.fidelity.derive.degeneracy import alias_ratios, information, localised_stations
from benchmarks.fidelity.derive.distances import VOXEL_EDGE, Occupied, mesh_distances, phantom_cells, tolerant_f1
from benchmarks.fidelity.derive.surface import Caster, Nearest
from benchmarks.fidelity.faults import Fault, Site, put_in
from tests.benchmarks.fidelity import tube
from tests.benchmarks.fidelity.judged import category, judged, measure, obstructed, raw


def test_a_beam_meets_a_wall_where_geometry_says():
    straight = replace(tube.Tube(), bend=np.inf, grade=0.0, variation=0.0, depth=0.0, track=False)
    eye = straight.point(9.0, 0.3, 0.0)
    _, tangent, left, up = straight.frames([9.0])
    caster = Caster(tube.candidate(straight).lining)
    directions = np.concatenate([left, -left, -up, np.sqrt(0.5) * (left + tangent), tangent])
    reach, face = caster.first(np.repeat(eye, 5, axis=0), directions)
    np.testing.assert_allclose(reach[:4], [2.5, 3.1, 3.1, 2.5 * np.sqrt(2)], atol=1e-5)
    assert np.isinf(reach[4])
    assert face[4] == -1


def test_returns_are_foreseen_where_the_recording_knows_its_silent_beams():
    assert measure("beam_return_bacc", judged()).value is None
    hold = judged().hold
    out = np.tile(tube.Tube().frames([0.0])[1], (300, 1)) * -1.0
    eye = np.repeat(hold.origin[:1], 300, axis=0)
    columns = {
        "time": np.concatenate([hold.time, np.full(300, hold.time[0])]),
        "scan": np.concatenate([hold.scan, np.zeros(300, int)]),
        "origin": np.concatenate([hold.origin, eye]),
        "direction": np.concatenate([hold.direction, out]),
        "range": np.concatenate([hold.range, np.full(300, np.inf)]),
    }
    listening = replace(hold, **columns, knows_missing=True, cache={})
    assert raw("beam_return_bacc", Case(judged().candidate, listening)) == pytest.approx(1.0, abs=1e-3)
    walled = replace(judged().candidate, extra=tube.box(tube.Tube(), 0.0, 0.0, 0.0, (0.1, 6.0, 7.0)))
    assert raw("beam_return_bacc", Case(walled, listening)) < 0.6
    assert raw("dropout_diff", Case(walled, listening)) > raw("dropout_diff", Case(judged().candidate, listening))


def test_a_moved_cloud_is_as_far_in_wasserstein_as_it_was_moved():
    rng = np.random.default_rng(0)
    cloud = rng.uniform(0.15, 0.35, (400, 3)) + np.repeat(0.5 * np.arange(4), 100)[:, None] * [1.0, 0.0, 0.0]
    key, distance = voxel_wasserstein(voxel_map(cloud, 0.5), voxel_map(cloud + np.array([0.03, -0.04, 0.0]), 0.5))
    assert len(key) == 4
    np.testing.assert_allclose(distance, 0.05, atol=1e-6)


def test_the_entropy_of_a_normal_cloud_is_its_formula():
    rng = np.random.default_rng(2)
    cloud = rng.normal(size=(4000, 3)) * [0.02, 0.03, 0.01]
    expected = 0.5 * np.log((2 * np.pi * np.e) ** 3 * (0.02 * 0.03 * 0.01) ** 2)
    assert mean_entropy(cKDTree(cloud), cloud[:200]) == pytest.approx(expected, abs=0.05)


def test_a_local_plane_knows_its_normal_and_its_noise():
    rng = np.random.default_rng(3)
    cloud = np.column_stack([rng.uniform(-1, 1, (5000, 2)), 0.01 * rng.normal(size=5000)])
    found = fit_planes(cloud, cKDTree(cloud), cloud[:2000])
    assert np.median(np.abs(found.normal[:, 2])) > 0.99
    assert np.median(found.sigma) == pytest.approx(0.01, rel=0.1)
    assert np.median(found.residual) == pytest.approx(0.00674, rel=0.1)


SMOOTH = replace(tube.Tube(), bend=np.inf, grade=0.0, variation=0.0, depth=0.0, track=False)


def test_a_straight_smooth_tube_tells_nothing_along_its_axis():
    frames = information(tube.case(SMOOTH, sigma=1e-4, beams=2000), True)
    assert np.median(frames.axial) < 1e-3
    axis = SMOOTH.frames([9.0])[1][0]
    assert np.median(np.abs(frames.weakest @ axis)) > 0.999
    assert np.median(frames.translation.sum(axis=1)) == pytest.approx(1.0, abs=1e-6)


def test_sleepers_tell_the_axis():
    bare, laid = (tube.case(replace(SMOOTH, track=laid), sigma=1e-3, beams=2000) for laid in (False, True))
    assert np.median(information(laid, True).axial) > 5 * np.median(information(bare, True).axial)


def test_a_scan_fits_as_well_elsewhere_in_a_smooth_tube_and_nowhere_else_in_a_wavy_one():
    smooth, wavy = (tube.case(replace(SMOOTH, variation=v), sigma=1e-3, beams=2000) for v in (0.0, 0.05))
    assert np.median(alias_ratios(smooth, True)) < 1.2
    assert np.median(alias_ratios(wavy, True)) > 3.0


def _planar(path, walls, lining="smooth"):
    station = np.linspace(0.0, 20.0, 81)
    centre = np.column_stack([station, np.zeros(81)])
    polylines = {f"{side}_{lining}": wall for side, wall in zip(("left", "right"), walls, strict=True)}
    np.savez(path, station=station, centre=centre, tangent=np.tile([1.0, 0.0], (81, 1)), **polylines)
    return Case(replace(judged().candidate, tunnel=path))


def test_a_planar_scan_is_lost_between_smooth_walls_and_found_between_pilasters(tmp_path):
    straight = [np.array([[0.0, side], [20.0, side]]) for side in (2.5, -2.5)]
    assert not localised_stations(_planar(tmp_path / "smooth.npz", straight)).any()
    x = np.repeat(np.arange(0.0, 20.5, 1.0), 2)
    step = np.tile([0.0, 0.5, 0.5, 0.0], len(x) // 4 + 1)[: len(x)]
    stepped = [np.column_stack([x, side * (2.0 + step)]) for side in (1, -1)]
    pilasters = _planar(tmp_path / "pockets.npz", stepped, "pockets")
    assert localised_stations(pilasters).mean() > 0.5
    assert raw("deg_planar_axial_info", pilasters) == localised_stations(pilasters).mean()


def test_a_scan_near_the_cut_counts_by_the_probability_that_it_lies_beyond(monkeypatch):
    """One standard deviation above and below the cut: 84 % and 16 % of a normal distribution."""
    deviation, weakest = 0.05, np.full((20, 3), 1.0)  # of log10
    scans = {real: SimpleNamespace(axial=np.full(20, 10.0 ** (sign * deviation) / 10.0), translation=weakest)
             for real, sign in ((True, 1.0), (False, -1.0))}  # fmt: skip
    monkeypatch.setattr(sensor.degeneracy, "information", lambda case, real: scans[real])
    assert sensor.deg_landmark_diff(None).value == pytest.approx(100.0 * (0.8413 - 0.1587), abs=0.01)


def test_without_noise_the_distance_is_none():
    quiet = tube.case(sigma=1e-6, beams=600)
    assert raw("c2m_p95", quiet) < 1e-4
    assert raw("c2m_rmse", quiet) < 0.002


def test_walls_ten_centimetres_too_wide_lie_five_centimetres_off_behind_the_points():
    wide = tube.case(tube.Tube(), replace(tube.Tube(), width=5.7, depth=0.0), sigma=1e-6, beams=1200)
    found = mesh_distances(wide)
    wall = found.sector % 4 == 0
    assert np.median(found.signed[wall]) == pytest.approx(0.05, abs=0.002)
    assert raw("c2m_sector_worst", wide) > 0.035
    assert raw("c2m_signed_bias", wide) > 0.01


def test_the_gap_is_left_out_without_the_recording_that_was_fitted():
    assert measure("c2m_fit_hold_gap", judged()).value is None
    assert not measure("c2m_fit_hold_gap", judged()).failed
    right = judged()
    fitted = Case(right.candidate, right.hold, tube.hold(tube.Tube(), beams=600, seed=3), right.truth)
    assert raw("c2m_fit_hold_gap", fitted) < 0.002
    foreign = Case(right.candidate, tube.hold(replace(tube.Tube(), width=5.7), beams=600), right.hold, None)
    assert raw("c2m_fit_hold_gap", foreign) > 0.005


def test_without_a_surface_the_metric_has_failed_and_is_not_missing():
    empty = judged().candidate.extra
    nothing = replace(judged().candidate, lining=empty, track=replace(
        judged().candidate.track, sleeper_mesh=empty, rail_mesh=empty, fastening_mesh=empty))  # fmt: skip
    assert measure("c2m_mean", Case(nothing, judged().hold)).failed


def test_distances_agree_with_trimesh():
    mesh = judged().candidate.lining
    points = judged().hold.points[::500] + 0.03
    expected = trimesh.proximity.closest_point(mesh, points)[1]
    found, closest, _ = Nearest(mesh).query(points)
    assert (found >= expected - 1e-6).all()
    assert np.percentile(found - expected, 99) < 1e-3
    np.testing.assert_allclose(np.linalg.norm(points - closest, axis=1), found, atol=1e-9)


def test_missing_surface_is_the_share_of_returns_beyond_the_end():
    short = judged(length=14.0)
    beyond = tube.Tube().frames([14.0])
    points = returns(short).points
    behind = (points - beyond[0]) @ beyond[1][0] > 0.2
    assert raw("missing_surface_frac", short) == pytest.approx(behind.mean(), abs=0.01)
    assert category("CMP", short) < 70.0


def test_an_obstacle_that_beams_pass_through_is_extra_surface():
    found = raw("extra_surface_frac", obstructed())
    assert found > 0.003
    assert found == np.mean(phantom_cells(obstructed()))
    assert raw("comp_10cm", obstructed()) < raw("comp_10cm", judged())
    assert raw("hausdorff_p99", obstructed()) >= raw("hausdorff_p99", judged())


def test_f1_by_hand():
    real, first = np.zeros((6, 5, 5), bool), np.zeros((6, 5, 5), bool)
    real[:3, 2, 2] = True
    first[:2, 2, 3] = True  # beside the first two, one voxel off
    first[5, 2, 2] = True  # alone
    grids = Occupied(np.stack([real, first, first]), real | first, np.arange(6) * VOXEL_EDGE)
    assert tolerant_f1(grids, np.zeros(6, int))[0] == pytest.approx(2 * 1.0 * (2 / 3) / (1.0 + 2 / 3))
    np.testing.assert_allclose(tolerant_f1(grids, np.array([0, 0, 0, 1, 1, 1])), [1.0, 0.0], atol=1e-9)


def test_poses_in_a_wrong_order_leave_the_path_and_corrupt_the_agreement():
    hold = judged().hold
    number = np.unique(hold.scan)
    swapped = dict(zip(number, np.roll(number, len(number) // 2), strict=True))
    at = {k: hold.origin[np.argmax(hold.scan == k)] for k in number}
    wrong = replace(hold, origin=np.array([at[swapped[k]] for k in hold.scan]), cache={})
    lost = Case(judged().candidate, wrong)
    assert sensor_path(lost).length == pytest.approx(sensor_path(judged()).length, rel=0.02)
    assert category("OCC", lost) < category("OCC", judged()) - 30.0


@pytest.mark.parametrize("id", ["vox_iou_norm", "vox_precision", "vox_recall", "vox_kappa", "vox_proj_iou_xy"])
def test_half_of_the_beams_agree_as_well(id):
    half = put_in(Site(judged(), np.random.default_rng(7)), Fault("thinned", 0.5))
    assert raw("vox_iou_20cm", half) < raw("vox_iou_20cm", judged()) - 0.02
    assert raw(id, half) == pytest.approx(raw(id, judged()), abs=0.005)


def test_a_single_point_tells_two_clouds_apart_where_the_other_has_none_beside_it():
    one, none = np.array([1, 0, 0]), np.zeros(3, int)
    assert [distances.cells_apart(*pair).tolist() for pair in ((one, none), (none, one))] == [[True, False, False]] * 2
    assert not distances.cells_apart(one, np.roll(one, 1)).any()
