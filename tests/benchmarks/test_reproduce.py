"""The README's numbers are found where they are said to stand, and a number that differs is noticed."""

import dataclasses
import json
import re

import pytest

from benchmarks.reproduce.__main__ import README, main, verdict
from benchmarks.reproduce.claims import CLAIMS, ON_A_GPU, Claim, read_result
from benchmarks.reproduce.errors import ReproduceError
from benchmarks.reproduce.jobs import JOBS, Job, run

TEXT = README.read_text()
LENGTH = Claim("length, m", r"rings \| ([\d,.]+) m", "metro", lambda content: content["length"], 0.05)


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.name)
def test_every_number_stands_in_the_readme_and_has_a_job(claim):
    assert claim.stated(TEXT) is not None
    assert claim.job in JOBS


@pytest.mark.parametrize(("pattern", "command"), ON_A_GPU)
def test_every_number_of_a_gpu_stands_in_the_readme(pattern, command):
    assert re.search(pattern, " ".join(TEXT.split())), command


def test_a_number_is_read_over_line_breaks_and_thousands():
    assert LENGTH.stated("217 rings |\n1,283.7 m; more") == 1283.7
    assert LENGTH.stated("nothing of the kind") is None


@pytest.mark.parametrize(
    ("stated", "measured", "told"),
    [
        (1283.7, 1283.73, "same"),
        (1283.7, 1283.80, "differs"),
        (None, 1283.7, "not in the README"),
        (1283.7, None, "not measured: its input is not here"),
    ],
)
def test_a_number_beyond_its_tolerance_differs(stated, measured, told):
    assert verdict(LENGTH, stated, measured) == told


def test_a_speed_is_told_as_a_ratio():
    assert verdict(dataclasses.replace(LENGTH, speed=True), 2.0, 1.0).startswith("0.50 times")


def test_what_is_there_is_not_measured_again_and_is_held_against_the_readme(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "150")
    manifest = tmp_path / "metro" / "scene" / "manifest.json"
    manifest.parent.mkdir(parents=True)
    for length, status, told in ((1283.732, 0, "same"), (1290.0, 1, "differs")):
        manifest.write_text(json.dumps({"bore": {"length": length}}))
        assert main(["--jobs", "metro", "--out", str(tmp_path)]) == status
        assert told in capsys.readouterr().out
    assert json.loads((tmp_path / "reproduce.json").read_text())["rows"][0]["measured"] == 1290.0


def test_seeds_that_learnt_are_counted(tmp_path):
    for seed, success in enumerate((1.0, 0.5, 1.0)):
        (tmp_path / f"seed-{seed}").mkdir()
        line = {"success_mean_100": success, "coverage_mean_100": 0.95}
        (tmp_path / f"seed-{seed}" / "log.jsonl").write_text(json.dumps(line) + "\n")
    assert read_result(tmp_path / "seed-2" / "evaluation.json") == {"learnt": 2}


def test_a_job_that_fails_names_its_log_and_one_without_its_input_is_left_out(tmp_path):
    with pytest.raises(ReproduceError, match=r"log.txt: python -m json.tool ended with status"):
        run(Job("none", ("json.tool {out}/no.json",), "none.json", 0.1), tmp_path / "none", tmp_path)
    assert run(JOBS["metro"], tmp_path / "metro", tmp_path / "nowhere") is None


def test_a_job_that_does_not_exist_is_one_sentence_and_status_2(capsys):
    assert main(["--jobs", "everything"]) == 2
    assert capsys.readouterr().err.startswith("error: no job 'everything'; there are speed, ")
