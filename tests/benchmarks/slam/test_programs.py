"""Programs that fail, recordings that are damaged, and folders without anything to score: each is one sentence."""

import shutil
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import yaml

from benchmarks.command import BenchmarkError
from benchmarks.slam import programs
from benchmarks.slam.__main__ import command
from benchmarks.slam.arena import bags, record
from tests.benchmarks.slam.tracks import line, write_axis, write_tum


def test_unknown_and_missing_programs_are_named(monkeypatch):
    with pytest.raises(BenchmarkError, match="no program 'fast'; there are wheel-odometry, evalio-kiss"):
        programs.find_program("fast")
    monkeypatch.setitem(programs.PROGRAMS, "absent", programs.Program("no-such-package", lambda at: None))
    with pytest.raises(BenchmarkError, match="absent needs no-such-package, which is not installed"):
        programs.find_program("absent")
    assert programs.find_program("absent", installed=False) == ""


@pytest.mark.parametrize(("poses", "reason"), [
    ((np.zeros(1), np.zeros((1, 4, 4)), 0.0), "gives 1 poses"),
    ((np.arange(3.0), np.full((3, 4, 4), np.nan), 0.0), "gives poses that are not finite"),
])  # fmt: skip
def test_a_program_that_gives_no_track_says_why(poses, reason, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(programs.PROGRAMS, "mine", programs.Program("jax", lambda at: poses))
    assert programs.main(["mine", str(tmp_path), str(tmp_path / "poses.tum")]) == 1
    assert capsys.readouterr().err == f"{reason}\n"
    assert not (tmp_path / "poses.tum").exists()


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Path:
    """A set with the beginning of one drive and its truth."""
    folder = tmp_path_factory.mktemp("slam") / "set"
    one = folder / "recordings" / "one"
    one.mkdir(parents=True)
    scene = record.draw_scene(record.Course("one", "smooth", distance=1.0), np.random.SeedSequence(4))
    for _ in bags.write_bags(one, ("mcap",), islice(record.stream(scene), 80)):
        pass
    (one / "calibration.yaml").write_text(yaml.safe_dump(record.calibration(scene)))
    record.write_truth(scene, folder / "truth" / "one")
    return folder


def test_a_recording_must_be_whole_before_a_program_runs_on_it(drive, tmp_path, capsys):
    shutil.copytree(drive, tmp_path / "set")
    one, out = tmp_path / "set" / "recordings" / "one", tmp_path / "out"
    asked = ["board", "--sets", str(tmp_path / "set"), "--programs", "rko-lio", "--out", str(out)]

    def refused(sentence: str) -> None:
        assert command([*asked]) == 2
        told = capsys.readouterr().err
        assert sentence in told
        assert told.count("\n") == 1

    whole = (one / "calibration.yaml").read_text()
    for text, sentence in (
        ("{", "is no calibration"), ("lidar: 3", "is no calibration"),
        ("lidar: {topic: /moon}\nimu: {topic: /imu}\n", "has no topic /moon; it has /imu/data, /odom"),
    ):  # fmt: skip
        (one / "calibration.yaml").write_text(text)
        refused(sentence)
    (one / "calibration.yaml").unlink()
    refused("one/calibration.yaml: is missing")
    (one / "calibration.yaml").write_text(whole)
    data = (one / "recording" / "recording.mcap").read_bytes()
    (one / "recording" / "recording.mcap").write_bytes(data[: len(data) // 2])
    refused("one/recording: not a whole recording")
    (one / "recording" / "metadata.yaml").unlink()
    refused("is no recording: metadata.yaml is missing")
    assert not out.exists()


def test_a_folder_without_anything_to_score_is_refused(tmp_path, capsys):
    truth = write_tum(tmp_path / "truth" / "one" / "lidar.tum", *line())
    write_axis(truth.parent / "axis.csv", line()[1])
    mine = write_tum(tmp_path / "mine" / "one.tum", *line()).parent
    asked = ("--truth", str(tmp_path / "truth"))
    assert command(["score", "--estimate", str(mine), *asked, "--out", str(tmp_path / "scores")]) == 0
    assert (tmp_path / "scores" / "scores.md").read_text().count("| one | mine |") == 1
    assert command(["score", "--estimate", str(mine / "one.tum"), *asked]) == 0
    capsys.readouterr()
    write_tum(tmp_path / "others" / "two.tum", *line())
    for given, sentence in ((tmp_path / "others", "holds no NAME.tum"), (tmp_path / "nobody", "no such file")):
        assert command(["score", "--estimate", str(given), *asked]) == 2
        assert sentence in capsys.readouterr().err
