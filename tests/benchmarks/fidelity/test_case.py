"""What a case keeps of its computations, and when it lets them go."""

import numpy as np

from benchmarks.fidelity import case as module
from benchmarks.fidelity import registry, table
from benchmarks.fidelity.derive.clearances import _truth_nearest
from benchmarks.fidelity.derive.surface import nearest
from tests.benchmarks.fidelity import tube

POINTS = np.array([[1.0, 0.2, 0.1], [4.0, -0.3, 0.4]])


def test_what_no_later_category_needs_is_let_go_and_comes_back_the_same() -> None:
    case = tube.case().fresh()
    before, of_truth = nearest(case), _truth_nearest(case)
    expected = before.query(POINTS)
    case.let_go("CEN")
    assert nearest(case) is before
    case.let_go("F3D")
    assert nearest(case) is not before
    assert _truth_nearest(case) is not of_truth
    for found, known in zip(nearest(case).query(POINTS), expected, strict=True):
        np.testing.assert_array_equal(found, known)


def test_every_mark_names_a_category() -> None:
    registry.registered()
    assert set(module._UNTIL.values()) <= set(table.categories())


def test_a_fresh_case_shares_data_and_no_results() -> None:
    case = tube.case()
    nearest(case), _truth_nearest(case)
    fresh = case.fresh()
    assert fresh.candidate is case.candidate
    assert fresh.hold.range is case.hold.range
    assert not fresh.cache
    assert not fresh.hold.cache
    assert not fresh.truth.cache
