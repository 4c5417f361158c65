"""Recordings come back as they were written: bags, and folders of scans."""

from hashlib import sha256
from io import StringIO

import numpy as np
import pytest
import trimesh
from pypcd4 import PointCloud
from rich.console import Console

from scene.errors import RecordingError
from scene.inputs import hash_inputs
from scene.poses.place import register_scans
from scene.poses.trajectory import load_tum
from scene.progress import Stages
from scene.reading.recording import Recording
from tests.scene.bags import write_bag, write_tum

SCANS = [(100.0 + 0.1 * k, np.arange(30.0).reshape(10, 3) + k) for k in range(5)]


def still(start: float, end: float) -> np.ndarray:
    times = np.arange(start, end, 0.05)
    return np.column_stack([times, np.zeros((len(times), 3)), np.tile([0.0, 0, 0, 1], (len(times), 1))])


def test_a_long_stage_says_how_far_it_is_and_how_long_it_takes(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("scene.progress.time.monotonic", lambda: now[0])
    shown = Console(file=StringIO())
    stage = Stages(shown).start("reading", 40)
    stage.resume(4)
    for now[0] in (109.0, 110.0, 119.0, 121.0):
        stage.advance(4)  # a tenth; a line after 10 s at the earliest
    assert shown.file.getvalue().splitlines() == ["reading: 30%, 0.8/s, 35 s left", "reading: 50%, 0.762/s, 26 s left"]


def test_the_hash_of_a_folder_is_that_of_its_files_names_and_hashes(tmp_path):
    write_bag(tmp_path / "a.bag", SCANS)
    (tmp_path / "b.txt").write_text("b")
    (record,) = hash_inputs([tmp_path], Stages())
    hashes = [f"{file.name} {sha256(file.read_bytes()).hexdigest()}\n" for file in sorted(tmp_path.iterdir())]
    assert (record["files"], record["sha256"]) == (2, sha256("".join(hashes).encode()).hexdigest())


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


@pytest.mark.parametrize("fraction", [0.0, 0.01, 0.3, 0.7, 0.99])
def test_a_bag_truncated_anywhere_is_refused(tmp_path, fraction):
    whole = write_bag(tmp_path / "a.bag", SCANS).read_bytes()
    cut = tmp_path / "cut.bag"
    cut.write_bytes(whole[: int(fraction * len(whole))])
    with pytest.raises(RecordingError, match=r"cut\.bag"), Recording(cut) as recording:
        list(recording.scans())


def test_returns_move_with_the_sensor_during_a_sweep(tmp_path):
    """A wall 10 m ahead of a sensor that moves 1 m during the sweep stays one plane."""
    depth = 10.0 - np.linspace(0, 1, 200, endpoint=False)
    points = np.stack([depth, np.linspace(-3, 3, 200), np.zeros(200)], axis=1)
    rows = still(99.9, 101.0)
    rows[:, 1] = 10.0 * (rows[:, 0] - 100.0)
    trajectory = load_tum(write_tum(tmp_path / "t.tum", rows))
    with Recording(write_bag(tmp_path / "a.bag", [(98.0, points), (100.0, points)])) as recording:
        registered = register_scans(recording, trajectory, 0.01, Stages().start("", 2), most_uncovered=0.5)
        with pytest.raises(RecordingError, match=r"covers 99\.90 to"):
            register_scans(recording, trajectory, 0.01, Stages().start("", 2))
    assert registered.uncovered == 1
    cloud = registered.cloud
    np.testing.assert_allclose(cloud.points[:, 0] + cloud.origin[0], 10.0, atol=1e-4)


XYZ = np.random.default_rng(0).uniform(1, 9, (30, 3)).astype(np.float32)


def kitti(path, points):
    np.column_stack([points, np.ones(len(points))]).astype("<f4").tofile(path)


def write_scan(path, points=XYZ):
    if path.suffix == ".bin":
        kitti(path, points)
    elif path.suffix == ".pcd":
        PointCloud.from_xyz_points(points).save(path)
    else:
        trimesh.PointCloud(points).export(path)


def read_folder(folder):
    with Recording(folder) as recording:
        return list(recording.scans()), recording.facts


@pytest.mark.parametrize("suffix", [".bin", ".pcd", ".ply"])
def test_a_folder_takes_its_times_from_a_list(tmp_path, suffix):
    for k in range(12):
        write_scan(tmp_path / f"{k}{suffix}", XYZ + k)
    (tmp_path / "times.txt").write_text("\n".join(f"{0.1 * k:.6e}" for k in range(12)))
    scans, facts = read_folder(tmp_path)
    assert [scan.stamp for scan in scans] == pytest.approx([0.1 * k for k in range(12)])
    np.testing.assert_array_equal(scans[10].points, XYZ + 10)
    assert facts["times"] == "times.txt"
    assert "static" in facts["point_times"]


@pytest.mark.parametrize(
    "name", ["1317376510.250000", "1317376510250000000", "1317376510_250000000", "scan_1317376510250"]
)
def test_names_that_are_times_are_read_as_such(tmp_path, name):
    write_scan(tmp_path / f"{name}.bin")
    (scan,), facts = read_folder(tmp_path)
    assert scan.stamp == pytest.approx(1317376510.25, abs=1e-3)
    assert facts["times"] == "file names"


def test_dates_of_kitti_raw_are_times(tmp_path):
    write_scan(tmp_path / "0000000000.bin")
    (tmp_path / "timestamps.txt").write_text("2011-09-30 09:55:10.250000000\n")
    assert read_folder(tmp_path)[0][0].stamp == pytest.approx(1317376510.25, abs=1e-6)


def test_point_times_in_a_pcd_are_used(tmp_path):
    fields = ("x", "y", "z", "time")
    times = np.linspace(0, 0.1, 30).astype(np.float32)
    cloud = PointCloud.from_points([*XYZ.T, times], fields, (np.float32,) * 4)
    cloud.save(tmp_path / "1317376510.25.pcd")
    (scan,), facts = read_folder(tmp_path)
    np.testing.assert_allclose(scan.times, times, atol=1e-6)
    assert "`time`, s" in facts["point_times"]


def test_bad_folders_are_refused_by_name_and_cause(tmp_path):
    write_scan(tmp_path / "000001.bin")
    with pytest.raises(RecordingError, match=r"000001\.bin: its name gives no time"):
        read_folder(tmp_path)
    (tmp_path / "times.txt").write_text("0.0\n0.1\n")
    with pytest.raises(RecordingError, match=r"times\.txt: holds 2 times for 1 scans"):
        read_folder(tmp_path)
    (tmp_path / "times.txt").write_text("noon\n")
    with pytest.raises(RecordingError, match=r"times\.txt: line 1 is no time: 'noon'"):
        read_folder(tmp_path)
    (tmp_path / "times.txt").write_text("0.5\n")
    (tmp_path / "000001.bin").write_bytes(bytes(17))
    with pytest.raises(RecordingError, match=r"000001\.bin: not a readable scan \(17 bytes are no whole number"):
        read_folder(tmp_path)
