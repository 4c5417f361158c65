"""A camera sees what stands before it, a frame is taken where the LiDAR looked along the bore, figures are written."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.command import BenchmarkError, run_module
from benchmarks.draw.paper import Stretch, depth_image, load_frame, main
from benchmarks.draw.scene import Pose
from tests.scene.bags import write_bag, write_tum

POSE = Pose(np.array([1.0, 2.0, 3.0]), np.array([1.0, 0.0, 0.0]), np.pi / 2, 120, 90)


def test_the_axes_of_a_camera_are_right_up_and_ahead():
    np.testing.assert_allclose(POSE.axes, [[0, -1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-12)
    assert POSE.focal == pytest.approx(45.0)  # 90 degrees: half the height


def test_a_return_is_drawn_where_it_is_and_the_nearer_one_wins():
    image = depth_image(POSE, np.array([[0.0, 0.0, 20.0], [0.0, 0.0, 10.0], [4.0, 2.0, 10.0]]))
    assert image[45, 60] == 10.0
    assert image[45 - 9, 60 + 18] == 10.0  # 45 pixels to one metre at one metre
    assert np.isnan(image[45, 100])


def test_a_return_at_the_edge_of_the_picture_is_drawn_as_far_as_it_is_inside():
    image = depth_image(POSE, np.array([[-60.0 / 45.0, 1.0, 1.0]]))
    assert image[0, 0] == 1.0
    assert np.isfinite(image).sum() == 4  # a pixel about it each way, half of them outside


@pytest.fixture
def recorded(tmp_path):
    """Ten seconds at 1 m/s along x; the LiDAR looks aside but for the seconds from 4 to 6."""
    times = np.arange(0.0, 10.05, 0.1)
    aside = np.where((times >= 4.0) & (times <= 6.0), 0.0, 0.6)
    rows = np.column_stack(
        [times, times, np.zeros((len(times), 2)), Rotation.from_euler("z", aside[:, None]).as_quat()]
    )
    rows[:, 1:4] += [100.0, 0.0, 0.0]
    wall = np.array([[5.0, 0.1, 0.0], [5.0, -0.1, 0.0], [5.0, 0.0, 0.1], [5.0, 0.0, -0.1]])
    bag = write_bag(tmp_path / "walk.bag", [(float(t), wall) for t in times[1:-2]])
    return bag, write_tum(tmp_path / "walk.tum", rows)


def test_a_frame_is_taken_when_the_lidar_looked_along_the_bore(recorded):
    origin = np.array([100.0, 0.0, 0.0])
    frame = load_frame(*recorded, origin, Stretch(np.array([3.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]), 4.0), 1.0)
    assert 4.4 <= frame.position[0] <= 5.6
    np.testing.assert_allclose(frame.points[:, 0] - frame.origin[:, 0], 5.0, atol=1e-5)
    assert np.abs(frame.points[:, 1:]).max() == pytest.approx(0.1, abs=1e-5)
    assert np.ptp(frame.origin[:, 0]) <= 1.1


def test_a_frame_where_nothing_was_recorded_is_one_sentence(recorded, tmp_path):
    late = write_bag(tmp_path / "late.bag", [(50.0, np.ones((3, 3)))])
    with pytest.raises(BenchmarkError, match=r"late\.bag: no scan within 1 s of "):
        load_frame(late, recorded[1], np.zeros(3), Stretch(np.zeros(3), np.array([1.0, 0.0, 0.0]), 4.0), 1.0)


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
