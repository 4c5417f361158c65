"""Poses that do not belong to their scans are noticed by the walls, and the mistake is named."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scene.errors import RecordingError
from scene.judging.sanity import doubt_bore
from scene.poses.calibration import UNCALIBRATED
from scene.poses.consistency import check_poses, reorder
from scene.poses.place import place_recording
from scene.poses.trajectory import Trajectory, save_tum
from scene.progress import Stages
from scene.reading.formats import ReadingConfig
from scene.reading.recording import Recording
from tests.scene.bags import write_bag
from tests.scene.fits import keep

RATE, COUNT, RAYS = 10.0, 90, 2000


def pose(time: np.ndarray) -> tuple[np.ndarray, Rotation]:
    """A walker at 0.8 m/s who sways by 4° and turns by 40° in all."""
    sway = 0.07 * np.sin(2 * np.pi * 0.9 * time)
    position = np.column_stack([0.8 * time, 0.05 * np.sin(3.0 * time), 1.5 + 0.03 * np.sin(6.0 * time)])
    return position, Rotation.from_euler("zyx", np.column_stack([0.07 * time, sway, 0.04 * np.cos(5.0 * time)]))


def walls(start: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """Distance to a duct of 5 m by 5 m along x, m."""
    with np.errstate(divide="ignore"):
        sides = [((np.sign(ray[:, k]) * 2.5 + offset) - start[:, k]) / ray[:, k] for k, offset in ((1, 0.0), (2, 1.0))]
    return np.minimum(*sides)


def record(folder: Path, lowest: float) -> Path:
    """A bag of sweeps whose rays lean by at most some angle's sine from the LiDAR's own plane."""
    rng = np.random.default_rng(0)
    scans = []
    for k in range(COUNT):
        position, attitude = pose(k / RATE + 0.1 * np.arange(RAYS) / RAYS)  # the writer spreads them over 0.1 s
        up, turn = rng.uniform(-lowest, lowest, RAYS), rng.uniform(-np.pi, np.pi, RAYS)
        ray = np.column_stack([*(np.sqrt(1.0 - up**2) * side(turn) for side in (np.cos, np.sin)), up])
        distance = walls(position, attitude.apply(ray)) + rng.normal(0, 0.01, RAYS)
        scans.append((100.0 + k / RATE, (distance[:, None] * ray).astype(np.float32)))
    return write_bag(folder / "walk.bag", scans)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    with Recording(record(tmp_path_factory.mktemp("bag"), 1.0)) as opened:
        yield opened


def trajectory(late: float = 0.0, turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Trajectory:
    time = np.arange(-20, RATE * 12 * 2) / (2 * RATE)
    position, attitude = pose(time)
    return Trajectory(100.0 + time + late, position, attitude * Rotation.from_euler("xyz", turn, degrees=True), "t.tum")


def test_right_poses_leave_walls_as_thin_as_a_sweep_does(recording):
    check = check_poses(recording, trajectory())
    keep(check.facts, rel=1e-3)
    assert not check.blurred
    assert check.words is None
    assert check.facts["pose_doubt"] is None


WRONG = {
    "late": (trajectory(late=0.1), "0.1 s earlier they are thin: two clocks differ"),
    "early": (trajectory(late=-0.5), "0.5 s later they are thin: two clocks differ"),
    "pitched": (trajectory(turn=(0.0, 3.0, 0.0)), "-3° in pitch they are thin: the extrinsic is off"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_clock_and_a_wrong_mount_are_named(recording, name, bore):
    poses, said = WRONG[name]
    check = check_poses(recording, poses)
    keep(check.facts, rel=1e-3)
    assert check.blurred
    assert said in check.words
    warnings = doubt_bore(bore, check.facts, {}, surveyed=True)
    assert [warning.code for warning in warnings] == ["poses"]


def test_a_pitched_mount_is_named_though_a_flat_fan_sees_little_but_upright_walls(tmp_path):
    with Recording(record(tmp_path, 0.4)) as flat:
        assert check_poses(flat, trajectory()).words is None
        wrong = trajectory(turn=(0.0, 3.0, 0.0))
        assert "-3° in pitch they are thin: the extrinsic is off" in check_poses(flat, wrong).words


def test_quaternions_in_the_other_order_are_found(recording):
    right = trajectory()
    wrong = Trajectory(
        right.times, right.positions, Rotation.from_quat(right.rotations.as_quat()[:, [3, 0, 1, 2]]), "t.tum"
    )
    check = check_poses(recording, wrong)
    assert check.wxyz
    assert "w, x, y, z" in check.words
    assert not check_poses(recording, reorder(wrong)).blurred


def test_poses_of_another_time_tell_nothing(recording):
    assert check_poses(recording, trajectory(late=1000.0)) is None


def test_a_trajectory_of_another_drive_is_refused_in_one_sentence(recording, tmp_path):
    time = np.arange(-20, RATE * 12 * 2) / (2 * RATE)
    position, attitude = pose(0.61 * time + 40.0)
    save_tum(Trajectory(100.0 + time, position, attitude, ""), tmp_path / "other.tum")
    given = (tmp_path / "other.tum", None, UNCALIBRATED, 0.1, ReadingConfig())
    said = r"walk\.bag: the turns .*other\.tum are not .*another drive"
    with Stages() as stages, pytest.raises(RecordingError, match=said):
        place_recording(recording.path, *given, stages)
