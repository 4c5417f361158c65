"""Clocks that differ are found by the turns of one body, and set right on request."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scene.errors import Code, RecordingError
from scene.judging.sanity import doubt_bore
from scene.poses import clocks
from scene.poses.clocks import NOTICED, Clock, LidarTurns, find_lag, settle, turns_of_gyro, turns_of_poses
from scene.poses.imu import Inertial
from scene.poses.trajectory import Trajectory
from scene.reading.times import Convention

AT = np.arange(0.0, 30.0, 0.005)


def attitude(time: np.ndarray) -> Rotation:
    """A walker who sways about three axes, never twice alike."""
    waves = [(0.07, 0.9, 0.0), (0.05, 1.3, 1.0), (0.10, 0.21, 2.0)]
    return Rotation.from_euler("xyz", np.column_stack([a * np.sin(2 * np.pi * f * time + p) for a, f, p in waves]))


def gyro(late: float, mount: Rotation) -> Inertial:
    """Rates in the axes of an IMU whose clock is late."""
    turns = (attitude(AT - 0.0025).inv() * attitude(AT + 0.0025)).as_rotvec() / 0.005
    return Inertial(AT + late, mount.apply(turns), np.tile([0.0, 0.0, 9.8], (len(AT), 1)), "/imu")


@pytest.fixture(scope="module")
def lidar() -> LidarTurns:
    middle = np.arange(8.0, 18.0, 0.1)
    turns = attitude(middle)
    rate = (turns[:-1].inv() * turns[1:]).as_rotvec() / 0.1 + np.random.default_rng(0).normal(
        0, 0.02, (len(turns) - 1, 3)
    )
    rate[50] = [0.0, 0.0, 40.0]  # matched wrongly
    return LidarTurns(middle[:-1], middle[1:], rate)


@pytest.mark.parametrize("late", [0.0075, 0.03, -0.11, 0.7, -1.49])
def test_a_lag_is_found_whatever_the_mount(lidar, late):
    mount = Rotation.from_euler("zyx", [130.0, -20.0, 70.0], degrees=True)
    for turns in (
        lambda at: turns_of_gyro(gyro(at, mount)),
        lambda at: turns_of_poses(Trajectory(AT + at, np.zeros((len(AT), 3)), attitude(AT) * mount, "poses")),
    ):
        (found, agreement), (same, _) = (find_lag(lidar, turns(at)) for at in (late, 0.0))
        assert 0.9 < agreement < 1.0
        assert found == pytest.approx(late, abs=0.6 * NOTICED)
        assert found - same == pytest.approx(late, abs=1e-3), "as precise between the lags that are tried"


def test_a_bias_of_the_gyro_changes_neither_lag_nor_agreement(lidar):
    turns = turns_of_gyro(gyro(0.03, Rotation.identity()))
    biased = find_lag(lidar, lambda start, end: turns(start, end) + np.array([0.3, -0.2, 0.4]))
    np.testing.assert_allclose(biased, find_lag(lidar, turns), atol=1e-6)


def test_an_axis_that_the_lidar_hardly_sees_counts_little(lidar):
    off = np.random.default_rng(2).normal(0, 0.3, len(lidar.rate))
    blind = LidarTurns(lidar.start, lidar.end, lidar.rate + np.outer(off, [0.0, 1.0, 0.0]))
    assert find_lag(blind, turns_of_gyro(gyro(0.1, Rotation.identity())))[0] == pytest.approx(0.1, abs=0.003)


def test_a_carrier_that_hardly_turns_tells_no_lag(lidar):
    turns = turns_of_gyro(gyro(0.1, Rotation.identity()))
    calm = LidarTurns(lidar.start, lidar.end, 0.02 * lidar.rate)
    assert find_lag(calm, lambda start, end: 0.02 * turns(start, end))[0] is None


def test_turns_of_another_drive_and_none_at_all_tell_nothing(lidar):
    other = Trajectory(AT, np.zeros((len(AT), 3)), attitude(0.61 * AT + 500.0), "poses")
    assert find_lag(lidar, turns_of_poses(other))[0] is None
    even = LidarTurns(lidar.start, lidar.end, np.full_like(lidar.rate, 0.2))
    assert find_lag(even, turns_of_gyro(gyro(0.1, Rotation.identity())))[0] is None
    calm = LidarTurns(lidar.start, lidar.end, 0.05 * lidar.rate)  # agrees, but any noise would as well
    assert find_lag(calm, turns_of_gyro(gyro(0.1, Rotation.identity())))[0] is None


class Beside:
    """A recording of the same drive, as far as its clock counts."""

    path, topic, scan_count, stamps = "a.bag", "/points", 0, np.array([2.0, 32.0])
    convention = Convention("after", "")

    def pick(self, numbers):
        return iter(())


def test_clocks_years_apart_are_named_and_laid_on_each_other_on_request():
    late = gyro(-2e8, Rotation.identity())
    with pytest.raises(RecordingError, match=r"their clocks are -2e\+08 s apart; --clock auto"):
        settle(Beside(), late, False)
    clock, moved = settle(Beside(), late, True)
    assert clock.corrected
    assert clock.words is None
    np.testing.assert_allclose(moved.times, AT + 2.0, atol=1e-6)


@pytest.mark.parametrize(
    ("clock", "said"),
    [
        (Clock("the IMU /imu", 0.1), "the clock of the IMU /imu is 0.100 s late against the LiDAR's"),
        (Clock("the trajectory", -0.05), "is 0.050 s early"),
        (Clock("the trajectory", 0.1, True), None),
        (Clock("the trajectory", 0.004), None),
        (Clock("the trajectory", None), None),
        (Clock("the trajectory", None, agreement=0.6), "the turns of the trajectory are not those of the LiDAR"),
    ],
)
def test_a_clock_that_is_off_is_warned_of_by_its_own_code(bore, clock, said):
    found = doubt_bore(bore, {"unit": "m", "axes": "xyz", **clock.facts}, {}, surveyed=True)
    assert [warning.code for warning in found] == ([Code.CLOCK] if said else [])
    assert said is None or said in found[0].text
    assert said is None or clock.offset is None or "--clock auto" in found[0].text


@pytest.mark.parametrize(("guessed", "ended"), [(True, True), (False, False)])
def test_headers_at_the_end_of_their_sweeps_are_told_by_the_turns_where_nothing_else_tells(
    lidar, monkeypatch, guessed, ended
):
    """Sweeps of 0.1 s whose headers are of their end, and were taken for their start."""

    class Late(Beside):
        late = 0.1
        convention = Convention("after", "", length=0.1, guessed=guessed)

        def __init__(self) -> None:
            self.facts = {"point_times": "as it was"}

        def take_end(self) -> None:
            self.late, self.convention = 0.0, Convention("after", "", length=0.1)

    def shifted(recording):
        return LidarTurns(lidar.start + recording.late, lidar.end + recording.late, lidar.rate)

    monkeypatch.setattr(clocks, "lidar_turns", shifted)
    recording, poses = Late(), Trajectory(AT, np.zeros((len(AT), 3)), attitude(AT), "poses")
    clock, _ = clocks.settle(recording, poses, False)
    assert (recording.late == 0.0) == ended
    assert clock.offset == pytest.approx(0.0 if ended else -0.1, abs=0.006)
    assert (clock.words is None) == ended
