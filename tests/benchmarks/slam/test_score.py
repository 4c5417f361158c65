"""The scorer: errors whose size is known, `evo` beside it, and what it refuses."""

import copy
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core import sync
from evo.tools import file_interface
from scipy.spatial.transform import Rotation

from benchmarks.command import BenchmarkError
from benchmarks.slam.__main__ import command
from benchmarks.slam.score import HEAD, ScoreConfig, as_json, as_markdown, as_rows, doubts, score_all, score_files
from tests.benchmarks.slam.tracks import bend, line, write_axis, write_tum
from tests.recorded import check

VALUES = Path(__file__).with_name("values.csv")


def test_a_track_2_percent_too_short_and_5_cm_to_the_left_is_told_apart(tmp_path):
    time, position, rotation = line()
    truth = write_tum(tmp_path / "truth.tum", time, position, rotation)
    estimate = write_tum(tmp_path / "e.tum", time, position * [0.98, 1.0, 1.0] + [0.0, 0.05, 0.0], rotation)
    found, error = score_files(estimate, truth, alignment="none")
    assert found.along_final == pytest.approx(-2.0)
    assert found.drift == pytest.approx(2.0)
    assert found.along_rms == pytest.approx(2.0 / np.sqrt(3.0), rel=5e-3)
    assert found.across_rms == pytest.approx(0.05)
    assert found.up_rms == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(error[:, 0], -0.02 * position[:, 0], atol=1e-9)


def test_one_who_stands_still_on_the_axis_is_off_along_a_bend_and_not_across(tmp_path):
    time, position, rotation = bend()
    truth = write_tum(tmp_path / "truth.tum", time, position, rotation)
    write_axis(tmp_path / "axis.csv", position)
    still = write_tum(tmp_path / "still.tum", time, np.zeros_like(position), rotation)
    found, error = score_files(still, truth, alignment="none")
    np.testing.assert_allclose(error[:, 0], -0.2 * np.arange(len(time)), atol=1e-2)
    assert found.drift == pytest.approx(100.0, abs=0.02)
    assert found.across_rms == pytest.approx(0.0, abs=1e-3)


def test_round_a_bend_the_axis_turns_along(tmp_path):
    time, position, rotation = bend()
    truth = write_tum(tmp_path / "truth.tum", time, position, rotation)
    ahead, aside = rotation.apply([1.0, 0.0, 0.0]), rotation.apply([0.0, 1.0, 0.0])
    estimate = write_tum(tmp_path / "e.tum", time, position + 0.7 * ahead - 0.1 * aside, rotation)
    by_path, _ = score_files(estimate, truth, alignment="none")
    write_axis(tmp_path / "axis.csv", position)
    by_file, _ = score_files(estimate, truth, alignment="none")
    assert (by_path.axis, by_file.axis) == ("the true path", "axis.csv")
    for found in (by_path, by_file):
        assert found.along_rms == pytest.approx(0.7, abs=1e-3)
        assert found.across_rms == pytest.approx(0.1, abs=5e-3)
        assert found.up_rms == pytest.approx(0.0, abs=1e-9)
    # The way back: by the axis, ahead is still where stations grow.
    back = write_tum(tmp_path / "truth.tum", time, position[::-1], rotation[::-1])
    estimate = write_tum(tmp_path / "e.tum", time, position[::-1] + 0.7 * ahead[::-1], rotation[::-1])
    assert score_files(estimate, back, alignment="none")[0].along_final == pytest.approx(0.7, abs=1e-3)


@pytest.mark.parametrize("alignment", ["none", "origin", "se3"])
def test_errors_are_those_of_evo_as_a_whole_and_axis_by_axis(tmp_path, alignment):
    time, position, rotation = line()
    # The tunnel leads along x of no frame: turned by 30°, without a slope, as `axis.csv` of a level bore.
    bore = Rotation.from_euler("z", 30.0, degrees=True)
    write_axis(tmp_path / "axis.csv", bore.apply(position))
    # A carrier that sways: a best fit to a path without width could turn about it.
    sway = np.column_stack([0.0 * time, 0.3 * np.sin(time), 0.1 * np.cos(2.0 * time)])
    position, rotation = bore.apply(position + sway), bore * rotation
    rng = np.random.default_rng(5)
    drift = np.cumsum(rng.normal(0.0, 0.02, (len(time), 3)), axis=0)
    turn = Rotation.from_rotvec(np.cumsum(rng.normal(0.0, 0.002, (len(time), 3)), axis=0))
    some = slice(3, None, 2)
    paths = (write_tum(tmp_path / "e.tum", time[some], (position + drift)[some], (rotation * turn)[some]),
             write_tum(tmp_path / "truth.tum", time, position, rotation))  # fmt: skip
    estimate, truth = (file_interface.read_tum_trajectory_file(str(path)) for path in paths)
    truth, estimate = sync.associate_trajectories(truth, copy.deepcopy(estimate))
    if alignment == "origin":
        estimate.align_origin(truth)
    elif alignment == "se3":
        estimate.align(truth)
    relations = evo_metrics.PoseRelation
    turned, metric = (evo_metrics.APE(part) for part in (relations.rotation_angle_deg, relations.translation_part))
    for one in (turned, metric):
        one.process_data((truth, estimate))
    theirs = bore.inv().apply(estimate.positions_xyz - truth.positions_xyz)
    np.testing.assert_allclose(np.linalg.norm(theirs, axis=1), metric.error, atol=1e-9)
    found, error = score_files(*paths, alignment=alignment)
    np.testing.assert_allclose(error, theirs, atol=1e-6)
    assert found.poses == estimate.num_poses == 199
    assert found.ape == pytest.approx(metric.get_all_statistics()["rmse"], abs=1e-6)
    assert found.ape_turn == pytest.approx(turned.get_all_statistics()["rmse"], abs=1e-6)
    ours = (found.along_rms, found.across_rms, found.up_rms)
    np.testing.assert_allclose(ours, np.sqrt(np.mean(theirs**2, axis=0)), atol=1e-6)
    assert found.along_final == pytest.approx(theirs[-1, 0], abs=1e-6)


