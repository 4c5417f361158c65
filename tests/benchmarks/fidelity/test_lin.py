from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.fidelity.derive import lining
from benchmarks.fidelity.derive.lining import coarse_pitch, judged_pockets
from tests.benchmarks.fidelity import tube
from tests.benchmarks.fidelity.judged import measure
from tests.benchmarks.fidelity.tube import Tube

TUBE = Tube(track=False)


@cache
def judged(**changes):
    return tube.case(TUBE, replace(TUBE, **changes))


def test_every_pocket_of_a_true_copy_is_found_where_it_is():
    case = judged()
    assert len(judged_pockets(case)) == len(TUBE.pockets)
    assert measure("lin_pocket_f1", case).value == 1.0
    assert measure("lin_pocket_count_rel_err", case).value == 0.0
    assert measure("lin_pocket_depth_bias", case).value < 5e-3
    assert measure("lin_pocket_area_rel_err", case).value < 25.0
    assert measure("lin_ring_phase_err", case).value < 1e-3


def test_a_tube_without_pockets_has_none():
    case = judged(depth=0.0)
    assert measure("lin_pocket_f1", case).value == 0.0
    assert measure("lin_pocket_count_rel_err", case).value == 100.0
    assert measure("lin_pocket_depth_bias", case).failed
    assert measure("lin_axial_pitch_err", case).value == 100.0
    assert measure("lin_depth_map_ncc", case).value < 0.2 < 0.7 < measure("lin_depth_map_ncc", judged()).value


def test_pockets_seven_centimetres_too_deep_are_that():
    case = judged(depth=0.20)
    assert measure("lin_pocket_depth_mae", case).value == pytest.approx(0.07, abs=5e-3)
    assert measure("lin_pocket_f1", case).value == 1.0


def test_a_grid_shifted_by_a_third_has_the_phase_of_a_third():
    case = judged(rings=1.2)
    assert measure("lin_ring_phase_err", case).value == pytest.approx(1 / 3, abs=0.02)
    assert measure("lin_axial_pitch_err", case).value < 0.5
    assert measure("lin_pocket_f1", case).value < 0.6


def test_another_pitch_is_seen_in_per_cent():
    assert measure("lin_axial_pitch_err", judged(pitch=1.6)).value == pytest.approx(100 * 0.1 / 1.5, abs=1.0)


def test_the_pitch_is_the_first_high_peak_and_not_its_multiple():
    station = np.arange(0.0, 60.0, lining.ROW)
    signal = (np.abs((station % 1.5) - 0.5) < 0.1).astype(float)
    assert coarse_pitch(signal) == pytest.approx(1.5, abs=0.051)


def test_by_the_recording_alone_a_copy_is_better_than_a_smooth_tube():
    good, smooth = (replace(case, truth=None, cache={}) for case in (judged(), judged(depth=0.0)))
    assert measure("lin_pocket_f1", good).value > 0.6
    assert measure("lin_pocket_f1", smooth).value == 0.0
    assert measure("lin_ring_phase_err", good).value < 0.05
