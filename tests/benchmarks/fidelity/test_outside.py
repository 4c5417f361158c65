"""The table of metrics; those from outside, registered by a file or by Python, refused in one sentence."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.fidelity import judge, outside, table
from benchmarks.fidelity.__main__ import main
from benchmarks.fidelity.derive.sections import truth_caster
from benchmarks.fidelity.derive.surface import surface_nearest
from benchmarks.fidelity.faults import Fault, Site, put_in
from benchmarks.fidelity.faults.kinds import asked_faults
from benchmarks.fidelity.faults.runner import Bench, Job, judge_outcomes, list_jobs, run_jobs
from benchmarks.fidelity.files import FidelityError
from benchmarks.fidelity.registry import Samples, Value, dump_values, estimate, load_values, mean, number
from benchmarks.fidelity.table import B, D, Map, P, U, metric
from tests.benchmarks.fidelity import tube
from tests.benchmarks.fidelity.test_verdicts import values

HEAD = "from benchmarks.fidelity.faults import fault_kind\nfrom benchmarks.fidelity.table import B, D, P, U, metric\n"
ROWS = Path(__file__).with_name("mistakes.txt").read_text().splitlines()[1:]
MISTAKES = dict(row.split(" => ") for row in ROWS)


@pytest.fixture(autouse=True)
def nothing_registered():
    yield
    outside.clear()


@pytest.mark.parametrize("code", MISTAKES)
def test_a_mistake_in_the_file_is_one_sentence_and_status_2(code: str, tmp_path: Path, monkeypatch, capsys) -> None:
    file = tmp_path / "mine.py"
    file.write_text(HEAD + code + "\n")
    monkeypatch.setattr(sys, "argv", ["fidelity", "run", "--metrics", str(file), "--out", str(tmp_path / "out")])
    assert main() == 2
    said = capsys.readouterr().err.strip()
    assert said.startswith(f"error: {file}: ")
    assert MISTAKES[code] in said
    assert "\n" not in said


def test_a_fault_from_outside_that_raises_or_returns_nothing_is_named(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(f'{HEAD}fault_kind("a", "a")(print)\nfault_kind("b", "b")(lambda *_: 1 / 0)\n')
    outside.load_file(tmp_path / "mine.py")
    for name, why in (("a", "returns NoneType"), ("b", "ZeroDivisionError")):
        with pytest.raises(FidelityError, match=f"fault '{name}': {why}"):
            put_in(Site(tube.case()), Fault(name))


def test_a_file_that_is_not_there_is_said_so(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["fidelity", "run", "--metrics", "none.py", "--out", str(tmp_path / "out")])
    assert main() == 2
    assert capsys.readouterr().err.strip() == "error: none.py: cannot be read (No such file or directory)"


def test_metrics_are_scored_beside_the_suite_and_leave_it_alone(tmp_path: Path) -> None:
    calls, digest = [], judge.constants_digest()

    @metric("lin_given", "LIN", D(1, 3), "m", needs="truth")
    def given(case) -> Value:
        calls.append(case.candidate.name)
        return number(2.0)

    metric("lin_float", "LIN")(lambda case: 4.0)
    metric("lin_along", "LIN", of=np.mean, args=(2.0,))(lambda case, k: Samples(k * np.arange(60), np.arange(60.0)))
    metric("sec_broken", "SEC", U(0, 1))(lambda case: 1 / 0)
    case = tube.case(tube.Tube(length=6.0))
    suite = values(1.0)
    judged = judge.make_judgement({"base": suite, "null": suite, "ceiling": suite}, [])
    with_outside = judge.add_outside(judged, case)
    assert with_outside.scored is judged.scored
    assert with_outside.reasons == judged.reasons
    assert judge.constants_digest() == digest
    base = with_outside.outside["base"]
    assert base.scores["lin_given"].score == 50.0
    assert base.scores["lin_float"].score is None
    assert base.scores["lin_float"].value == Value(4.0)
    along = base.scores["lin_along"].value
    assert (along.value, along.n) == (59.0, 60)
    assert along.interval[0] < 59.0 < along.interval[1]
    assert base.scores["sec_broken"].score == 0.0
    assert base.scores["sec_broken"].value.reason == "ZeroDivisionError: division by zero"
    scored = [row for row in table.load().values() if row.category == "LIN" and row.scored]
    assert base.categories["LIN"] == pytest.approx((100.0 * len(scored) + 50.0) / (len(scored) + 1))
    assert judged.scored["base"].categories["LIN"] == 100.0
    assert len(calls) == 3  # reconstruction, null tube, truth
    assert outside.metrics()["lin_given"].number == len(table.load()) + 1
    assert len(table.load_all()) == len(table.load()) + 4


DENT = """
@fault_kind("dent", "lining 1 cm smaller", "m", doses=(0.01, 0.1), falls={"C2M": 10.0})
def dent(site, fault):
    return site.moved(lambda local: -fault.size * fault.weight(local[:, 0])[:, None] * [0.0, 0.3, 0.3], ("lining",))
"""


def test_a_fault_of_a_file_is_a_control_and_a_ladder_beside_the_suite(tmp_path: Path, monkeypatch, capsys) -> None:
    file = tmp_path / "mine.py"
    file.write_text(HEAD + DENT)
    digest = judge.constants_digest()
    outside.load_file(file)
    assert judge.constants_digest() == digest
    assert list_jobs(("dent",)) == [Job("dent", 0.01), Job("dent", 0.1)]
    assert asked_faults()["dent"].size == 0.1
    case = tube.case(tube.Tube(length=12.0), beams=500)

    def compute(corrupted, categories, reuse):
        moved = np.abs(corrupted.candidate.lining.vertices - case.candidate.lining.vertices).max()
        return reuse | {id: Value(1.0) for id, row in table.load().items() if row.category == "C2M" and moved > 0.02}

    outcomes = run_jobs(Bench(case, values(1.0), compute=compute, more=file), list_jobs(("dent",)), processes=1)
    rows = judge_outcomes(outcomes, judge.make_judgement({"base": values(1.0), "null": values(1.0)}, []))
    assert [(row["kind"], row["detected"]) for row in rows] == [("outside", False), ("outside", True)]
    assert judge.undetected([row | {"detected": False} for row in rows]) == []
    outside.clear()
    assert list_jobs(("dent",)) == []
    words = ["faults", "--kinds", "dent", "--scene", "none", "--metrics", str(file)]
    monkeypatch.setattr(sys, "argv", ["fidelity", *words])
    assert main() == 2
    assert "none" in capsys.readouterr().err  # and not that the kind is unknown


def test_there_are_18_categories_and_199_metrics_with_unique_ids() -> None:
    rows = list(table.load().values())
    assert len(table.CATEGORIES) == 18
    assert len(rows) == 199
    assert [row.number for row in rows] == list(range(1, len(rows) + 1))
    assert len({row.id for row in rows}) == len(rows)


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
