"""ROS1 bags, ROS2 bags and MCAP files: the LiDAR topic of each as scans, one message at a time."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.typesys import Stores, get_typestore

from scene.errors import RecordingError
from scene.reading import livox
from scene.reading.cause import cause, one_line, refusing
from scene.reading.mcap import is_ros1, open_mcap
from scene.reading.pointcloud2 import MESSAGE_TYPE, parse_pointcloud2
from scene.reading.scan import Scan

_NAMES = {"bag": "ROS1 bag", "rosbag2": "ROS2 bag", "db3": "ROS2 bag", "mcap": "MCAP file"}
# Where several topics carry clouds, the sensor's own comes before what other programs made of it.
_SENSOR_WORDS = ("velodyne", "ouster", "os_cloud", "os1", "livox", "hesai", "pandar", "rslidar", "lidar", "points")
_DERIVED_WORDS = ("map", "registered", "filtered", "ground", "cluster", "obstacle", "corrected", "global")


class RosBag:
    """An open bag and its LiDAR topic.

    Attributes:
        reader: The library's reader, for what lies beside the LiDAR: `connections`, `messages(connections=…)`.
        topic: The LiDAR topic.
        scan_count: Its messages.
        facts: What was detected; the convention of point times is known after the first scan.

    Raises:
        RecordingError: Not such a bag, truncated, or without a LiDAR topic.
    """

    def __init__(self, path: Path, format: str, topic: str | None) -> None:
        self.path, self._ros1 = path, format == "bag"
        name = _NAMES[format]
        with refusing(path, f"a whole {name}; was it truncated or never closed?", RecordingError):
            self.reader: Any = _opened(path, format)
        try:
            self._connections, others = self._choose(topic)
        except RecordingError:
            self.close()
            raise
        self._ros1 = self._ros1 or is_ros1(self._connections[0])
        self._store = get_typestore(Stores.ROS1_NOETIC if self._ros1 else Stores.ROS2_HUMBLE)
        self.topic, self._type = self._connections[0].topic, self._connections[0].msgtype
        self.scan_count = sum(connection.msgcount for connection in self._connections)
        self.facts: dict[str, Any] = {"kind": name, "topic": self.topic, "message_type": self._type}
        if others:
            self.facts["other_lidar_topics"] = others

    def close(self) -> None:
        """Closes the file."""
        self.reader.close()

    def deserialize(self, raw: bytes, message_type: str) -> Any:
        """A message of a standard type as an object."""
        if self._ros1:
            return self._store.deserialize_ros1(raw, message_type)
        return self._store.deserialize_cdr(raw, message_type)

    def scans(self, skip: int = 0) -> Iterator[Scan]:
        """The scans in the order of the bag; a header without a stamp takes the time of its message.

        Args:
            skip: Messages at the start that are not parsed.

        Raises:
            RecordingError: A message is damaged; says which.
        """
        index = 0
        messages = self.reader.messages(connections=self._connections)
        while True:
            try:
                _, received, raw = next(messages)
            except StopIteration:
                return
            except Exception as error:  # the library raises anything from struct.error to AssertionError on damage
                raise RecordingError(
                    f"{self.path}: damaged after scan {index} of {self.topic} ({cause(error)})"
                ) from error
            if index < skip:
                index += 1
                continue
            try:
                yield self._parse(bytes(raw), received * 1e-9)
            except Exception as error:
                raise RecordingError(f"{self.path}: scan {index} of {self.topic} is {cause(error)}") from error
            index += 1

    def _parse(self, raw: bytes, received: float) -> Scan:
        if self._type in livox.MESSAGE_TYPES:
            scan = livox.parse_custom_msg(raw) if self._ros1 else livox.parse_custom_msg_cdr(raw)
            convention = "`offset_time`, ns after the stamp (its start)"
        else:
            try:
                message = self.deserialize(raw, MESSAGE_TYPE)
            except Exception as error:
                raise ValueError(f"not a whole PointCloud2: {cause(error)}") from error
            stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
            scan, convention = parse_pointcloud2(message, stamp or received)
        if convention:
            self.facts.setdefault("point_times", convention)
        return scan

    def _choose(self, topic: str | None) -> tuple[list[Any], list[str]]:
        """The LiDAR's connections (one for each publisher), and the other topics that could have been it."""
        lidars = [c for c in self.reader.connections if c.msgtype in (*livox.MESSAGE_TYPES, MESSAGE_TYPE)]
        chosen = [c for c in lidars if topic in (None, c.topic)]
        if not chosen:
            held = ", ".join(sorted(f"{c.topic} ({c.msgtype})" for c in self.reader.connections)) or "nothing"
            wanted = f"LiDAR topic {topic}" if topic else "LiDAR topic (livox CustomMsg or sensor_msgs/PointCloud2)"
            raise RecordingError(f"{self.path}: has no {wanted}; it holds {one_line(held)}")
        best = max(chosen, key=_likelihood)
        same = [c for c in chosen if (c.topic, c.msgtype) == (best.topic, best.msgtype)]
        return same, sorted({c.topic for c in lidars} - {best.topic})


def _likelihood(connection: Any) -> tuple[bool, bool, bool, int]:
    name = connection.topic.lower()
    return (
        not any(word in name for word in _DERIVED_WORDS),
        connection.msgtype in livox.MESSAGE_TYPES,
        any(word in name for word in _SENSOR_WORDS),
        connection.msgcount,
    )


def _opened(path: Path, format: str) -> Any:
    """The library's reader of a folder, or of one storage file whatever its name ends in."""
    if format == "mcap":
        return open_mcap(path)
    reader: Any
    if format == "bag":
        reader = Reader1(path)
    else:
        reader = Reader2(path) if path.is_dir() else Reader2.STORAGE_PLUGINS[f".{format}"](path)
    reader.open()
    return reader
