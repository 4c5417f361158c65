"""A camera sees what stands before it, and a frame is taken where and when the LiDAR looked along the bore."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.command import BenchmarkError
from benchmarks.fidelity.derive.distances import Occupied
from benchmarks.paper.camera import Pose
from benchmarks.paper.figures import classify_side_view, depth_image
from benchmarks.paper.material import Stretch, load_frame
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
    assert len(frame.points[frame.single]) == 4


def test_a_frame_where_nothing_was_recorded_is_one_sentence(recorded, tmp_path):
    late = write_bag(tmp_path / "late.bag", [(50.0, np.ones((3, 3)))])
    with pytest.raises(BenchmarkError, match=r"late\.bag: no scan within 1 s of "):
        load_frame(late, recorded[1], np.zeros(3), Stretch(np.zeros(3), np.array([1.0, 0.0, 0.0]), 4.0), 1.0)


def test_seen_from_the_side_voxels_of_one_surface_and_of_both_are_told_apart():
    real, scene = np.zeros((4, 2, 1), bool), np.zeros((4, 2, 1), bool)
    real[[0, 1], [0, 1], 0] = True
    scene[[0, 2], [1, 1], 0] = True  # in slice 0 on the other side: one pixel from the side all the same
    classes = classify_side_view(Occupied(np.stack([real, scene, scene]), real | scene, np.arange(4.0)))
    np.testing.assert_array_equal(classes[:, 0], [0.0, 2.0, 1.0, np.nan])