def test_poses_of_a_camera_are_refused_and_a_bad_program_is_scored(tmp_path):
    time, position, rotation = bend()
    truth = write_tum(tmp_path / "truth.tum", time, position, rotation)
    camera = Rotation.from_matrix([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    other = write_tum(tmp_path / "camera.tum", time, position, rotation * camera)
    with pytest.raises(BenchmarkError, match=r"camera.tum: fits the truth only turned as a whole by 120°") as output:
        score_files(other, truth)
    assert "\n" not in str(output.value)
    assert score_files(other, truth, alignment="se3")[0].ape < 1e-6
    # One that stands still, and one that turns round half-way, are as bad as they are.
    still = write_tum(tmp_path / "still.tum", time, np.zeros_like(position), rotation)
    assert score_files(still, truth)[0].drift == pytest.approx(100.0, abs=1.0)
    back = np.concatenate([position[:200], position[199::-1]])
    assert score_files(write_tum(tmp_path / "back.tum", time, back, rotation), truth)[0].drift > 50.0


def test_scores_of_a_drive_there_and_back_round_a_bend_are_those_of_the_table(tmp_path):
    time, position, rotation = bend(600)
    there = np.concatenate([np.arange(450), np.arange(449, 299, -1)])  # the axis is that of the way there
    position, rotation = position[there] + np.outer(np.sin(0.01 * there), [0.0, 0.0, 3.0]), rotation[there]
    rng = np.random.default_rng(3)
    drift = np.cumsum(rng.normal(0.0, [0.02, 0.01, 0.005], (600, 3)), axis=0)
    turn = rotation * Rotation.from_rotvec(np.cumsum(rng.normal(0.0, 0.002, (600, 3)), axis=0))
    late = np.concatenate([time, time[-1] + 0.2 * np.arange(1, 8)])  # goes on for 1.4 s
    more = [slice(None), *[slice(-1, None)] * 7]
    estimate = write_tum(tmp_path / "mine" / "one.tum", late, np.concatenate([(position + drift)[k] for k in more]),
                         Rotation.concatenate([turn[k] for k in more]))  # fmt: skip
    truth = write_tum(tmp_path / "truth" / "one" / "lidar.tum", time, position, rotation)
    scores = []
    for alignment in ("none", "origin", "se3"):
        config = ScoreConfig((estimate.parent,), tmp_path / "truth", alignment=alignment)
        found, _ = score_all(config)
        assert ["1 s of poses lie after" in one for one in doubts(config, found)] == [True]
        _, error = score_files(estimate, truth, alignment=alignment)
        told = [f"{one:.4g}" if isinstance(one, float) else str(one) for one in dataclasses.astuple(found[0])]
        check(VALUES, f"score {alignment}", {"error": error, "score": " ".join(told)})
        scores += found
    check(VALUES, "scores", {"page": as_markdown(scores), "names": [*json.loads(as_json(scores, {"date": "today"}))]})


@pytest.mark.parametrize(("aside", "straight"), [(0.9, True), (1.3, False)])
def test_a_way_within_a_hundredth_of_its_length_is_straight(tmp_path, aside, straight):
    time, position, rotation = line()
    position = position + np.column_stack([0.0 * time, aside * np.sqrt(2.0) * np.sin(time), 0.0 * time])
    truth = write_tum(tmp_path / "truth.tum", time, position, rotation)
    assert score_files(truth, truth)[0].straight == straight


def test_the_first_and_the_last_pose_alone_are_no_estimate(tmp_path):
    """They may be right to the millimetre; what lies between would not be scored."""
    time, position, rotation = line()
    truth = write_tum(tmp_path / "truth.tum", time, position, rotation)
    for rows, refused in ((slice(None, None, 400), True), (slice(None, None, 16), True), (slice(None, None, 8), False)):
        few = write_tum(tmp_path / "few.tum", time[rows], position[rows], rotation[rows])
        if refused:
            with pytest.raises(BenchmarkError, match=r"few.tum: has \d+ poses in 40 s; at least 1 a second are needed"):
                score_files(few, truth)
        else:
            assert score_files(few, truth)[0].drift == pytest.approx(0.0, abs=1e-6)


def test_poses_of_another_frame_are_not_compared_as_they_are(tmp_path):
    time, position, rotation = line()
    truth = write_tum(tmp_path / "truth.tum", time, position, rotation)
    far = write_tum(tmp_path / "far.tum", time, position + np.array([271_000.0, 2_103_000.0, 0.0]), rotation)
    with pytest.raises(BenchmarkError, match=r"far.tum: lies 2120 km from the truth: poses must be in the tunnel's"):
        score_files(far, truth, alignment="none")
    assert score_files(far, truth)[0].ape < 1e-6
    for away in (1990.0, 2010.0):  # 1 km beyond ten times the way
        lost = write_tum(tmp_path / "lost.tum", time, position + np.array([0.0, 0.0, away]), rotation)
        if away < 2000.0:
            assert score_files(lost, truth, alignment="none")[0].up_rms == pytest.approx(away)
        else:
            with pytest.raises(BenchmarkError, match="lies 2 km from the truth"):
                score_files(lost, truth, alignment="none")


def test_stamps_between_those_of_the_truth_are_scored_against_the_pose_between(tmp_path):
    time, position, rotation = line()
    truth = write_tum(tmp_path / "truth.tum", time, position, rotation)
    late = position[:-1] + np.array([0.125, 0.0, 0.0])
    estimate = write_tum(tmp_path / "e.tum", time[:-1] + 0.05, late, rotation[:-1])
    found, _ = score_files(estimate, truth, alignment="none")
    assert found.ape < 1e-6
    assert found.covered == pytest.approx(399 / 400)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("nonsense\n", "e.tum: not a TUM trajectory"),
        ("1.0 0 0 0 0 0 0 1\n2.0 1 0 0 0 0 0 1\n", "e.tum: shares 0 of its 2 times (1.000 to 2.000 s) with"),
        ("1.0 0 0 0 0 0 0 1\n", "e.tum: a TUM trajectory has at least 2 rows"),
        ("1.0 0 nan 0 0 0 0 1\n2.0 1 0 0 0 0 0 1\n", "e.tum: row 1 is not finite"),
    ],
)
def test_a_bad_estimate_is_one_sentence_and_status_2(tmp_path, capsys, content, sentence):
    truth = write_tum(tmp_path / "truth.tum", *line())
    estimate = tmp_path / "e.tum"
    estimate.write_text(content)
    out = tmp_path / "out"
    assert command(["score", "--estimate", str(estimate), "--truth", str(truth), "--out", str(out)]) == 2
    output = capsys.readouterr().err
    assert output.startswith("error: ")
    assert sentence in output
    assert output.count("\n") == 1
    assert not out.exists()


