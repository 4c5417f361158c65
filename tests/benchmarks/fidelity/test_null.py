"""The null tube and the truth as candidate: known volumes, known axes."""

import numpy as np
import pytest

from benchmarks.fidelity import table
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.impostors import null_tube, truth_candidate
from benchmarks.fidelity.registry import compute_metric
from tests.benchmarks.fidelity import tube


@pytest.fixture(scope="module")
def case() -> Case:
    return tube.case(tube.Tube(variation=0.04, bend=90.0))


def score(case: Case, id: str) -> float:
    return table.load()[id].map.score(compute_metric(case, table.load()[id]).value or 0.0)


def judged(case: Case, candidate: object) -> Case:
    return Case(candidate, case.hold, None, case.truth)  # type: ignore[arg-type]


def test_the_null_tube_is_one_section_along_the_right_axis(case: Case) -> None:
    null = null_tube(case.candidate)
    np.testing.assert_array_equal(null.bore.position, case.candidate.bore.position)
    assert np.ptp(null.bore.width) == 0.0
    assert null.solid.is_volume
    angle = case.candidate.bore.angle
    area = 0.5 * np.trapezoid(null.bore.radius[0] ** 2, angle)
    assert null.solid.volume == pytest.approx(area * null.length, rel=0.02)
    assert len(null.bore.pocket) == 0


def test_the_null_tube_knows_nothing_of_pockets_and_variation(case: Case) -> None:
    null = judged(case, null_tube(case.candidate))
    for id in ("sec_variation_ratio", "sec_variation_corr", "lin_pocket_f1", "lin_depth_map_ncc"):
        assert score(null, id) < 20.0 < score(case, id), id


def test_the_truth_as_candidate_is_the_truth(case: Case) -> None:
    assert case.truth is not None
    made = truth_candidate(case.truth, case.candidate)
    assert made.solid.is_watertight
    assert made.solid.volume == pytest.approx(case.candidate.solid.volume, rel=1e-3)
    known = np.isfinite(made.bore.radius).all()
    assert known
    for id in ("sec_iou_mean", "sec_width_rmse", "cl_lateral_rmse"):
        assert score(judged(case, made), id) == 100.0, id
    noise = compute_metric(judged(case, made), table.load()["c2m_mean"]).value
    assert noise is not None
    assert noise < 0.0125  # of this tube's own recording; the noise floor is that of another sensor
