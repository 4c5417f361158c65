"""Figures come with their data, at the size of a column, and what is made is not made again."""

import csv
import json
import re
import shutil

import numpy as np
import pytest
from PIL import Image

from benchmarks.command import BenchmarkError
from benchmarks.paper.__main__ import main
from benchmarks.paper.learning import find_runs
from benchmarks.paper.steps import Step, is_done, make, scene_step, survey_step, training_step


def write_run(folder, coverage, task="Subterra/TraverseShort-v1"):
    folder.mkdir(parents=True)
    told = {"task": task, "tunnel": "corridor", "tunnel_provenance": "simulated", "device": "cpu: cpu"}
    (folder / "config.json").write_text(json.dumps(told))
    rows = [f"{k + 1},{10 * (k + 1)},{value:.9g},{int(value >= 0.9)},10,0" for k, value in enumerate(coverage)]
    (folder / "episodes.csv").write_text("\n".join(["episode,step,coverage,success,length,contact", *rows]) + "\n")


@pytest.fixture(scope="module")
def drawn_once(tmp_path_factory):
    """Figure 4 of two seeds that learn in one step, after 100 and after 120 episodes; and the runs beside it."""
    folder = tmp_path_factory.mktemp("figures")
    write_run(folder / "runs" / "seed-10", [0.1] * 120 + [0.9] * 190)
    write_run(folder / "runs" / "seed-2", [0.1] * 100 + [0.9] * 200)
    assert draw(folder) == 0
    return folder


@pytest.fixture
def figures(drawn_once, tmp_path):
    """A copy that a test may change."""
    return shutil.copytree(drawn_once, tmp_path / "figures")


def draw(folder):
    return main(["--figures", "4", "--runs", str(folder / "runs"), "--out", str(folder)])


def test_learning_curves_are_the_rolling_hundred_with_mean_and_spread(drawn_once):
    with (drawn_once / "fig4.csv").open() as file:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
    assert len(rows) == 300  # as far as both go
    assert rows[149]["coverage_seed-2"] == pytest.approx(0.5)
    assert rows[149]["coverage_seed-10"] == pytest.approx(0.34)
    assert rows[149]["coverage_mean"] == pytest.approx(0.42)
    assert rows[149]["coverage_sd"] == pytest.approx(0.16 / np.sqrt(2.0))
    assert rows[149]["success_mean"] == pytest.approx(0.4)
    content = json.loads((drawn_once / "fig4.json").read_text())
    assert content["facts"]["first_at_goal"] == 220
    assert "after 220 episodes" in content["caption"]
    assert "corridor (simulated survey), 2 seeds, on cpu." in content["provenance"]


def test_a_figure_is_as_wide_as_a_column_with_text_as_text(drawn_once):
    pdf = (drawn_once / "fig4.pdf").read_bytes()
    assert float(re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ", pdf)[1]) == pytest.approx(3.5 * 72.0)
    assert b"/FontFile2" in pdf  # TrueType, embedded
    with Image.open(drawn_once / "fig4.png") as image:
        assert image.width == 1050
        assert image.info["dpi"][0] == pytest.approx(300.0, abs=0.1)


def test_what_is_drawn_is_not_drawn_again_unless_lost_and_then_comes_to_the_same_bytes(figures, capsys):
    before = {path.name: path.read_bytes() for path in figures.glob("fig4.*")}
    assert draw(figures) == 0
    assert "fig4.pdf is there" in capsys.readouterr().out
    (figures / "fig4.png").unlink()
    assert draw(figures) == 0
    assert "drawing" in capsys.readouterr().out
    assert {path.name: path.read_bytes() for path in figures.glob("fig4.*")} == before


def test_a_figure_is_drawn_again_when_its_input_changes(figures, capsys):
    write_run(figures / "runs" / "seed-3", [0.5] * 150)
    assert draw(figures) == 0
    assert "drawing" in capsys.readouterr().out
    assert "coverage_seed-3" in (figures / "fig4.csv").read_text().splitlines()[0]


def test_runs_are_in_the_order_of_their_seeds_and_of_one_task(figures, capsys):
    assert [run.name for run in find_runs(figures / "runs")] == ["seed-2", "seed-10"]
    write_run(figures / "runs" / "seed-11", [0.5], task="Subterra/StopAt-v1")
    assert draw(figures) == 2
    told = capsys.readouterr().err
    assert told.startswith("error: ")
    assert "seed-11: is a run of Subterra/StopAt-v1, but seed-2 of Subterra/TraverseShort-v1" in told


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--figures", "5"], "error: no figure 5; there are 1, 2, 3, 4\n"),
        (["--survey", "nowhere"], "error: nowhere: no such folder\n"),
        (["--scene", "nowhere"], "error: scene nowhere needs the survey"),
        (["--figures", "4", "--runs", "tests"], "error: tests: holds no run folders seed-0"),
        (["--survey", "tests", "--scene", "tests"], "error: tests/survey.bag: no such file\n"),
    ],
)
def test_a_mistake_is_one_sentence_and_status_2(words, told, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tests").mkdir()
    assert main([*words, "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.startswith(told)


def test_a_step_is_done_once_and_again_when_its_words_or_inputs_change(tmp_path, capfd):
    source, out = tmp_path / "source.json", tmp_path / "out"
    out.mkdir()
    source.write_text("[1]")
    step = Step("copy", ("json.tool", str(source), str(out / "copy.json")), out, ("copy.json",), inputs=(source,))
    assert not is_done(step)
    make(step)
    assert is_done(step)
    make(step)
    assert f"{out} is there" in capfd.readouterr().out
    source.write_text("[2]")
    assert not is_done(step)
    make(step)
    assert json.loads((out / "copy.json").read_text()) == [2]
    (out / "copy.json").unlink()
    assert not is_done(step)


def test_a_step_that_fails_names_its_command_and_is_not_done(tmp_path):
    step = Step("copy", ("json.tool", str(tmp_path / "none.json")), tmp_path / "out", ("copy.json",))
    with pytest.raises(BenchmarkError, match=r"out: python -m json\.tool ended with status"):
        make(step)
    assert not is_done(step)


def test_the_steps_are_the_users_own_commands(tmp_path):
    survey = survey_step(tmp_path / "survey", 60.0, 3)
    scene = scene_step(tmp_path / "scene", survey.out, "subterra-60", "simulated")
    assert "--length 60 --seed 3 --sensors avia os1" in " ".join(survey.words)
    assert scene.words[:2] == ("scene.build", str(survey.out / "survey.bag"))  # the Avia; the OS1 is held out
    assert "--seeds 0 1 2 3 4 --preset cpu" in " ".join(training_step(tmp_path / "training", scene.out).words)


@pytest.mark.slow
def test_the_whole_command_draws_a_short_survey(tmp_path):
    out = tmp_path / "figures"
    words = ["--figures", "1", "2", "3", "--length", "30", "--out", str(out)]
    assert main(words) == 0
    facts = {number: json.loads((out / f"fig{number}.json").read_text()) for number in (1, 2, 3)}
    assert all("Simulated survey (metro, 30 m, seed 0" in content["provenance"] for content in facts.values())
    assert facts[1]["facts"]["residual_median"] < 0.03
    assert facts[3]["facts"]["pixels"]["both"] > 0.97
    assert facts[3]["facts"]["f1_one_voxel"] > 0.99
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    assert main(words) == 0
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()} == before
