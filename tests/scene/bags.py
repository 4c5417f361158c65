"""Small ROS1 bags with Livox scans, written here so that the reader is tested against an independent writer."""

from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

MD5 = "e4d6829bdfe657cb6c21a746c86b21a6"
DEFINITION = """std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
================================================================================
MSG: livox_ros_driver/CustomPoint
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""


def custom_msg(stamp: float, points: np.ndarray, span: float = 0.1, tag: int = 0x10) -> bytes:
    """One serialised `livox_ros_driver/CustomMsg`."""
    seconds, nanoseconds = int(stamp), round(stamp % 1 * 1e9)
    head = np.array([0, seconds, nanoseconds, 5], "<u4").tobytes() + b"livox"
    head += np.array([int(stamp * 1e9)], "<u8").tobytes() + np.array([len(points)], "<u4").tobytes() + bytes(4)
    body = bytearray()
    for k, (x, y, z) in enumerate(points):
        body += np.array([int(span * 1e9 * k / len(points))], "<u4").tobytes()
        body += np.array([x, y, z], "<f4").tobytes() + bytes([100, tag, k % 6])
    return head + np.array([len(points)], "<u4").tobytes() + bytes(body)


def write_bag(path: Path, scans: list[tuple[float, np.ndarray]], topic: str = "/livox/lidar") -> Path:
    """A bag with one LiDAR topic."""
    with Writer(path) as writer:
        connection = writer.add_connection(topic, "livox_ros_driver/msg/CustomMsg", msgdef=DEFINITION, md5sum=MD5)
        for stamp, points in scans:
            writer.write(connection, int(stamp * 1e9), custom_msg(stamp, points))
    return path


def write_imu_bag(path: Path, points: np.ndarray, count: int) -> Path:
    """A bag with one sweep and `count` samples of `/livox/imu` at 200 Hz, at rest and in g."""
    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer(path) as writer:
        lidar = writer.add_connection("/livox/lidar", "livox_ros_driver/msg/CustomMsg", msgdef=DEFINITION, md5sum=MD5)
        writer.write(lidar, int(5e9), custom_msg(5.0, points))
        imu = writer.add_connection("/livox/imu", "sensor_msgs/msg/Imu", typestore=store)
        for k in range(count):
            head = np.array([k, 5, 5_000_000 * k, 5], "<u4").tobytes() + b"livox"
            numbers = np.concatenate([[0.0, 0, 0, 1], np.zeros(9), [0.01, 0, 0.1], np.zeros(9), [0, 0, 1], np.zeros(9)])
            writer.write(imu, int(5e9) + 5_000_000 * k, head + numbers.astype("<f8").tobytes())
    return path


def write_bag_without_lidar(path: Path) -> Path:
    """A bag that holds one string and no scan."""
    with Writer(path) as writer:
        connection = writer.add_connection(
            "/note", "std_msgs/msg/String", msgdef="string data\n", md5sum="992ce8a1687cec8c8bd883ec73ca41d1"
        )
        writer.write(connection, 1, np.array([2], "<u4").tobytes() + b"hi")
    return path


def write_tum(path: Path, rows: np.ndarray) -> Path:
    """Rows of `t x y z qx qy qz qw`."""
    np.savetxt(path, rows, fmt="%.9f")
    return path
