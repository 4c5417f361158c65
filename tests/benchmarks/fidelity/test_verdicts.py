"""Sweep, verdicts of controls and all written forms, on values that are made to be known."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest

from benchmarks.fidelity import judge, report, scoring, sweep, table
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.controls import verdicts
from benchmarks.fidelity.controls.kept import Job, Outcome
from benchmarks.fidelity.controls.runner import Bench, failures, one, run
from benchmarks.fidelity.controls.verdicts import Base
from benchmarks.fidelity.inputs import Inputs
from benchmarks.fidelity.value import Value, missing
from tests.benchmarks.fidelity import tube

Values = dict[str, Value]


def values(quality: float, worse: tuple[str, ...] = (), much: float = 0.0) -> Values:
    """Every metric at a share of the way from its bad end to its good one; some categories at another."""
    made = {}
    for id, row in table.load().items():
        share = much if row.category in worse else quality
        distance = row.map.bad + share * (row.map.good - row.map.bad)
        made[id] = Value(distance + (row.map.target if row.map.kind == "B" else 0.0))
        if row.map.kind == "P":
            made[id] = Value(float(share > 0.5))
    return made


def base() -> Base:
    all_of = {"base": values(0.98), "null": values(0.8), "ceiling": values(1.0)}
    scored = {name: scoring.score_all(entry) for name, entry in all_of.items()}
    return Base(scored["base"], scored["null"], all_of, [])


def outcome(control: str, dose: float, made: Values, leaks: tuple[str, ...] = ()) -> Outcome:
    return Outcome(Job(control, dose), made, list(leaks))


def test_a_good_reconstruction_passes_and_a_null_tube_beside_it_does_not() -> None:
    made = {"base": values(0.98), "null": values(0.8), "null_bare": values(0.7), "ceiling": values(1.0)}
    found = judge.judged(made, [])
    assert found.verdict == "PASS", found.reasons
    assert found.skill == pytest.approx(0.9, abs=0.02)
    assert judge.judged(made | {"base": made["null"]}, []).verdict == "FAIL"
    assert judge.judged(made, ["the builder read it"]).reasons == ["leak: the builder read it"]


def test_a_control_that_falls_as_asked_is_detected() -> None:
    (row,) = verdicts.rows([outcome("N24", 1.445, values(0.98, ("TRK",), 0.3))], base())
    assert row["detected"]
    assert row["quiet"]
    assert row["falls"]["TRK"] == pytest.approx(68.0, abs=2.0)


def test_a_control_that_changes_nothing_is_not_detected() -> None:
    rows = verdicts.rows([outcome("N24", 1.445, values(0.98))], base())
    assert verdicts.undetected(rows) == ["N24"]
    assert rows[0]["short"] == {"TRK": (pytest.approx(0.0), 15.0)}


def test_a_control_that_fails_only_by_another_category_is_not_detected() -> None:
    rows = verdicts.rows([outcome("N24", 1.445, values(0.98, ("SEC",), 0.3))], base())
    assert rows[0]["verdict"] == "FAIL"
    assert verdicts.undetected(rows) == ["N24"]
    assert not rows[0]["quiet"]


def test_a_cheat_is_detected_by_its_leak_alone() -> None:
    rows = verdicts.rows([outcome("N35", 1, values(1.0), ("no noise",)), outcome("N35", 2, values(1.0))], base())
    assert [row["detected"] for row in rows] == [True, False]


def test_growing_doses_give_a_rank_correlation_of_minus_one() -> None:
    doses = [(0.61, 0.9), (0.63, 0.6), (0.66, 0.1)]
    rows = verdicts.rows([outcome("N23", d, values(0.98, ("TRK",), q)) for d, q in doses], base())
    assert rows[0]["spearman"] == pytest.approx(-1.0)


def test_an_invariance_that_moves_a_category_is_loud() -> None:
    rows = verdicts.rows([outcome("I1", 0, values(0.98)), outcome("I4", 0, values(0.98, ("LIN",), 0.9))], base())
    assert verdicts.loud(rows) == ["I4"]


def test_reasons_are_compared_without_their_figures() -> None:
    assert failures(["category F2D is 61.2, below 70"]) == failures(["category F2D is 12.9, below 70"])
    assert failures(["category F2D is 61.2, below 70"]) != failures(["category F3D is 61.2, below 70"])


def test_the_sweep_has_its_runs_and_moves_scores_by_the_closed_form() -> None:
    rows = sweep.thresholds({"base": values(0.95), "null": values(0.5), "ceiling": values(1.0)})
    assert [sum(row["kind"] == kind for row in rows) for kind in ("common", "category", "independent")] == [2, 36, 128]
    looser, tighter = (next(r for r in rows if r["run"] == name) for name in ("x1.1", "x0.9"))
    assert looser["delta"] > 0.0 > tighter["delta"]
    assert all(row["order_kept"] for row in rows)
    summary = sweep.summary(rows)
    assert summary["independent"]["most"] - summary["independent"]["least"] < looser["delta"] - tighter["delta"]


def test_the_order_is_lost_where_the_null_tube_overtakes() -> None:
    rows = sweep.thresholds({"base": values(0.5), "null": values(0.9)})
    assert not any(row["order_kept"] for row in rows)


def test_all_forms_are_written_and_agree(tmp_path: Path) -> None:
    case = replace(tube.case(), hold=None, truth=None, cache={})
    made = {
        "base": {**values(0.98), "c2m_mean": missing("no held-out recording")},
        "null": values(0.7),
        "null_bare": values(0.6),
    }
    controls = verdicts.rows([outcome("N24", 1.445, values(0.98, ("TRK",), 0.3))], base())
    judgement = judge.judged(made, [], controls)
    swept = {"rows": sweep.thresholds(made), "summary": {}}
    swept["summary"] = sweep.summary(swept["rows"])
    report.write(tmp_path, case, Inputs(out=tmp_path), judgement, controls, swept)
    content = json.loads((tmp_path / "report.json").read_text())
    with (tmp_path / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 199
    assert [row["id"] for row in rows] == [entry["id"] for entry in content["metrics"]]
    assert next(row for row in rows if row["id"] == "c2m_mean")["score"] == ""
    page = (tmp_path / "report.html").read_text()
    assert "Self-consistency of tube" in page
    assert page.index(content["verdict"]) < page.index("Categories")
    assert 'src="http' not in page
    suite = ElementTree.fromstring((tmp_path / "junit.xml").read_text())
    assert int(suite.get("tests") or 0) == sum(row.role == "G" for row in table.load().values()) + 18 + 1
    assert {"F13-categories.png", "F14-controls.png", "F15-sweep.svg"} <= {
        p.name for p in (tmp_path / "figures").iterdir()
    }


def test_the_same_values_write_the_same_bytes(tmp_path: Path) -> None:
    case = replace(tube.case(), hold=None, truth=None, cache={})
    judgement = judge.judged({"base": values(0.98), "null": values(0.7)}, [])
    for name in ("one", "other"):
        report.write(tmp_path / name, case, Inputs(), judgement, None, None)
    for file in ("report.json", "metrics.csv", "report.html", "figures/F13-categories.svg"):
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "other" / file).read_bytes()


def test_controls_are_kept_and_taken_up_again(tmp_path: Path) -> None:
    calls: list[str] = []

    def compute(case: Case, categories: object, reuse: Values) -> Values:
        calls.append(case.candidate.name)
        return reuse

    bench = Bench(tube.case(), values(0.9), tmp_path, None, compute)
    jobs = [Job("N07", 0.1), Job("I6", 0.0)]
    first = run(bench, jobs, processes=1)
    again = run(bench, jobs, processes=1)
    assert len(calls) == 2
    assert [o.values for o in again] == [o.values for o in first]
    assert one(bench, jobs[0]).job == jobs[0]
