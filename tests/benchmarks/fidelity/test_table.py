"""The table of metrics, and what a case keeps of its computations."""

import math

import numpy as np
import pytest

from benchmarks.fidelity import table
from benchmarks.fidelity.derive.sections import truth_caster
from benchmarks.fidelity.derive.surface import surface_nearest
from benchmarks.fidelity.registry import dump_values, estimate, load_values, mean
from benchmarks.fidelity.table import B, D, Map, P, U
from tests.benchmarks.fidelity import tube


def test_there_are_18_categories_and_199_metrics_with_unique_ids() -> None:
    rows = list(table.load().values())
    assert len(table.CATEGORIES) == 18
    assert len(rows) == table.COUNT == 199
    assert [row.number for row in rows] == list(range(1, 200))
    assert len({row.id for row in rows}) == 199


def test_nothing_that_is_true_by_construction_is_scored() -> None:
    by_construction = [row for row in table.load().values() if "C" in row.evidence]
    assert [row.id for row in by_construction] == [
        "selfcast_p2s_mean", "selfcast_within_10cm", "selfcast_noise_ratio", "mj_version_match", "mj_inertia_valid",
        "env_noise_sigma_err", "env_determinism",
    ]  # fmt: skip
    assert not any(row.scored for row in by_construction)


@pytest.mark.parametrize(
    ("map", "value", "score"),
    [
        (D(1, 3), 1.0, 100.0),
        (D(1, 3), 2.0, 50.0),
        (D(1, 3), 9.0, 0.0),
        (U(0.5, 0.9), 0.7, 50.0),
        (B(1, 0.2, 1.0), 0.4, 50.0),
        (B(1, 0.2, 1.0), 1.6, 50.0),
        (P, 1.0, 100.0),
        (P, 0.0, 0.0),
        (D(1, 3), math.nan, 0.0),
    ],
)
def test_a_map_scores_as_the_specification_says(map: Map, value: float, score: float) -> None:
    assert map.score(value) == pytest.approx(score)


def test_an_interval_is_that_of_whole_blocks_of_the_tunnel() -> None:
    station = np.arange(0.0, 50.0, 0.5)
    error = np.where((station >= 20.0) & (station < 30.0), 0.3, 0.1)
    found = estimate(mean, error, station, np.random.default_rng(0))
    assert found.interval == (pytest.approx(0.1), pytest.approx(0.22, abs=0.025))  # one block in five is worse
    assert load_values(dump_values({"one": found})) == {"one": found}
    assert estimate(mean, error[:3], station[:3], np.random.default_rng(0)).interval is None


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


def test_a_fresh_case_shares_data_and_no_results() -> None:
    case = tube.case()
    surface_nearest(case), truth_caster(case)
    fresh = case.fresh()
    assert fresh.candidate is case.candidate
    assert fresh.hold.range is case.hold.range
    assert not fresh.cache
    assert not fresh.hold.cache
    assert not fresh.truth.cache
