import numpy as np
import pytest
import trimesh
from pypcd4 import PointCloud

from scene.errors import RecordingError
from scene.reading.recording import Recording

XYZ = np.random.default_rng(0).uniform(1, 9, (30, 3)).astype(np.float32)


def kitti(path, points):
    np.column_stack([points, np.ones(len(points))]).astype("<f4").tofile(path)


def write(path, points=XYZ):
    if path.suffix == ".bin":
        kitti(path, points)
    elif path.suffix == ".pcd":
        PointCloud.from_xyz_points(points).save(path)
    else:
        trimesh.PointCloud(points).export(path)


def read(folder):
    with Recording(folder) as recording:
        return list(recording.scans()), recording.facts


@pytest.mark.parametrize("suffix", [".bin", ".pcd", ".ply"])
def test_a_folder_takes_its_times_from_a_list(tmp_path, suffix):
    for k in range(12):
        write(tmp_path / f"{k}{suffix}", XYZ + k)
    (tmp_path / "times.txt").write_text("\n".join(f"{0.1 * k:.6e}" for k in range(12)))
    scans, facts = read(tmp_path)
    assert [scan.stamp for scan in scans] == pytest.approx([0.1 * k for k in range(12)])
    np.testing.assert_array_equal(scans[10].points, XYZ + 10)
    assert facts["times"] == "times.txt"
    assert "static" in facts["point_times"]


@pytest.mark.parametrize(
    "name", ["1317376510.250000", "1317376510250000000", "1317376510_250000000", "scan_1317376510250"]
)
def test_names_that_are_times_are_read_as_such(tmp_path, name):
    write(tmp_path / f"{name}.bin")
    (scan,), facts = read(tmp_path)
    assert scan.stamp == pytest.approx(1317376510.25, abs=1e-3)
    assert facts["times"] == "file names"


def test_dates_of_kitti_raw_are_times(tmp_path):
    write(tmp_path / "0000000000.bin")
    (tmp_path / "timestamps.txt").write_text("2011-09-30 09:55:10.250000000\n")
    assert read(tmp_path)[0][0].stamp == pytest.approx(1317376510.25, abs=1e-6)


def test_point_times_in_a_pcd_are_used(tmp_path):
    fields = ("x", "y", "z", "time")
    times = np.linspace(0, 0.1, 30).astype(np.float32)
    cloud = PointCloud.from_points([*XYZ.T, times], fields, (np.float32,) * 4)
    cloud.save(tmp_path / "1317376510.25.pcd")
    (scan,), facts = read(tmp_path)
    np.testing.assert_allclose(scan.times, times, atol=1e-6)
    assert "`time`, s" in facts["point_times"]


def test_bad_folders_are_refused_by_name_and_cause(tmp_path):
    write(tmp_path / "000001.bin")
    with pytest.raises(RecordingError, match=r"000001\.bin: its name gives no time"):
        read(tmp_path)
    (tmp_path / "times.txt").write_text("0.0\n0.1\n")
    with pytest.raises(RecordingError, match=r"times\.txt: holds 2 times for 1 scans"):
        read(tmp_path)
    (tmp_path / "times.txt").write_text("noon\n")
    with pytest.raises(RecordingError, match=r"times\.txt: line 1 is no time: 'noon'"):
        read(tmp_path)
    (tmp_path / "times.txt").write_text("0.5\n")
    (tmp_path / "000001.bin").write_bytes(bytes(17))
    with pytest.raises(RecordingError, match=r"000001\.bin: not a readable scan \(17 bytes are no whole number"):
        read(tmp_path)
