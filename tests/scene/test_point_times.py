"""The drivers' conventions of per-point times, each as a bag that the driver could have written."""

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from scene.errors import RecordingError
from scene.reading.recording import Recording
from tests.scene.messages import (
    LIVOX2,
    OUSTER,
    PLAIN,
    POINTCLOUD2,
    VELODYNE,
    livox_cdr,
    pointcloud2,
    write_bag1,
    write_bag2,
    write_mcap,
)

XYZ = np.random.default_rng(0).uniform(1, 9, (40, 3)).astype(np.float32)
SWEEP = np.linspace(0, 0.0975, 40)


def columns(points=XYZ, **extra):
    return {"x": points[:, 0], "y": points[:, 1], "z": points[:, 2], **extra}


def read(path, **options):
    with Recording(path, **options) as recording:
        return list(recording.scans()), recording.facts


@pytest.mark.parametrize("extra", [{}, {"time": np.zeros(40)}])
def test_a_cloud_without_point_times_is_a_static_sweep_and_says_so(tmp_path, extra):
    fields, step = (VELODYNE, 22) if extra else (PLAIN, 12)
    raw = pointcloud2(5.0, fields, step, columns(**extra))
    (scan,), facts = read(write_bag1(tmp_path / "a.bag", {"/points": [(5.0, raw)]}))
    assert "static" in facts["point_times"]
    assert scan.stamp == 5.0
    assert not scan.times.any()


def test_sweeps_without_times_and_headers_stand_at_the_time_of_recording(tmp_path):
    raws = [(5.0 + k, pointcloud2(0.0, PLAIN, 12, columns())) for k in range(3)]
    scans, facts = read(write_bag1(tmp_path / "a.bag", {"/points": raws}))
    assert [scan.stamp for scan in scans] == [5.0, 6.0, 7.0]
    assert "static" in facts["point_times"]
    assert facts["point_times"].endswith("headers repeat, so the time of recording stands for them")


def test_the_sensor_s_topic_is_preferred_and_the_others_are_named(tmp_path):
    messages = [(5.0 + k, pointcloud2(5.0 + k, PLAIN, 12, columns())) for k in range(3)]
    bag = write_bag1(tmp_path / "a.bag", {"/cloud_registered": messages, "/velodyne_points": messages[:1]})
    _, facts = read(bag)
    assert facts["topic"] == "/velodyne_points"
    assert facts["other_lidar_topics"] == ["/cloud_registered"]
    _, facts = read(bag, topic="/cloud_registered", format="bag")
    assert facts["topic"] == "/cloud_registered"


def test_livox_messages_of_ros2_read_with_their_alignment(tmp_path):
    folder = write_bag2(tmp_path / "b", StoragePlugin.SQLITE3, "/livox/lidar", LIVOX2, [(9.0, livox_cdr(9.0, XYZ))])
    (scan,), _ = read(folder)
    np.testing.assert_array_equal(scan.points, XYZ)
    np.testing.assert_allclose(scan.times, 1e-6 * np.arange(40), atol=1e-12)


@pytest.mark.parametrize(
    ("profile", "schema", "message", "name"),
    [
        ("", "ros2msg", "cdr", POINTCLOUD2),
        ("ros1", "ros1msg", "ros1", "sensor_msgs/PointCloud2"),
        ("", "ros1msg", "ros1", "sensor_msgs/PointCloud2"),
        ("a profile of one's own", "omgidl", "cdr", POINTCLOUD2),
    ],
)
def test_mcap_files_of_any_profile_read_by_the_encoding_of_their_messages(tmp_path, profile, schema, message, name):
    times = (SWEEP * 1e9).astype("u4")
    raws = [(100.0 + k, pointcloud2(100.0 + k, OUSTER, 32, columns(t=times), cdr=message == "cdr")) for k in range(3)]
    scans, facts = read(write_mcap(tmp_path / "a.mcap", profile, (schema, message), name, raws))
    assert [scan.stamp for scan in scans] == [100.0, 101.0, 102.0]
    assert facts["message_type"] == POINTCLOUD2
    np.testing.assert_array_equal(scans[2].points, XYZ)


def test_an_mcap_of_other_messages_says_what_it_holds(tmp_path):
    bag = write_mcap(tmp_path / "a.mcap", "", ("protobuf", "protobuf"), "foxglove.PointCloud", [(1.0, b"x")])
    with pytest.raises(RecordingError, match=r"a\.mcap: has no LiDAR topic .*/points \(foxglove\.PointCloud\)"):
        read(bag)


BAD = {
    "times of no sweep": (pointcloud2(5.0, VELODYNE, 22, columns(time=np.geomspace(1, 1e20, 40))), "spans"),
    "no coordinates": (pointcloud2(5.0, [("x", "f4", 0)], 4, {"x": XYZ[:, 0]}), "without the field y, z"),
    "a field outside": (
        pointcloud2(5.0, PLAIN, 12, columns()).replace(b"z\x08\0\0\0", b"z\x0a\0\0\0"),
        "outside its 12-byte points",
    ),
    "too many points": (pointcloud2(5.0, PLAIN, 12, columns(), point_count=10**9), "in 480 bytes"),
    "truncated": (pointcloud2(5.0, PLAIN, 12, columns())[:150], "not a whole PointCloud2"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_damaged_cloud_message_is_named_with_its_place_and_cause(tmp_path, name):
    raw, cause = BAD[name]
    good = pointcloud2(4.0, PLAIN, 12, columns())
    bag = write_bag1(tmp_path / "a.bag", {"/points": [(4.0, good), (5.0, raw)]})
    with pytest.raises(RecordingError, match=rf"a\.bag: scan 1 of /points is .*{cause}"):
        read(bag)


def test_one_repeated_time_is_left_out_and_counted_and_many_are_refused(tmp_path):
    def bag(name, stamps):
        messages = [(1.0 + k, pointcloud2(s, PLAIN, 12, columns())) for k, s in enumerate(stamps)]
        return write_bag1(tmp_path / name, {"/points": messages})

    scans, facts = read(bag("one.bag", [5.0, 5.1, 5.1, 5.2]))
    assert [scan.stamp for scan in scans] == pytest.approx([5.0, 5.1, 5.2])
    assert facts["scans_out_of_order"] == 1
    with pytest.raises(RecordingError, match=r"many\.bag: the times of /points do not grow: scan 2 is of 4\.800 s"):
        read(bag("many.bag", [5.0, 4.9, 4.8, 4.7]))
