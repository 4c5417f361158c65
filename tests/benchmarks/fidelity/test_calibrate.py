"""Thresholds move only where evidence says so, and to where it says."""

import json
from dataclasses import replace

import pytest

from benchmarks.fidelity import table
from benchmarks.fidelity.files import FidelityError
from benchmarks.fidelity.registry import Value
from benchmarks.fidelity.table import Metric
from benchmarks.fidelity.tools import calibrate
from benchmarks.fidelity.tools.calibrate import Survey

ROWS = calibrate.draft_table()
RESTLESS = {"deg_profile_corr", "lin_depth_map_ncc"}  # what half of the beams moves from the floor


def at(share: float, **single: float) -> dict[str, Value]:
    """Every metric at a share of its good end's distance from the ideal; some at a value."""
    made = {}
    for id, row in ROWS.items():
        good, _ = calibrate.map_ends(row.map)
        placed = calibrate.move_ends(row.map, share * good, 1.0)
        made[id] = Value(placed.good + row.map.target if row.map.kind == "B" else placed.good)
        if row.map.kind == "P":
            made[id] = Value(1.0)
    return made | {id: Value(value) for id, value in single.items()}


def survey(ceiling: dict[str, Value], null: dict[str, Value] | None = None, **spoilt: dict[str, Value]) -> Survey:
    """One survey whose null tube scores 0 everywhere unless another is given."""
    worst = {id: Value(distant(row)) for id, row in ROWS.items()}
    return Survey("one", at(0.1), ceiling, null or worst, {(name, 0.1): values for name, values in spoilt.items()})


def distant(row: Metric) -> float:
    """The value of a metric that scores 0."""
    return row.map.bad + (row.map.target if row.map.kind == "B" else 0.0)


def moves(*surveys: Survey) -> dict[str, tuple[Metric, str]]:
    return calibrate.calibrate(ROWS, {}, list(surveys))


def test_nothing_moves_where_the_truth_reaches_every_good_end() -> None:
    assert moves(survey(at(0.9))) == {}


def test_a_good_end_that_the_truth_misses_moves_to_one_and_a_half_times_what_it_reaches() -> None:
    good = ROWS["c2m_mean"].map.good
    found = moves(survey(at(0.1, c2m_mean=1.2 * good)))
    assert list(found) == ["c2m_mean"]
    assert found["c2m_mean"][0].map.good == pytest.approx(1.8 * good)
    assert "truth itself" in found["c2m_mean"][1]


def test_a_share_that_the_truth_misses_moves_by_its_shortfall() -> None:
    row = ROWS["occ2d_free_iou"]
    found = moves(survey(at(0.1, occ2d_free_iou=row.map.good - 0.02)))
    assert found["occ2d_free_iou"][0].map.good == pytest.approx(1.0 - 1.5 * (1.0 - row.map.good + 0.02), abs=1e-3)


def test_a_bad_end_moves_to_what_a_control_reaches_that_falls_too_little() -> None:
    row = ROWS["cl_lateral_rmse"]
    reached = 0.5 * (row.map.good + row.map.bad)
    found = moves(survey(at(0.1), N07=at(0.1, cl_lateral_rmse=reached)))
    assert found["cl_lateral_rmse"][0].map.bad == pytest.approx(reached, rel=0.06)
    assert found["cl_lateral_rmse"][0].map.good == row.map.good
    assert "N07" in found["cl_lateral_rmse"][1]


def test_a_null_tube_that_meets_the_draft_moves_the_good_end_to_half_of_its_error() -> None:
    good = ROWS["c2m_p95"].map.good
    null = {id: Value(distant(row)) for id, row in ROWS.items()} | {"c2m_p95": Value(0.9 * good)}
    found = moves(survey(at(0.1), null))
    assert list(found) == ["c2m_p95"]
    assert found["c2m_p95"][0].map.good == pytest.approx(0.45 * good, rel=0.06)
    assert found["c2m_p95"][0].map.bad == pytest.approx(3.0 * found["c2m_p95"][0].map.good, rel=0.05)


