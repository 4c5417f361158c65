"""ROS1 bags, ROS2 bags and MCAP files: the scans of their LiDAR topic, one message at a time.

The library's reader takes MCAP files of the ROS2 profile alone, although the format is the same for all.

Source: MCAP specification, "Header", "Schema"; well-known profiles `ros1` and `ros2`, an empty one for any other
writer, and well-known encodings `ros1msg`, `ros2msg` (schemas), `ros1`, `cdr` (messages). Livox: livox_ros_driver,
message md5 e4d6829bdfe657cb6c21a746c86b21a6; livox_ros_driver2 publishes the same fields.
"""

import struct
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from jaxtyping import Shaped
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.typesys import Stores, get_typestore

from scene.errors import RecordingError
from scene.reading.scans import ScanSource, scan_from_records
from scene.reading.source import INTENSITIES, cause, one_line, refuse_damage
from scene.reading.times import RawScan, make_scan, time_field

_PROFILE_AT = 17  # byte after magic, opcode and length of the header record; its two strings take 8 bytes or more
_ROS2_PROFILE = b"\x04\0\0\0ros2"
_KNOWN_SCHEMAS = ("ros2msg", "ros2idl", "omgidl", "")


class _Ros2Header:
    """A file with the first eight bytes of its header record replaced; nothing behind them is read by position."""

    def __init__(self, file: IO[Any]) -> None:
        self._file = file
        self.seek, self.tell, self.close = file.seek, file.tell, file.close

    def read(self, size: int = -1) -> bytes:
        start = self._file.tell()
        data = self._file.read(size)
        if start >= _PROFILE_AT + len(_ROS2_PROFILE) or start + len(data) <= _PROFILE_AT:
            return data
        patched = bytearray(data)
        for place, byte in enumerate(_ROS2_PROFILE, _PROFILE_AT - start):
            if 0 <= place < len(data):
                patched[place] = byte
        return bytes(patched)


class _Schemas(dict[int, Any]):
    """Schemas by number; of those in a language that the library does not know, the name alone is kept."""

    def __setitem__(self, key: int, schema: Any) -> None:
        package, _, kind = schema.name.partition("/")
        name = f"{package}/msg/{kind}" if kind and "/" not in kind else schema.name
        known = schema.encoding in _KNOWN_SCHEMAS
        super().__setitem__(
            key, schema._replace(name=name) if known else schema._replace(name=name, encoding="", data="")
        )


class _Mcap(McapReader):
    """The library's reader, for files of any profile."""

    bio: Any

    def _open(self) -> None:
        self.bio, self.schemas = _Ros2Header(self.bio), _Schemas()
        super()._open()


LIVOX_TYPES = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")

_LIVOX_POINT = np.dtype([
    ("offset_time", "<u4"), ("x", "<f4"), ("y", "<f4"), ("z", "<f4"),
    ("reflectivity", "u1"), ("tag", "u1"), ("line", "u1"),
])  # fmt: skip
# CDR aligns each point's first word: one byte of padding between points, none after the last.
_LIVOX_POINT_CDR = np.dtype({"names": ["point"], "formats": [_LIVOX_POINT], "itemsize": _LIVOX_POINT.itemsize + 1})
# Bits 4-5 of the tag: 0b00 and 0b01 are returns to trust, the others are noise by intensity or by place.
_TAG_RETURN_MASK = 0x20


