"""Any recording as a stream of timed scans. Today: ROS1 bags with Livox `CustomMsg`."""

import struct
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

import numpy as np
from jaxtyping import Float
from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import ReaderError
from rosbags.typesys import Stores, get_typestore

from scene.errors import RecordingError
from scene.livox import MESSAGE_TYPES, parse_custom_msg
from scene.scan import Scan

_IMU_TYPE = "sensor_msgs/msg/Imu"


class Recording:
    """An open ROS1 bag. A context manager; iterate `scans()` as often as needed.

    Attributes:
        path: The bag.
        topic: The LiDAR topic read.
        scan_count: Scans in the bag.

    Raises:
        RecordingError: Not a bag, truncated, or without a LiDAR topic.
    """

    def __init__(self, path: Path, topic: str | None = None) -> None:
        self.path = path
        try:
            self._reader = Reader(path)
            self._reader.open()
        except (ReaderError, OSError, ValueError, KeyError, struct.error, AssertionError) as error:
            raise RecordingError(
                f"{path}: not a whole ROS1 bag ({error}); was it truncated or never closed?"
            ) from error
        try:
            self._connection = self._find_lidar(topic)
        except RecordingError:
            self._reader.close()
            raise
        self.topic = self._connection.topic
        self.scan_count = self._connection.msgcount

    def __enter__(self) -> "Recording":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._reader.close()

    def _find_lidar(self, topic: str | None):
        lidars = [c for c in self._reader.connections if c.msgtype in MESSAGE_TYPES]
        chosen = [c for c in lidars if topic in (None, c.topic)]
        if not chosen:
            held = ", ".join(sorted(f"{c.topic} ({c.msgtype})" for c in self._reader.connections)) or "nothing"
            wanted = f"LiDAR topic {topic}" if topic else "LiDAR topic (livox_ros_driver/CustomMsg)"
            raise RecordingError(f"{self.path}: has no {wanted}; it holds {held}")
        return max(chosen, key=lambda connection: connection.msgcount)

    def scans(self) -> Iterator[Scan]:
        """The scans in the order of the bag.

        Raises:
            RecordingError: A message is damaged; says which.
        """
        try:
            for index, (_, _, raw) in enumerate(self._reader.messages(connections=[self._connection])):
                try:
                    yield parse_custom_msg(bytes(raw))
                except ValueError as error:
                    raise RecordingError(f"{self.path}: scan {index} of {self.topic} is {error}") from error
        except (ReaderError, struct.error, EOFError, KeyError, AssertionError) as error:
            raise RecordingError(f"{self.path}: damaged while reading {self.topic} ({error})") from error

    def up_at_start(self, duration: float) -> Float[np.ndarray, "3"] | None:
        """Direction against gravity in the LiDAR's frame at the start, `(3,)` unit, or `None` without an IMU.

        The IMU beside the LiDAR's topic is read (`/livox/imu` for `/livox/lidar`), which shares its axes; its unit does
        not matter.

        Args:
            duration: How long to average, s.
        """
        beside = self.topic.rsplit("/", 1)[0]
        imus = [c for c in self._reader.connections if c.msgtype == _IMU_TYPE and c.topic.rsplit("/", 1)[0] == beside]
        if not imus:
            return None
        store, total, start = get_typestore(Stores.ROS1_NOETIC), np.zeros(3), None
        for _, stamp, raw in self._reader.messages(connections=imus[:1]):
            start = stamp if start is None else start
            if stamp - start > duration * 1e9:
                break
            force = store.deserialize_ros1(raw, _IMU_TYPE).linear_acceleration  # type: ignore[attr-defined]
            total += (force.x, force.y, force.z)
        length = float(np.linalg.norm(total))
        return total / length if np.isfinite(length) and length > 0 else None
