"""A camera sees what stands before it, a frame is taken where it is asked for, figures are written."""

import json

import numpy as np
import pytest

from benchmarks.command import BenchmarkError, run_module
from benchmarks.draw.paper import in_picture, load_frame, main
from benchmarks.draw.scene import Pose
from tests.scene.bags import write_bag, write_tum

POSE = Pose(np.array([1.0, 2.0, 3.0]), np.array([1.0, 0.0, 0.0]), np.pi / 2, 120, 90)


def test_the_axes_of_a_camera_are_right_up_and_ahead():
    np.testing.assert_allclose(POSE.axes, [[0, -1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-12)
    assert POSE.focal == pytest.approx(45.0)  # 90 degrees: half the height


def test_a_return_is_drawn_where_it_is_and_what_the_camera_does_not_see_is_not():
    points = POSE.position + np.array([[10.0, 0.0, 0.0], [10.0, -4.0, 2.0], [10.0, 20.0, 0.0], [-5.0, 0.0, 0.0]])
    np.testing.assert_allclose(in_picture(POSE, points), [[60, 60 + 18], [45, 45 - 9], [10, 10]])


def test_a_frame_is_taken_where_the_lidar_was_nearest_to_a_place(tmp_path):
    """Ten seconds at 1 m/s along x, a wall always 5 m ahead."""
    times = np.arange(0.0, 10.05, 0.1)
    rows = np.column_stack([times, 100.0 + times, *np.zeros((5, len(times))), np.ones(len(times))])
    wall = np.array([[5.0, 0.1, 0.0], [5.0, -0.1, 0.0]])
    bag = write_bag(tmp_path / "walk.bag", [(float(t), wall) for t in times[1:-2]])
    poses, origin = write_tum(tmp_path / "walk.tum", rows), np.array([100.0, 0.0, 0.0])
    frame = load_frame(bag, poses, origin, np.array([4.0, 1.0, 0.0]))
    assert frame.origin[:, 0].min() == pytest.approx(3.3, abs=0.1)
    assert frame.origin[:, 0].max() == pytest.approx(4.7, abs=0.1)
    np.testing.assert_allclose(frame.points[:, 0] - frame.origin[:, 0], 5.0, atol=1e-5)
    late = write_bag(tmp_path / "late.bag", [(50.0, wall)])
    with pytest.raises(BenchmarkError, match=r"late\.bag: no scan within 1\.5 s of "):
        load_frame(late, poses, origin, np.zeros(3))


def write_run(folder, coverage):
    folder.mkdir(parents=True)
    (folder / "log.jsonl").touch()
    (folder / "config.json").write_text(json.dumps({"task": "Subterra/TraverseShort-v1"}))
    rows = [f"{k + 1},{10 * (k + 1)},{value:.9g},{int(value >= 0.9)},10,0" for k, value in enumerate(coverage)]
    (folder / "episodes.csv").write_text("\n".join(["episode,step,coverage,success,length,contact", *rows]) + "\n")


def test_learning_curves_of_several_seeds_are_one_figure(tmp_path):
    for seed in (2, 10):
        write_run(tmp_path / "runs" / f"seed-{seed}", [0.1] * 120 + [0.9] * 190)
    assert main(["--runs", str(tmp_path / "runs"), "--out", str(tmp_path)]) == 0
    assert (tmp_path / "fig4.png").stat().st_size > 10_000


@pytest.mark.slow
def test_the_figures_of_a_short_survey(tmp_path):
    survey, scene = tmp_path / "survey", tmp_path / "scene"
    size = ["--truth", "metro", "--length", "30", "--seed", "0", "--scan-every", "10", "--sensors", "avia", "os1"]
    assert run_module("scene.survey", *size, "--out", survey).status == 0
    given = ("--trajectory", survey / "groundtruth.tum", "--provenance", "simulated")
    assert run_module("scene.build", survey / "survey.bag", *given, "--out", scene).status == 0
    given = ("--survey", survey, "--scene", scene, "--out", tmp_path)
    assert run_module("benchmarks.draw", "paper", *given).status == 0
    captions = json.loads((tmp_path / "figures.json").read_text())
    assert list(captions) == ["fig1", "fig3a", "fig3b"]
    assert float(captions["fig1"].partition(" cm from")[0].split()[-1]) < 3.0
    for name in captions:
        assert b"/FontFile2" in (tmp_path / f"{name}.pdf").read_bytes()  # TrueType, embedded
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