def test_one_bad_file_is_named_and_the_others_are_scored(tmp_path, capsys):
    time, *poses = line()
    for name, step in (("few", 400), ("good", 1)):
        write_tum(tmp_path / "mine" / f"{name}.tum", time[::step], *(each[::step] for each in poses))
        write_tum(tmp_path / "truth" / name / "lidar.tum", time, *poses)
    words = f"score --estimate {tmp_path}/mine --truth {tmp_path}/truth --alignment se3 --out {tmp_path}/out"
    assert command(words.split()) == 2
    errors = capsys.readouterr().err
    assert all(words in errors for words in ("not scored", "few.tum: has", "mine on good: the drive is straight"))
    assert [score["name"] for score in json.loads((tmp_path / "out/scores.json").read_text())["scores"]] == ["good"]


def test_a_bad_axis_or_standstill_is_refused(tmp_path):
    truth = write_tum(tmp_path / "truth.tum", *line())
    axis = tmp_path / "other.csv"
    axis.write_text("a,b\n1,2\n")
    with pytest.raises(BenchmarkError, match=r"other\.csv: not an axis"):
        score_files(truth, truth, axis=axis)
    time, position, rotation = line(20, step=0.0)
    still = write_tum(tmp_path / "still.tum", time, position, rotation)
    with pytest.raises(BenchmarkError, match="nothing tells along from across"):
        score_files(still, still)


def test_an_estimate_whose_clock_is_late_has_the_offset_in_a_column_of_its_own(tmp_path):
    time, position, rotation = bend()
    sway = rotation * Rotation.from_rotvec(0.05 * np.column_stack([np.sin(5 * time), np.cos(3 * time), np.sin(time)]))
    truth = write_tum(tmp_path / "truth.tum", time, position, sway)
    late = score_files(write_tum(tmp_path / "late.tum", time + 0.05, position, sway), truth)[0]
    assert late.late == pytest.approx(0.05, abs=3e-3)
    assert late.ape > 0.02, "the errors stand without it"
    assert as_rows([late])[0][HEAD.index("clock late, s")] == "0.050"
    assert score_files(truth, truth)[0].late is None
