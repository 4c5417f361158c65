"""Recordings that are whole and yet odd: times, counts, types and values that no sensor should send."""

import numpy as np
import pytest

from scene.build import reconstruct
from scene.config import ReconstructConfig
from scene.errors import FitError, RecordingError
from scene.poses.imu import read_inertial
from scene.progress import Stages
from scene.reading.recording import Recording
from tests.scene.bags import custom_msg, write_bag, write_imu_bag, write_tum
from tests.scene.messages import CODES, PLAIN, VELODYNE, pointcloud2, write_bag1

pytestmark = pytest.mark.usefixtures("silent")
XYZ = np.random.default_rng(0).uniform(-9, 9, (300, 3)).astype(np.float32)


def clouds(path, stamps, points=XYZ, fields=PLAIN, step=12, **extra):
    columns = dict(zip("xyz", points.T, strict=True)) | extra
    messages = [(float(k), pointcloud2(stamp, fields, step, columns)) for k, stamp in enumerate(stamps, 1)]
    return write_bag1(path, {"/points": messages})


def nothing(count: int = 0) -> np.ndarray:
    return np.empty((count, 3), np.float32)


def outcome(path, *arguments) -> str:
    with pytest.raises((RecordingError, FitError)) as caught:
        reconstruct(path, None, ReconstructConfig(), Stages(), *arguments)
    assert str(path.name) in str(caught.value) or arguments
    assert "\n" not in str(caught.value)
    return str(caught.value)


ODD = {
    "one scan": (lambda path: clouds(path, [5.0], XYZ[:100]), "only 1 scans hold 100 points"),
    "no points": (lambda path: clouds(path, [5.0, 5.1, 5.2], nothing()), "holds no scan with a return in it"),
    "NaN": (lambda path: clouds(path, [5.0, 5.1], np.full((300, 3), np.nan)), "holds no scan with a return in it"),
    "all one time": (lambda path: clouds(path, [5.0] * 9), ""),
    "backwards": (lambda path: clouds(path, [9.0, 8.0, 7.0]), "the times of /points do not grow: scan 2 is of 7.000"),
    "a leap of a day": (lambda path: clouds(path, [5.0, 86405.0]), "86400 s after the one before it"),
    "NaN times": (lambda path: clouds(path, [5.0, 5.1], fields=VELODYNE, step=22, time=np.full(300, np.nan)), ""),
    "times of hours": (
        lambda path: clouds(path, [5.0, 5.1], fields=VELODYNE, step=22, time=np.geomspace(1e-3, 1e20, 300)),
        r"scan 0 of /points is a sweep whose `time` spans",
    ),
    "one point each": (lambda path: clouds(path, [5.0, 5.1, 5.2], XYZ[:1]), "only 0 scans hold 100 points"),
    "points at infinity": (lambda path: clouds(path, [5.0, 5.1, 5.2], XYZ * 1e30), ""),
    "everything in one place": (lambda path: clouds(path, [5.0, 5.1, 5.2], np.ones((300, 3))), ""),
    "Livox, empty": (lambda path: write_bag(path, [(5.0, nothing()), (5.1, nothing())]), "no scan with a return"),
}


@pytest.mark.parametrize("name", ODD)
@pytest.mark.timeout(60)
def test_an_odd_recording_ends_in_one_sentence(tmp_path, name):
    write, said = ODD[name]
    assert said in outcome(write(tmp_path / "a.bag"))


@pytest.mark.parametrize("code", [0, 9, 255])
def test_a_field_of_unknown_type_is_named(tmp_path, code):
    raw = pointcloud2(5.0, PLAIN, 12, dict(zip("xyz", XYZ.T, strict=True)))
    wrong = raw.replace(b"y\x04\0\0\0" + bytes([CODES["f4"]]), b"y\x04\0\0\0" + bytes([code]))
    assert wrong != raw
    bag = write_bag1(tmp_path / "a.bag", {"/points": [(5.0, wrong)]})
    assert f"field y is of unknown type {code}" in outcome(bag)


def test_a_livox_message_that_promises_more_points_than_it_holds_is_named(tmp_path):
    whole = custom_msg(5.0, XYZ)
    place = len(whole) - 19 * len(XYZ) - 4
    wrong = whole[:place] + (10**9).to_bytes(4, "little") + whole[place + 4 :]
    bag = write_bag(tmp_path / "a.bag", [(5.0, XYZ)])
    bag.write_bytes(bag.read_bytes().replace(whole, wrong))
    assert "scan 0 of /livox/lidar is not a whole CustomMsg" in outcome(bag)


def test_control_without_an_imu_says_what_is_missing(tmp_path):
    bag = clouds(tmp_path / "a.bag", 5 + 0.1 * np.arange(40))
    rows = np.column_stack([5 + 0.1 * np.arange(40.0)] + [np.arange(40.0)] * 3)
    assert "control goes with an IMU whose mount is known" in outcome(bag, write_tum(tmp_path / "prism.tum", rows))


@pytest.mark.parametrize("count", [0, 49])
def test_too_few_inertial_samples_are_no_imu(tmp_path, count):
    with Recording(write_imu_bag(tmp_path / "a.bag", XYZ, count)) as recording:
        assert read_inertial(recording, "/livox/imu") is None


def test_inertial_samples_in_no_known_unit_are_named(tmp_path):
    bag = write_imu_bag(tmp_path / "a.bag", XYZ, 60)
    one, feet = (np.array([0.0, 0, value]).astype("<f8").tobytes() for value in (1.0, 32.2))
    bag.write_bytes(bag.read_bytes().replace(one + bytes(72), feet + bytes(72)))
    with Recording(bag) as recording, pytest.raises(RecordingError, match=r"force of 32\.2, which is neither"):
        read_inertial(recording, "/livox/imu")
