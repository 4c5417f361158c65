from dataclasses import replace

import numpy as np
import pytest

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.beams import sensor_path
from benchmarks.fidelity.derive.distances import VOXEL_EDGE, Occupied, dilate, occupied_voxels, told_cells, tolerant_f1
from benchmarks.fidelity.faults import Fault, Site, put_in
from tests.benchmarks.fidelity.judged import category, judged, obstructed, raw


def test_two_draws_differ_in_noise_alone():
    _, first, second = occupied_voxels(judged()).points > 0
    assert (first != second).any()
    assert (dilate(first) & second).sum() > 0.999 * second.sum()


def test_f1_by_hand():
    real, first = np.zeros((6, 5, 5), bool), np.zeros((6, 5, 5), bool)
    real[:3, 2, 2] = True
    first[:2, 2, 3] = True  # beside the first two, one voxel off
    first[5, 2, 2] = True  # alone
    grids = Occupied(np.stack([real, first, first]), real | first, np.arange(6) * VOXEL_EDGE)
    assert tolerant_f1(grids, np.zeros(6, int))[0] == pytest.approx(2 * 1.0 * (2 / 3) / (1.0 + 2 / 3))
    np.testing.assert_allclose(tolerant_f1(grids, np.array([0, 0, 0, 1, 1, 1])), [1.0, 0.0], atol=1e-9)


def test_an_obstacle_is_a_mismatch_in_the_interior():
    assert raw("vox_interior_mismatch", obstructed()) > raw("vox_interior_mismatch", judged()) + 0.01
    assert raw("vox_f1_tol1", obstructed()) < raw("vox_f1_tol1", judged())


def test_poses_in_a_wrong_order_leave_the_path_and_spoil_the_agreement():
    hold = judged().hold
    number = np.unique(hold.scan)
    swapped = dict(zip(number, np.roll(number, len(number) // 2), strict=True))
    at = {k: hold.origin[np.argmax(hold.scan == k)] for k in number}
    wrong = replace(hold, origin=np.array([at[swapped[k]] for k in hold.scan]), cache={})
    lost = Case(judged().candidate, wrong)
    assert sensor_path(lost).length == pytest.approx(sensor_path(judged()).length, rel=0.02)
    assert category("OCC", lost) < category("OCC", judged()) - 30.0


def test_thin_cells_tell_nothing_beside_a_cell_of_the_other_cloud():
    real, first = np.array([9, 1, 0, 0, 0, 2, 1, 0]), np.array([8, 0, 0, 0, 0, 2, 0, 1])
    np.testing.assert_array_equal(told_cells(real, first), [1, 0, 0, 0, 0, 1, 0, 0])
    np.testing.assert_array_equal(told_cells(np.array([0, 0, 0, 1]), np.array([7, 0, 0, 0])), [1, 0, 0, 1])  # alone


@pytest.mark.parametrize("id", ["vox_iou_norm", "vox_precision", "vox_recall", "vox_kappa", "vox_proj_iou_xy"])
def test_half_of_the_beams_agree_as_well(id):
    half = put_in(Site(judged(), np.random.default_rng(7)), Fault("thinned", 0.5))
    assert raw("vox_iou_20cm", half) < raw("vox_iou_20cm", judged()) - 0.02
    assert raw(id, half) == pytest.approx(raw(id, judged()), abs=0.005)
