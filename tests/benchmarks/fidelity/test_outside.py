"""Metrics from outside: registered by a file or by Python, refused in one sentence."""

import sys
from pathlib import Path

import pytest

from benchmarks.fidelity import judge, outside, table
from benchmarks.fidelity.__main__ import main
from benchmarks.fidelity.files import FidelityError
from benchmarks.fidelity.registry import Value, number
from tests.benchmarks.fidelity import tube

HEAD = "from benchmarks.fidelity.outside import register\n"
MISTAKES = {
    'register("lin_x", lambda case: 1.0, category="LNI", definition="x")': "metric 'lin_x': unknown category 'LNI'",
    'register("c2m_mean", lambda case: 1.0, category="C2M", definition="x")': "metric 'c2m_mean': this id belongs to",
    'register("lin_x", 1.0, category="LIN", definition="x")': "compute must be a function of a Case, got float",
    'register("lin_x", lambda case: 1.0, category="LIN", definition="x", map="D(1)")': "'D(1)' is no score map",
    'register("lin_x", lambda case: 1.0, category="LIN", definition="x", needs="luck")': "needs must be hold, truth",
    'for _ in "ab": register("lin_x", lambda case: 1.0, category="LIN", definition="x")': "is registered twice",
    "undefined": "cannot be run (NameError: name 'undefined' is not defined)",
    "import": "cannot be run (SyntaxError: ",
    "": "registers no metric",
}


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


def test_a_file_that_is_not_there_is_said_so(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["fidelity", "run", "--metrics", "none.py", "--out", str(tmp_path / "out")])
    assert main() == 2
    assert capsys.readouterr().err.strip() == "error: none.py: cannot be read (No such file or directory)"


def test_metrics_are_scored_beside_the_suite_and_leave_it_alone(tmp_path: Path) -> None:
    calls = []

    @outside.register("lin_given", category="LIN", definition="given", unit="m", map="D(1,3)", needs="truth")
    def given(case) -> Value:
        calls.append(case.candidate.name)
        return number(2.0)

    outside.register("lin_float", lambda case: 4.0, category="LIN", definition="a float, listed")
    outside.register("sec_broken", lambda case: 1 / 0, category="SEC", definition="broken", map="U(0,1)")
    case = tube.case(tube.Tube(length=6.0))
    suite = {id: Value(1.0 if row.map.kind == "P" else row.map.target if row.map.kind == "B" else row.map.good)
             for id, row in table.load().items()}  # fmt: skip
    judged = judge.make_judgement({"base": suite, "null": suite, "null_bare": suite, "ceiling": suite}, [])
    with_outside = judge.add_outside(judged, case, tmp_path)
    assert with_outside.scored is judged.scored
    assert with_outside.reasons == judged.reasons
    base = with_outside.outside["base"]
    assert base.scores["lin_given"].score == 50.0
    assert base.scores["lin_float"].score is None
    assert base.scores["lin_float"].value == Value(4.0)
    assert base.scores["sec_broken"].score == 0.0
    assert base.scores["sec_broken"].value.reason == "ZeroDivisionError: division by zero"
    scored = [row for row in table.load().values() if row.category == "LIN" and row.scored]
    assert base.categories["LIN"] == pytest.approx((100.0 * len(scored) + 50.0) / (len(scored) + 1))
    assert judged.scored["base"].categories["LIN"] == 100.0
    assert len(calls) == 4  # reconstruction, two null tubes, truth
    assert outside.metrics()["lin_given"].row.number == 200
    assert len(outside.rows()) == 202
    assert len(table.load()) == 199


def test_metrics_from_outside_do_not_move_the_digest_of_the_constants() -> None:
    before = judge.constants_digest()
    outside.register("lin_more", lambda case: 1.0, category="LIN", definition="more", map="U(0,1)")
    assert judge.constants_digest() == before


def test_a_value_that_is_no_number_counts_as_failed(tmp_path: Path) -> None:
    outside.register("lin_text", lambda case: "much", category="LIN", definition="text", map="U(0,1)")
    case = tube.case(tube.Tube(length=6.0))
    values = outside.compute_values(case, {"base": lambda: case.candidate}, tmp_path)
    assert values["base"]["lin_text"].failed
    assert values["base"]["lin_text"].reason.startswith("ValueError: ")


def test_values_of_a_file_are_kept_until_the_file_changes(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    case = tube.case(tube.Tube(length=6.0))
    values = []
    for factor in (1.0, 1.0, 2.0):
        text = f'register("lin_mine", lambda case: {factor}, category="LIN", definition="mine")\n'
        file.write_text(HEAD + text)
        outside.load_metrics(file)
        values.append(outside.compute_values(case, {"base": lambda: case.candidate}, tmp_path)["base"]["lin_mine"])
    assert [value.value for value in values] == [1.0, 1.0, 2.0]


def test_the_python_function_refuses_what_the_file_may_not_hold() -> None:
    with pytest.raises(FidelityError, match="unknown category 'XYZ'; choose one of CEN, SEC"):
        outside.register("x", lambda case: 1.0, category="XYZ", definition="x")
