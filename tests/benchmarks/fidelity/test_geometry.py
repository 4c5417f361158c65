"""Axis, sections and lining: what lies behind their metrics."""

import numpy as np
import pytest
import shapely

from benchmarks.fidelity.derive import lining
from benchmarks.fidelity.derive.axis import drift_slope
from benchmarks.fidelity.derive.sections import heights, outlines, sections, widths
from tests.benchmarks.fidelity.judged import PLAIN, against, measure


def test_features_that_drift_past_their_neighbours_are_followed():
    true = np.arange(0.0, 100.0, 1.5)
    assert drift_slope(1.05 * true + 0.4, true) == pytest.approx(0.05, abs=1e-9)


def test_a_section_that_is_not_there_has_no_overlap():
    assert shapely.area(sections(against(PLAIN, length=16.0)).common)[-1] == 0.0


def test_every_pocket_of_a_true_copy_is_found_and_without_any_their_error_has_failed():
    assert len(lining.judged_pockets(against(PLAIN))) == len(PLAIN.pockets)
    assert measure("lin_pocket_depth_bias", against(PLAIN, depth=0.0)).failed


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


def test_the_pitch_is_the_first_high_peak_and_not_its_multiple():
    station = np.arange(0.0, 60.0, lining.ROW)
    signal = (np.abs((station % 1.5) - 0.5) < 0.1).astype(float)
    assert lining.coarse_pitch(signal) == pytest.approx(1.5, abs=0.051)
