"""What SLAM programs are fed with: clouds and planar scans of a recording, in order of time."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from benchmarks.slam.errors import SlamError
from scene.reading.scans import parse_pointcloud2

Sweep = tuple[float, Float[np.ndarray, "n 3"]]  # stamp, s; points in the sensor's frame, m
CLOUDS, PLANAR = "/points", "/scan_dense"


def clouds(folder: Path, topic: str = CLOUDS) -> Iterator[Sweep]:
    """Sweeps of the LiDAR in three dimensions.

    Args:
        folder: The recording's bag.
        topic: Of `sensor_msgs/PointCloud2`.

    Raises:
        SlamError: The folder holds no bag, a damaged one, or not this topic.
    """
    for message in _messages(folder, topic):
        scan, _ = parse_pointcloud2(message, _stamp(message))
        yield scan.stamp, np.asarray(scan.points, np.float64)


def planar(folder: Path, topic: str = PLANAR) -> Iterator[Sweep]:
    """Planar scans as points at height 0; beams that hit nothing are left out.

    Args:
        folder: The recording's bag.
        topic: Of `sensor_msgs/LaserScan`.

    Raises:
        SlamError: As for `clouds`.
    """
    for message in _messages(folder, topic):
        ranges = np.asarray(message.ranges, np.float64)
        bearing = message.angle_min + message.angle_increment * np.arange(len(ranges))
        seen = (ranges >= message.range_min) & (ranges < message.range_max)
        level = ranges[seen, None] * np.column_stack([np.cos(bearing[seen]), np.sin(bearing[seen])])
        yield _stamp(message), np.column_stack([level, np.zeros(len(level))])


def topics(folder: Path) -> dict[str, int]:
    """Topics of a bag, and how many messages each has.

    Raises:
        SlamError: The folder holds no bag, or a damaged one.
    """
    with closing(_opened(folder)) as reader:
        return {connection.topic: connection.msgcount for connection in reader.connections}


def _messages(folder: Path, topic: str) -> Iterator[Any]:
    types = get_typestore(Stores.ROS2_JAZZY)
    with closing(_opened(folder)) as reader:
        some = [connection for connection in reader.connections if connection.topic == topic]
        if not some:
            held = ", ".join(sorted(connection.topic for connection in reader.connections))
            raise SlamError(f"{folder}: has no topic {topic}; it has {held}")
        for connection, _, raw in reader.messages(connections=some):
            yield types.deserialize_cdr(raw, connection.msgtype)


def _opened(folder: Path) -> Any:
    if not (folder / "metadata.yaml").is_file():
        raise SlamError(f"{folder}: is no recording: metadata.yaml is missing")
    try:
        reader = Reader(folder)
        reader.open()
    except Exception as error:  # the library raises whatever it meets in a damaged file
        raise SlamError(f"{folder}: not a whole recording ({error})") from error
    return reader


def _stamp(message: Any) -> float:
    return float(message.header.stamp.sec + message.header.stamp.nanosec * 1e-9)