def test_a_null_tube_as_good_as_the_truth_moves_nothing() -> None:
    good = ROWS["c2m_p95"].map.good
    null = {id: Value(distant(row)) for id, row in ROWS.items()} | {"c2m_p95": Value(0.9 * good)}
    assert moves(survey(at(0.1, c2m_p95=0.6 * good), null)) == {}


def test_what_was_decided_by_hand_is_kept_with_its_reason_and_no_rule_touches_it() -> None:
    decided = calibrate.decided_rows(ROWS)
    found = calibrate.calibrate(ROWS, decided, [survey(at(5.0))])
    for id, (row, reason) in decided.items():
        assert reason
        assert found[id] == (row, reason)


def test_a_metric_that_does_not_see_the_control_stays() -> None:
    found = moves(survey(at(0.1), N07=at(0.1)))
    assert found == {}


def test_what_was_moved_reads_back_from_the_text_of_its_map() -> None:
    for row in table.load().values():
        assert table.parse_map(table.map_text(row.map)) == row.map, row.id


def test_a_threshold_is_not_tightened_beyond_what_an_invariance_moves_it() -> None:
    good = ROWS["c2m_p95"].map.good
    null = {id: Value(distant(row)) for id, row in ROWS.items()} | {"c2m_p95": Value(0.9 * good)}
    restless = replace(survey(at(0.1), null), same={"I7": at(0.1, c2m_p95=0.25 * good)})
    assert moves(restless)["c2m_p95"][0].map.good == pytest.approx(5.0 * 0.15 * good, rel=0.06)


def test_at_the_noise_floor_the_truth_has_full_marks_on_every_survey_and_nothing_worse_has() -> None:
    reached = [at(0.5), at(0.9)]
    surveys = [survey(one) for one in reached]
    for row in ROWS.values():
        floor = calibrate.noise_floor(row, surveys)
        if floor is None:
            assert not row.scored or row.map.kind == "P" or not set(row.evidence) & set("HT"), row.id
            continue
        honest = replace(row.map, good=floor)
        assert [honest.score(one[row.id].value) for one in reached] == [100.0, 100.0], row.id
        if calibrate.map_ends(row.map)[0] == 0.0:  # a count, which is none or some
            continue
        worse = at(1.0)[row.id].value
        assert row.map.score(worse) == pytest.approx(100.0)
        assert honest.score(worse) < 99.999, row.id


def test_a_metric_on_which_the_truth_scores_nothing_has_no_floor() -> None:
    row = ROWS["c2m_mean"]
    with pytest.raises(FidelityError, match="c2m_mean: the truth itself"):
        calibrate.noise_floor(row, [survey(at(0.1, c2m_mean=row.map.bad))])


def test_a_metric_that_half_of_the_beams_moves_from_its_floor_keeps_its_wider_end() -> None:
    row = ROWS["c2m_mean"]
    quiet = survey(at(0.1))
    assert calibrate.noise_floor(row, [replace(quiet, same={"I7": at(0.1)})]) is not None
    moved = replace(quiet, same={"I7": at(0.1, c2m_mean=0.3 * row.map.bad)})
    assert calibrate.noise_floor(row, [moved]) is None


def test_every_metric_with_a_reference_is_scored_from_its_noise_floor() -> None:
    frozen = json.loads(table.THRESHOLDS.read_text())
    assert frozen["floor_surveys"] == ["411", "412", "413"]
    rows = table.load()
    measured = [
        id for id, row in rows.items() if row.scored and row.map.kind in "DUB" and set(row.evidence) & set("HT")
    ]
    without = {"c2m_fit_hold_gap"}  # nothing for it without the recording that the builder read
    assert set(frozen["floors"]) | RESTLESS == set(measured) - without
    assert not set(frozen["floors"]) & RESTLESS
    for id, floor in frozen["floors"].items():
        assert rows[id].map.good == floor
        assert rows[id].map.good != rows[id].map.bad
