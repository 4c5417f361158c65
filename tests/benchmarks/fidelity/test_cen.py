from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.fidelity.derive.axis import drift_slope
from tests.benchmarks.fidelity import tube
from tests.benchmarks.fidelity.judged import measure
from tests.benchmarks.fidelity.tube import Tube

TUBE = Tube(depth=0.0, track=False)


@cache
def judged(**changes):
    return tube.case(TUBE, replace(TUBE, **changes))


def test_the_axis_of_a_true_copy_is_the_true_axis():
    case = judged()
    assert measure("cl_lateral_rmse", case).value < 1e-3
    assert measure("cl_vertical_rmse", case).value < 5e-3
    assert measure("cl_heading_rmse", case).value < 0.01
    assert measure("cl_length_rel_err", case).value < 0.01
    assert measure("cl_end_station_err", case).value < 0.01
    assert measure("cl_axial_drift_slope", case).value < 1e-6
    assert measure("cl_icp_rotation", case).value < 0.1


def test_a_shift_to_the_left_is_that_much():
    case = judged(shift=(0.1, 0.0))
    assert measure("cl_lateral_rmse", case).value == pytest.approx(0.1, abs=1e-3)
    assert measure("cl_lateral_p95", case).value == pytest.approx(0.1, abs=1e-3)
    assert measure("cl_heading_rmse", case).value < 0.01


def test_a_lift_is_that_much():
    case = judged(shift=(0.0, 0.07))
    assert measure("cl_vertical_rmse", case).value == pytest.approx(0.07, abs=5e-3)
    assert measure("cl_lateral_rmse", case).value < 1e-3


def test_a_straightened_bend_lacks_its_curvature():
    case = judged(bend=1e6)
    assert measure("cl_curvature_rmse", case).value == pytest.approx(1 / 300, rel=0.02)
    assert measure("cl_lateral_rmse", case).value > 0.1


def test_a_wrong_grade_is_seen_in_per_cent():
    assert measure("cl_grade_rmse", judged(grade=0.03)).value == pytest.approx(2.0, rel=0.05)


def test_a_short_tube_misses_its_end():
    case = judged(length=16.0)
    assert measure("cl_length_rel_err", case).value == pytest.approx(100 * 2 / 18, rel=0.01)
    assert measure("cl_end_station_err", case).value == pytest.approx(2.0, abs=0.02)


def test_the_recording_alone_shows_the_axis_to_a_few_centimetres():
    case = replace(judged(), truth=None, cache={})
    assert measure("cl_lateral_rmse", case).value < 0.02
    assert measure("cl_vertical_rmse", case).value < 0.03


def test_features_that_drift_past_their_neighbours_are_followed():
    true = np.arange(0.0, 100.0, 1.5)
    assert drift_slope(1.05 * true + 0.4, true) == pytest.approx(0.05, abs=1e-9)


def test_a_registration_finds_the_turn_of_a_turned_lining():
    case = judged(heading=0.3 + np.deg2rad(1.0))
    assert measure("cl_icp_rotation", case).value == pytest.approx(1.0, abs=0.15)
