"""C2M, CMP and OCC: distances both ways, completeness, voxels."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.beams import returns, sensor_path
from benchmarks.fidelity.derive.distances import VOXEL_EDGE, Occupied, mesh_distances, phantom_cells, tolerant_f1
from benchmarks.fidelity.derive.surface import Nearest
from benchmarks.fidelity.faults import Fault, Site, put_in
from tests.benchmarks.fidelity import tube
from tests.benchmarks.fidelity.judged import category, judged, measure, obstructed, raw

SIGMA = 0.02


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
