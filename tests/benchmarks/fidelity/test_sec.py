from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import shapely

from benchmarks.fidelity.derive.sections import heights, outlines, sections, widths
from tests.benchmarks.fidelity import tube
from tests.benchmarks.fidelity.judged import measure
from tests.benchmarks.fidelity.tube import Tube

TUBE = Tube(track=False)


@cache
def judged(**changes):
    return tube.case(TUBE, replace(TUBE, **changes))


def test_a_true_copy_has_the_true_sections():
    case = judged()
    assert measure("sec_width_rmse", case).value < 1e-6
    assert measure("sec_iou_p05", case).value > 0.999999
    assert measure("sec_variation_corr", case).value == pytest.approx(1.0)
    assert measure("sec_variation_ratio", case).value == pytest.approx(1.0)


def test_ten_centimetres_of_width_are_ten_centimetres():
    case = judged(width=5.7)
    assert measure("sec_width_bias", case).value == pytest.approx(0.1, abs=2e-3)
    assert measure("sec_height_bias", case).value < 1e-3
    assert measure("sec_overbreak_vol", case).value == pytest.approx(1.6, abs=0.1)
    assert measure("sec_underbreak_vol", case).value < 0.01


def test_pockets_are_no_part_of_the_section():
    assert measure("sec_width_rmse", judged(depth=0.0)).value < 1e-3


def test_a_constant_tube_does_not_vary():
    case = judged(variation=0.0)
    assert measure("sec_variation_corr", case).value == 0.0
    assert measure("sec_variation_ratio", case).value < 0.01


def test_a_section_that_is_not_there_has_no_overlap():
    case = judged(length=16.0)
    assert shapely.area(sections(case).common)[-1] == 0.0
    assert measure("sec_underbreak_vol", case).value == pytest.approx(100 / 17, rel=0.05)
    assert measure("sec_iou_p05", case).value < 0.85


def test_a_shifted_section_keeps_its_size_and_loses_overlap():
    case = judged(shift=(0.1, 0.0))
    assert measure("sec_width_rmse", case).value < 1e-3
    assert measure("sec_iou_mean", case).value < 0.97
    assert measure("sec_radial_rmse", case).value > 0.05


def test_the_recording_alone_shows_the_size_to_centimetres():
    good, wide = (replace(case, truth=None, cache={}) for case in (judged(), judged(width=5.8)))
    assert measure("sec_width_bias", good).value < 0.03
    assert measure("sec_height_bias", good).value < 0.03
    assert measure("sec_width_bias", wide).value == pytest.approx(0.2, abs=0.03)


def test_an_unknown_sector_is_crossed_in_a_straight_line():
    angle = np.deg2rad(np.arange(0.0, 360.0, 45.0))
    known = np.ones((1, 8), bool)
    known[0, 1] = False
    radius = np.where(np.arange(8) % 2, np.sqrt(2.0), 1.0)[None]
    square = outlines(radius, angle, np.ones_like(known))
    assert shapely.area(square)[0] == pytest.approx(4.0)
    assert shapely.area(outlines(radius, angle, known))[0] == pytest.approx(3.5)
    assert widths(square, np.array([0.5]))[0] == pytest.approx(2.0)
    assert heights(square)[0] == pytest.approx(2.0)
