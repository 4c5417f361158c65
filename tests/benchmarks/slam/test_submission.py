"""Submissions to the hidden half: what can be scored passes, and each fault is one sentence."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.command import BenchmarkError
from benchmarks.slam.submission import SubmissionConfig, check_submission
from tests.benchmarks.slam.tracks import line, write_tum


@pytest.fixture
def config(tmp_path: Path) -> SubmissionConfig:
    for name in ("one", "two"):
        bag = tmp_path / "set" / "recordings" / name / "recording"
        write_tum(bag / "odometry.tum", *line())
        (bag / "metadata.yaml").write_text("")
        write_tum(tmp_path / "mine" / f"{name}.tum", *line())
    (tmp_path / "mine" / "program.json").write_text(json.dumps({"name": "fast", "version": "2", "command": "run it"}))
    return SubmissionConfig(tmp_path / "mine", tmp_path / "set")


def test_a_whole_submission_passes(config):
    assert check_submission(config) == ["fast 2", "one.tum: 401 poses over 100 % of the recording",
                                        "two.tum: 401 poses over 100 % of the recording"]  # fmt: skip


def late(path: Path) -> None:
    time, position, turn = line()
    write_tum(path, time + 1e6, position, turn)


def few(path: Path) -> None:
    time, position, turn = line()
    some = np.array([0, 200, 400])
    write_tum(path, time[some], position[some], turn[some])


def half(path: Path) -> None:
    time, position, turn = line()
    write_tum(path, time[:200], position[:200], turn[:200])


def camera(path: Path) -> None:
    time, position, turn = line()
    write_tum(path, time, position, turn * Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]))


def cut(path: Path) -> None:
    path.write_text(path.read_text()[:-30] + "x")


@pytest.mark.parametrize(("corrupt", "sentence"), [
    (late, "shares 0 of its 401 times"), (few, "has 3 poses in 40 s; at least 1 a second"),
    (half, "covers 50 % of the recording; 90 % are needed"), (camera, "looks 90° away from where it drives"),
    (cut, "two.tum"), (Path.unlink, "two.tum is missing"),
])  # fmt: skip
def test_each_fault_of_a_file_is_one_sentence(config, corrupt, sentence):
    corrupt(config.submission / "two.tum")
    with pytest.raises(BenchmarkError, match=sentence) as told:
        check_submission(config)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(("text", "sentence"), [
    ("{", "is no JSON"), ("[]", "has no 'name'"), ('{"name": "a", "version": 2}', "has no 'version'"),
])  # fmt: skip
def test_a_submission_says_what_ran(config, text, sentence):
    (config.submission / "program.json").write_text(text)
    with pytest.raises(BenchmarkError, match=sentence):
        check_submission(config)
