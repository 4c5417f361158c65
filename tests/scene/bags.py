"""Small ROS1 bags with Livox scans, written here so that the reader is tested against an independent writer."""

from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from scene.survey.messages import CUSTOM_DEFINITION, CUSTOM_TYPE

MD5 = "e4d6829bdfe657cb6c21a746c86b21a6"


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
        connection = writer.add_connection(topic, CUSTOM_TYPE, msgdef=CUSTOM_DEFINITION, md5sum=MD5)
        for stamp, points in scans:
            writer.write(connection, int(stamp * 1e9), custom_msg(stamp, points))
    return path


def write_imu_bag(path: Path, points: np.ndarray, count: int, sample=lambda k: ([0.01, 0, 0.1], [0, 0, 1])) -> Path:
    """A bag with one sweep and `count` samples of `/livox/imu` at 200 Hz: rate and force, at rest and in g."""
    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer(path) as writer:
        lidar = writer.add_connection("/livox/lidar", CUSTOM_TYPE, msgdef=CUSTOM_DEFINITION, md5sum=MD5)
        writer.write(lidar, int(5e9), custom_msg(5.0, points))
        imu = writer.add_connection("/livox/imu", "sensor_msgs/msg/Imu", typestore=store)
        for k in range(count):
            (rate, force), none = sample(k), np.zeros(9)
            head = np.array([k, 5 + k // 200, 5_000_000 * (k % 200), 5], "<u4").tobytes() + b"livox"
            numbers = np.concatenate([[0.0, 0, 0, 1], none, rate, none, force, none])
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
