"""Trajectories, control and calibrations: what is read of them, and what is refused by its name."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scene.build import reconstruct
from scene.config import ReconstructConfig
from scene.errors import RecordingError
from scene.poses.calibration import PRESETS, find_calibration
from scene.poses.trajectory import load_control, load_tum
from scene.progress import Stages
from tests.scene.bags import write_bag


def write(path, text):
    path.write_text(text)
    return path


def test_rows_out_of_order_are_sorted(tmp_path):
    trajectory = load_tum(write(tmp_path / "t.tum", "2 2 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n2 2 0 0 0 0 0 1\n"))
    np.testing.assert_array_equal(trajectory.times, [1, 2])
    np.testing.assert_array_equal(trajectory.positions[:, 0], [1, 2])


@pytest.mark.parametrize(("start", "end", "there"), [(1, 2, 1), (1.2, 1.5, 1), (0.9, 1.5, 0), (1.5, 2.1, 0), (0, 3, 0)])
def test_a_time_is_covered_where_both_its_ends_are(tmp_path, start, end, there):
    rows = "1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n"
    assert load_tum(write(tmp_path / "t.tum", rows)).covers(start, end) == bool(there)


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


def rows(n: int, pace: float = 1.0) -> str:
    return "".join(f"{0.3 * k:.3f} {pace * 0.3 * k:.3f} 0 0 0 0 0 0\n" for k in range(n))


def test_rows_are_sorted_and_repeated_times_dropped(tmp_path):
    shuffled = "".join(np.random.default_rng(0).permutation((rows(30) + rows(3)).splitlines(keepends=True)))
    control = load_control(write(tmp_path / "p.tum", shuffled))
    assert (np.diff(control.times) > 0).all()
    assert control.dropped == 3
    np.testing.assert_allclose(control.positions[:, 0], control.times, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("", "needs 10 rows at different times, found 0"),
        (rows(9), "needs 10 rows at different times, found 9"),
        ("1 0 0 0 0 0 0 0\n" * 40, "needs 10 rows at different times, found 1"),
        (rows(40, pace=0.1), "all positions lie within 1.17 m"),
        ("1 2 3\n" * 40, "rows of 4 or 8 numbers"),
        (rows(20) + "nan 0 0 0 0 0 0 0\n", "row 21 is not finite"),
        ("a b\n", "not position control"),
    ],
)
def test_control_of_no_use_is_refused_by_name_and_cause(tmp_path, text, cause):
    with pytest.raises(RecordingError, match=rf"p\.tum: .*{cause}"):
        load_control(write(tmp_path / "p.tum", text))


def test_control_of_another_time_is_refused_with_both_times_before_any_odometry(tmp_path):
    control = write(tmp_path / "p.tum", rows(40))
    points = np.random.default_rng(0).uniform(-3, 3, (200, 3))
    bag = write_bag(tmp_path / "a.bag", [(500.0 + 0.1 * k, points) for k in range(5)])
    for poses, said in ((None, r"the control p\.tum runs from 0\.00 to 11\.70 s, but the LiDAR .* from 500\.00"),
                        (control, r"p\.tum: control is for a recording without a trajectory")):  # fmt: skip
        with pytest.raises(RecordingError, match=said):
            reconstruct(bag, poses, ReconstructConfig(), Stages(), control)


def test_the_published_transform_puts_the_prism_on_the_targets_origin():
    # GEODE: a LiDAR pose P becomes P · inv(T); with P the identity that is where the prism is in LiDAR coordinates.
    w, x, y, z = 0.999901, -0.00492765, 0.00575961, 0.0117651
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    prism = np.linalg.solve(matrix, -np.array([0.00947221, -0.308202, -0.365733]))
    np.testing.assert_allclose(PRESETS["geode-gamma"].prism, prism, atol=1e-5)
    assert prism[2] > 0.3  # above the LiDAR


def test_a_lever_arm_is_a_calibration():
    np.testing.assert_array_equal(find_calibration("0.1,-0.2, 0.3").prism, [0.1, -0.2, 0.3])
    np.testing.assert_array_equal(find_calibration(None).prism, 0)


def test_a_calibration_file_says_where_prism_and_imu_are(tmp_path):
    text = (
        "prism: [0, 0.1, 0.4]\nimu:\n  /imu:\n    rotation: [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]\n    shift: [1, 2, 3]\n"
    )
    found = find_calibration(str(write(tmp_path / "c.yaml", text)))
    np.testing.assert_array_equal(found.prism, [0, 0.1, 0.4])
    np.testing.assert_allclose(found.imu["/imu"].rotation @ [1.0, 0.0, 0.0], [0, -1, 0], atol=1e-12)
    assert found.name == "c.yaml"
    bare = find_calibration(str(write(tmp_path / "d.yaml", "imu: {/imu: {shift: [0.0, 0.0, 0.1]}}")))
    assert (bare.prism.tolist(), bare.imu["/imu"].origin.tolist()) == ([0.0, 0.0, 0.0], [0.0, 0.0, -0.1])


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("prism: [1, 2]\n", "prism must be 3 numbers"),
        ("prism: [1, 2, .nan]\n", "prism must be 3 numbers"),
        ("lever: [1, 2, 3]\n", "keys prism and imu"),
        ("- 1\n", "keys prism and imu"),
        ("a: [\n", "not a YAML file"),
        ("imu: 3\n", "imu must map topics"),
        ("imu: {/imu: 3}\n", "imu /imu must have rotation and shift"),
        ("imu: {/imu: {rotation: [[2,0,0],[0,1,0],[0,0,1]], shift: [0,0,0]}}\n", "is no rotation matrix"),
        ("imu: {/imu: {shift: x}}\n", "imu /imu shift must be 3 numbers"),
    ],
)
def test_a_bad_calibration_is_refused_by_name_and_cause(tmp_path, text, cause):
    with pytest.raises(RecordingError, match=rf"c\.yaml: .*{cause}"):
        find_calibration(str(write(tmp_path / "c.yaml", text)))


def test_an_unknown_preset_names_those_there_are():
    with pytest.raises(RecordingError, match=r"geode-delta: no calibration .*geode-alpha, .*geode-gamma"):
        find_calibration("geode-delta")
