"""Poses that do not belong to their scans are noticed by the walls, and the mistake is named."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scene.judging.sanity import doubt_bore
from scene.poses import consistency
from scene.poses.consistency import Tilt, check_poses, find_tilt, numbers_along, reorder
from scene.poses.trajectory import Trajectory
from scene.reading.recording import Recording
from tests.scene.bags import write_bag

RATE, COUNT, RAYS = 10.0, 90, 3000


def tilt(recording: Recording, poses: Trajectory) -> Tilt | None:
    return find_tilt([scan for _, scan in recording.pick(numbers_along(recording.stamps, poses))], poses)


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
    assert check.blurred
    assert said in check.words
    warnings = doubt_bore(bore, check.facts, {}, surveyed=True)
    assert [warning.code for warning in warnings] == ["poses"]


def test_a_pitched_mount_is_named_though_a_flat_fan_sees_little_but_upright_walls(tmp_path, monkeypatch):
    with Recording(record(tmp_path, 0.4)) as flat:
        assert check_poses(flat, trajectory()).words is None
        wrong = trajectory(turn=(0.0, 3.0, 0.0))
        assert "-3° in pitch they are thin: the extrinsic is off" in check_poses(flat, wrong).words
        monkeypatch.setattr(consistency, "_WORSE", np.inf)
        assert check_poses(flat, wrong).words is None, "the median would do"


def straight(time: np.ndarray) -> tuple[np.ndarray, Rotation]:
    """A walker who sways by 2° and goes straight on."""
    sway = np.column_stack([0.03 * np.sin(2.0 * time), 0.02 * np.cos(5.0 * time), 0.03 * np.sin(4.0 * time)])
    return np.column_stack([0.8 * time, 0.05 * np.sin(3.0 * time), 1.5 + 0 * time]), Rotation.from_euler("zyx", sway)


def walk(folder: Path, mouth: float) -> Path:
    """A bag of 26 m straight on, with 16 rings up to 15° off level, which see the floor 6 m off.

    What lies before the mouth, m from the start, returns nothing.
    """
    up, turn = np.meshgrid(np.sin(np.deg2rad(np.arange(-15.0, 16.0, 2.0))), np.linspace(-np.pi, np.pi, 800))
    ray = np.column_stack([np.sqrt(1.0 - up.ravel() ** 2)[:, None] * np.column_stack([np.cos(turn.ravel()),
                           np.sin(turn.ravel())]), up.ravel()])  # fmt: skip
    rng, scans = np.random.default_rng(0), []
    for time in np.arange(26) * 1.25:
        position, attitude = straight(time + 0.1 * np.arange(len(ray)) / len(ray))
        distance = walls(position, attitude.apply(ray)) + rng.normal(0, 0.02, len(ray))
        inside = position[:, 0] + attitude.apply(ray)[:, 0] * distance > mouth
        scans.append((100.0 + time, (distance[:, None] * ray)[inside].astype(np.float32)))
    return write_bag(folder / "walk.bag", scans)


@pytest.fixture(scope="module")
def spun(tmp_path_factory):
    """A straight walk of 26 m from a mouth on."""
    with Recording(walk(tmp_path_factory.mktemp("spun"), 0.0)) as opened:
        yield opened


def along(turn: tuple[float, float, float]) -> Trajectory:
    """The poses of the straight walk, with a mount that is turned about its axes, deg."""
    time = np.arange(-1.0, 34.0, 0.05)
    position, attitude = straight(time)
    return Trajectory(100.0 + time, position, attitude * Rotation.from_euler("xyz", turn, degrees=True), "t.tum")


@pytest.mark.parametrize(
    ("turn", "said"),
    [((0, 0, 0), None), ((0, 0.3, 0), None), ((0, 2, 0), "by -2.0° in pitch"), ((0, -3, 0), "by +3.0° in pitch")],
)
def test_a_pitched_mount_shows_in_the_floor_ahead_and_behind(spun, bore, turn, said):
    check = check_poses(spun, along(turn))
    assert not check.blurred, "the walls alone tell nothing"
    assert check.words is None if said is None else said in check.words
    assert [w.code for w in doubt_bore(bore, check.facts, {}, surveyed=True)] == (["poses"] if said else [])
    if said:
        assert abs(check.tilt.apart - np.sin(np.deg2rad(abs(turn[1]))) * 16.0) < 0.2  # some 8 m each way


def test_a_pitched_mount_shows_in_a_walk_that_begins_outside(tmp_path, monkeypatch):
    with Recording(walk(tmp_path, 10.0)) as entering:  # after 14 m it has seen nothing yet of the floor behind it
        assert tilt(entering, along((0, 0, 0))) is None
        found = tilt(entering, along((0, -3, 0)))
        assert found is not None
        assert "+3.0° in pitch" in found.words
        monkeypatch.setattr(consistency, "_FIRST", 14)
        assert tilt(entering, along((0, -3, 0))) is None, "it was taken for a LiDAR that never looks back"


def test_a_fan_that_sees_nothing_behind_tells_no_tilt(spun, monkeypatch):
    look = consistency._look
    monkeypatch.setattr(consistency, "_look", lambda *words: (rows := look(*words))[rows[:, 3] > 0])
    assert tilt(spun, along((0, 3, 0))) is None


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
