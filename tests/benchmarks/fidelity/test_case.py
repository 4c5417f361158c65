"""A case: what it keeps of its computations, and when it lets them go."""

import numpy as np

from benchmarks.fidelity import table
from benchmarks.fidelity.case import _KEPT_UNTIL
from benchmarks.fidelity.derive.sections import truth_caster
from benchmarks.fidelity.derive.surface import surface_nearest
from tests.benchmarks.fidelity import tube

POINTS = np.array([[1.0, 0.2, 0.1], [4.0, -0.3, 0.4]])


def test_what_no_later_category_needs_is_let_go_and_comes_back_the_same() -> None:
    case = tube.case().fresh()
    before, of_truth = surface_nearest(case), truth_caster(case)
    expected = before.query(POINTS)
    case.forget("CEN")
    assert surface_nearest(case) is before
    case.forget("NAV")
    assert surface_nearest(case) is not before
    assert truth_caster(case) is not of_truth
    for found, known in zip(surface_nearest(case).query(POINTS), expected, strict=True):
        np.testing.assert_array_equal(found, known)


def test_what_comes_back_after_its_category_goes_with_the_one_that_asked() -> None:
    case = tube.case().fresh()
    case.forget("F3D")
    again = surface_nearest(case)
    case.forget("CEN")
    assert surface_nearest(case) is again
    case.forget("SCN")
    assert surface_nearest(case) is not again


def test_every_mark_names_a_category() -> None:
    table.load()
    assert set(_KEPT_UNTIL.values()) <= set(table.CATEGORIES)


def test_a_fresh_case_shares_data_and_no_results() -> None:
    case = tube.case()
    surface_nearest(case), truth_caster(case)
    fresh = case.fresh()
    assert fresh.candidate is case.candidate
    assert fresh.hold.range is case.hold.range
    assert not fresh.cache
    assert not fresh.hold.cache
    assert not fresh.truth.cache
