import json
import sys

import numpy as np
import pytest

from benchmarks.learning import __main__ as learning
from benchmarks.learning.runs import Curve


def run(coverage, success):
    n = len(coverage)
    return Curve("one", 50 * np.arange(1, n + 1), 0.5 * np.arange(1, n + 1), np.array(coverage), np.array(success))


def test_the_goal_is_met_when_the_last_hundred_cover_nine_tenths_and_none_of_them_failed():
    # The failure of episode 60 is among the last hundred until episode 159.
    success = np.ones(200, bool)
    success[59] = False
    assert run(np.full(200, 0.91), success).reached() == {"episodes": 160, "steps": 8000, "seconds": 80.0}
    assert run(np.full(99, 1.0), np.ones(99, bool)).reached() is None
    assert run(np.full(200, 0.89), np.ones(200, bool)).reached() is None
    assert run([], []).reached() is None


def test_table_figure_and_file_say_the_same(tmp_path, capsys):
    learning.report(tmp_path, [run(np.full(120, 0.95), np.ones(120, bool)), run([], [])], {"task": "T0"})
    line = next(line for line in capsys.readouterr().out.splitlines() if "one" in line)
    assert line.replace("│", " ").split() == ["one", "100", "5,000", "50.0", "0.0", "s", "100"]
    first, second = json.loads((tmp_path / "learning.json").read_text())["runs"]
    assert first["reached"] == {"episodes": 100, "steps": 5000, "seconds": 50.0}
    assert second["reached"] is None
    assert (tmp_path / "learning.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--task", "Subterra/Nowhere-v1"), "no task 'Subterra/Nowhere-v1'"),
        (("--task", "Subterra/StopAt-v1"), "task Subterra/StopAt-v1 is not one of coverage"),
        (("--steps", "0"), "steps must be at least 1, got 0"),
        (("--tunnel", "nowhere.npz"), "nowhere.npz: no such tunnel file"),
    ],
)
def test_a_mistake_is_one_sentence_and_status_2(tmp_path, capsys, monkeypatch, arguments, message):
    monkeypatch.setattr(sys, "argv", ["learning", "--out", str(tmp_path / "out"), *arguments])
    assert learning.main() == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_both_learn_the_papers_task_on_60_m(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["learning", "--out", str(tmp_path)])
    assert learning.main() == 0
    ours, theirs = json.loads((tmp_path / "learning.json").read_text())["runs"]
    assert ours["reached"]["seconds"] < theirs["reached"]["seconds"]