def parse_custom_msg(raw: bytes, cdr: bool = False) -> RawScan:
    """Parses a `CustomMsg` as ROS1 serialises it, or ROS2 (CDR, little-endian); `ValueError` where it is no whole one.

    Points at the origin (no return), not finite, or tagged as noise are dropped.
    """
    try:
        if cdr and raw[:2] != b"\x00\x01":
            raise ValueError(f"encapsulation {raw[:2].hex()} is not little-endian CDR")
        body = raw[4:] if cdr else raw  # alignment counts from behind the encapsulation header
        secs, nsecs, frame_length = struct.unpack_from("<iII" if cdr else "<4xIII", body, 0)
        timebase = -(-(12 + frame_length) // 8) * 8 if cdr else 16 + frame_length
        offset = timebase + struct.calcsize("<QIB3B")
        (count,) = struct.unpack_from("<I", body, offset)
        if cdr:
            body += b"\0" * (len(body) == offset + 3 + count * _LIVOX_POINT_CDR.itemsize)  # the last padding may miss
            points = np.frombuffer(body, _LIVOX_POINT_CDR, count, offset + 4)["point"]
        else:
            points = np.frombuffer(body, _LIVOX_POINT, count, offset + 4)
    except (struct.error, ValueError) as error:
        raise ValueError(f"not a whole CustomMsg: {error}") from error
    points = points[points["tag"] & _TAG_RETURN_MASK == 0]
    xyz = np.stack([points["x"], points["y"], points["z"]], axis=1)
    scan = make_scan(secs + nsecs * 1e-9, xyz, points["offset_time"], "offset_time", points["reflectivity"])
    return replace(scan, unit="ns")


POINTCLOUD2_TYPE = "sensor_msgs/msg/PointCloud2"
# Source: sensor_msgs/PointField, INT8 = 1 … FLOAT64 = 8.
_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def cloud_records(message: Any) -> Shaped[np.ndarray, " n"]:
    """Return the points of a PointCloud2 as records of x, y, z and any time, without padding at the end of rows.

    Raises `ValueError` without coordinates, or for a layout that contradicts itself.
    """
    width, height, step, row = message.width, message.height, message.point_step, message.row_step
    if not width * height:
        return np.empty(0, [("x", "f4"), ("y", "f4"), ("z", "f4")])
    layout = _record_layout(message, step)
    data = np.asarray(message.data, np.uint8)
    row = row or width * step
    if row < width * step or (height - 1) * row + width * step > len(data):
        raise ValueError(
            f"a PointCloud2 of {height} rows of {width} points of {step} bytes (row_step {row}) in {len(data)} bytes"
        )
    if row == width * step:
        return np.frombuffer(data.tobytes(), layout, width * height)
    return np.concatenate([np.frombuffer(data[k * row :].tobytes(), layout, width) for k in range(height)])


def _record_layout(message: Any, step: int) -> np.dtype:
    order = ">" if message.is_bigendian else "<"
    names = [field.name for field in message.fields]
    needed = {time_field(names)[0], *(name for name in names if name.lower() in ("x", "y", "z", *INTENSITIES))}
    fields: dict[str, tuple[str, int]] = {}
    for field in message.fields:
        if field.name in needed and field.name not in fields:
            if field.datatype not in _FIELD_TYPES:
                raise ValueError(f"a PointCloud2 whose field {field.name} is of unknown type {field.datatype}")
            fields[field.name] = (order + _FIELD_TYPES[field.datatype], field.offset)
    if missing := [name for name in "xyz" if name not in map(str.lower, fields)]:
        raise ValueError(f"a PointCloud2 without the field {', '.join(missing)}")
    for name, (kind, offset) in fields.items():
        if offset + np.dtype(kind).itemsize > step:
            raise ValueError(f"a PointCloud2 whose field {name} at byte {offset} lies outside its {step}-byte points")
    formats, offsets = zip(*fields.values(), strict=True)
    return np.dtype({"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": step})


_BAG_NAMES = {"bag": "ROS1 bag", "rosbag2": "ROS2 bag", "db3": "ROS2 bag", "mcap": "MCAP file"}
# Where several topics carry clouds, the sensor's own comes before what other programs made of it.
_SENSOR_WORDS = ("velodyne", "ouster", "os_cloud", "os1", "livox", "hesai", "pandar", "rslidar", "lidar", "points")
_DERIVED_WORDS = ("map", "registered", "filtered", "ground", "cluster", "obstacle", "corrected", "global")


class RosBag(ScanSource):
    """An open bag and its LiDAR topic.

    Raises:
        RecordingError: Not a bag of that format, truncated, or without a LiDAR topic.
    """

    def __init__(self, format: str, path: Path, topic: str | None, more: tuple[Path, ...] = ()) -> None:
        self.path, self._ros1 = path, format == "bag"
        name = _BAG_NAMES[format]
        parts = [file for given in (path, *more) for file in bags_in(given, format)]
        readers: list[Any] = []
        for part in parts:
            with refuse_damage(part, f"a whole {name}; was it truncated or never closed?", RecordingError):
                readers.append(_open_reader(part, format))
        self.reader = readers[0] if len(readers) == 1 else _Chain(readers)
        try:
            self._connections, others = self._choose(topic)
        except RecordingError:
            self.close()
            raise
        self._ros1 = self._ros1 or getattr(self._connections[0].ext, "serialization_format", "") == "ros1"
        self._store = get_typestore(Stores.ROS1_NOETIC if self._ros1 else Stores.ROS2_HUMBLE)
        self.topic, self._type = self._connections[0].topic, self._connections[0].msgtype
        self.scan_count = sum(connection.msgcount for connection in self._connections)
        self.facts = {"kind": name, "topic": self.topic, "message_type": self._type}
        if len(readers) > 1:
            self.facts["bags"] = len(readers)
        if others:
            self.facts["other_lidar_topics"] = others

    def close(self) -> None:
        self.reader.close()

    def deserialize(self, raw: bytes, message_type: str) -> Any:
        """Return a message of a standard type as an object."""
        if self._ros1:
            return self._store.deserialize_ros1(raw, message_type)
        return self._store.deserialize_cdr(raw, message_type)

    def scans(self, only: frozenset[int] | None = None) -> Iterator[RawScan]:
        """Yields the scans in the order of the bag.

        Of `only` some the others are not parsed. Raises `RecordingError`, which says which
        message is damaged.
        """
        index, last = 0, self.scan_count if only is None else max(only, default=-1)
        messages = self.reader.messages(connections=self._connections)
        while index <= last:
            try:
                _, received, raw = next(messages)
            except StopIteration:
                return
            except Exception as error:  # the library raises anything from struct.error to AssertionError on damage
                raise RecordingError(
                    f"{self.path}: damaged after scan {index} of {self.topic} ({cause(error)})"
                ) from error
            if only is not None and index not in only:
                index += 1
                continue
            try:
                yield self._parse(bytes(raw), received * 1e-9)
            except Exception as error:
                raise RecordingError(f"{self.path}: scan {index} of {self.topic} is {cause(error)}") from error
            index += 1

    def _parse(self, raw: bytes, received: float) -> RawScan:
        if self._type in LIVOX_TYPES:
            scan = parse_custom_msg(raw, cdr=not self._ros1)
        else:
            try:
                message = self.deserialize(raw, POINTCLOUD2_TYPE)
            except Exception as error:
                raise ValueError(f"not a whole PointCloud2: {cause(error)}") from error
            stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
            scan = scan_from_records(stamp, cloud_records(message))
        return replace(scan, received=received)

    def _choose(self, topic: str | None) -> tuple[list[Any], list[str]]:
        """Return the LiDAR's connections (one for each publisher), and the other topics that could have been it."""
        lidars = [c for c in self.reader.connections if c.msgtype in (*LIVOX_TYPES, POINTCLOUD2_TYPE)]
        chosen = [c for c in lidars if topic in (None, c.topic)]
        if not chosen:
            held = ", ".join(sorted(f"{c.topic} ({c.msgtype})" for c in self.reader.connections)) or "nothing"
            missing = f"LiDAR topic {topic}" if topic else "LiDAR topic (livox CustomMsg or sensor_msgs/PointCloud2)"
            raise RecordingError(f"{self.path}: has no {missing}; it holds {one_line(held)}")
        best = max(chosen, key=_likelihood)
        alike = sorted({c.topic for c in chosen if _likelihood(c)[:3] == _likelihood(best)[:3]})
        if len(alike) > 1:
            raise RecordingError(f"{self.path}: holds {len(alike)} LiDARs, {', '.join(alike)}; --topic says which")
        same = [c for c in chosen if (c.topic, c.msgtype) == (best.topic, best.msgtype)]
        return same, sorted({c.topic for c in lidars} - {best.topic})


def bags_in(path: Path, format: str) -> list[Path]:
    """Return the bags that an input holds: itself, or all of a folder without metadata, by their names."""
    if not path.is_dir() or (path / "metadata.yaml").is_file():
        return [path]
    return sorted(file for file in path.iterdir() if file.suffix == f".{format}")


class _Chain:
    """Bags one after another, in the order of their first messages: a recording that was split."""

    def __init__(self, readers: list[Any]) -> None:
        first = {id(one): next((row[1] for row in one.messages(connections=one.connections)), 0) for one in readers}
        self._readers = sorted(readers, key=lambda reader: first[id(reader)])
        self._connections = [list(reader.connections) for reader in self._readers]

    @property
    def connections(self) -> list[Any]:
        return [connection for own in self._connections for connection in own]

    def messages(self, connections: Iterable[Any]) -> Iterator[tuple[Any, int, bytes]]:
        """Yields the messages of some connections, bag by bag."""
        needed = {id(connection) for connection in connections}
        for reader, held in zip(self._readers, self._connections, strict=True):
            own = [connection for connection in held if id(connection) in needed]
            if own:
                yield from reader.messages(connections=own)

    def close(self) -> None:
        for reader in self._readers:
            reader.close()


def _likelihood(connection: Any) -> tuple[bool, bool, bool, int]:
    name = connection.topic.lower()
    return (
        not any(word in name for word in _DERIVED_WORDS),
        connection.msgtype in LIVOX_TYPES,
        any(word in name for word in _SENSOR_WORDS),
        connection.msgcount,
    )


def _open_reader(path: Path, format: str) -> Any:
    """Opens a folder, or one storage file whatever its name ends in, with the library's reader."""
    if format in ("mcap", "bag"):
        reader: Any = _Mcap(path) if format == "mcap" else Reader1(path)
    else:
        reader = Reader2(path) if path.is_dir() else Reader2.STORAGE_PLUGINS[f".{format}"](path)
    reader.open()
    return reader
