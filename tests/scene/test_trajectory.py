import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scene.errors import RecordingError
from scene.poses.trajectory import load_tum


def write(path, text):
    path.write_text(text)
    return path


def test_rows_out_of_order_are_sorted(tmp_path):
    trajectory = load_tum(write(tmp_path / "t.tum", "2 2 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n2 2 0 0 0 0 0 1\n"))
    np.testing.assert_array_equal(trajectory.times, [1, 2])
    np.testing.assert_array_equal(trajectory.positions[:, 0], [1, 2])


def test_a_pose_between_two_rows_is_half_way(tmp_path):
    turned = Rotation.from_euler("z", 90, degrees=True).as_quat()
    rows = "0 0 0 0 0 0 0 1\n1 4 0 0 " + " ".join(map(str, turned)) + "\n"
    position, rotation = load_tum(write(tmp_path / "t.tum", rows)).at(np.array([0.5]))
    np.testing.assert_allclose(position, [[2, 0, 0]])
    np.testing.assert_allclose(rotation.as_euler("zyx", degrees=True), [[45, 0, 0]], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("", "at least 2 rows"),
        ("1 0 0 0 0 0 0 1\n", "at least 2 rows"),
        ("1 2 3\n4 5 6\n", "8 numbers"),
        ("a b c\n", "not a TUM trajectory"),
        ("1 0 0 0 0 0 0 0\n2 0 0 0 0 0 0 0\n", "positions only"),
        ("1 0 nan 0 0 0 0 1\n2 0 0 0 0 0 0 1\n", "row 1 is not finite"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 2\n", "row 2 has a quaternion of length 2"),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "same time"),
    ],
)
def test_a_bad_trajectory_is_refused_by_name_and_cause(tmp_path, text, cause):
    with pytest.raises(RecordingError, match=rf"t\.tum: .*{cause}"):
        load_tum(write(tmp_path / "t.tum", text))


def test_a_missing_trajectory_is_named(tmp_path):
    with pytest.raises(RecordingError, match=r"none\.tum: no such file"):
        load_tum(tmp_path / "none.tum")
