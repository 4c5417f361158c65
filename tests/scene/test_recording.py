import numpy as np
import pytest

from scene.errors import RecordingError
from scene.poses.registration import register_scans
from scene.poses.trajectory import load_tum
from scene.progress import Stages
from scene.reading.recording import Recording
from tests.scene.bags import write_bag, write_tum

SCANS = [(100.0 + 0.1 * k, np.arange(30.0).reshape(10, 3) + k) for k in range(5)]


def still(start: float, end: float) -> np.ndarray:
    times = np.arange(start, end, 0.05)
    return np.column_stack([times, np.zeros((len(times), 3)), np.tile([0.0, 0, 0, 1], (len(times), 1))])


def test_scans_come_back_as_they_were_written(tmp_path):
    with Recording(write_bag(tmp_path / "a.bag", SCANS)) as recording:
        scans = list(recording.scans())
    assert recording.topic == "/livox/lidar"
    assert recording.scan_count == 5
    for scan, (stamp, points) in zip(scans, SCANS, strict=True):
        assert scan.stamp == pytest.approx(stamp, abs=1e-6)
        np.testing.assert_array_equal(scan.points, points.astype(np.float32))
        np.testing.assert_allclose(scan.times, 0.01 * np.arange(10), atol=1e-9)


def test_an_absent_topic_is_named(tmp_path):
    with pytest.raises(RecordingError, match="no LiDAR topic /other"):
        Recording(write_bag(tmp_path / "a.bag", SCANS), topic="/other")


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.7, 0.99])
def test_a_bag_truncated_anywhere_is_refused(tmp_path, share):
    whole = write_bag(tmp_path / "a.bag", SCANS).read_bytes()
    cut = tmp_path / "cut.bag"
    cut.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(RecordingError, match=r"cut\.bag"), Recording(cut) as recording:
        list(recording.scans())


def test_returns_move_with_the_sensor_during_a_sweep(tmp_path):
    """A wall 10 m ahead of a sensor that moves 1 m during the sweep stays one plane."""
    depth = 10.0 - np.linspace(0, 1, 200, endpoint=False)
    points = np.stack([depth, np.linspace(-3, 3, 200), np.zeros(200)], axis=1)
    rows = still(99.9, 101.0)
    rows[:, 1] = 10.0 * (rows[:, 0] - 100.0)
    trajectory = load_tum(write_tum(tmp_path / "t.tum", rows))
    with Recording(write_bag(tmp_path / "a.bag", [(100.0, points)])) as recording:
        registered = register_scans(recording, trajectory, 0.01, Stages().start("", 1))
    assert registered.uncovered == 0
    cloud = registered.cloud
    np.testing.assert_allclose(cloud.points[:, 0] + cloud.origin[0], 10.0, atol=1e-4)
