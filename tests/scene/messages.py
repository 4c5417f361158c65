"""PointCloud2 and Livox messages written byte by byte, so that the readers are tested against an independent writer."""

import struct
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

POINTCLOUD2 = "sensor_msgs/msg/PointCloud2"
LIVOX2 = "livox_ros_driver2/msg/CustomMsg"
CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}

PLAIN = [("x", "f4", 0), ("y", "f4", 4), ("z", "f4", 8)]
VELODYNE = [*PLAIN, ("intensity", "f4", 12), ("ring", "u2", 16), ("time", "f4", 18)]
OUSTER = [*PLAIN, ("intensity", "f4", 16), ("t", "u4", 20), ("ring", "u1", 26)]


class _Out:
    """Bytes with CDR's alignment, or none for ROS1."""

    def __init__(self, cdr: bool) -> None:
        self.cdr, self.body = cdr, bytearray()

    def put(self, kind: str, *values: int) -> None:
        for value in values:
            size = struct.calcsize("<" + kind)
            if self.cdr:
                self.body += bytes(-len(self.body) % size)
            self.body += struct.pack("<" + kind, value)

    def string(self, text: str) -> None:
        raw = text.encode() + (b"\0" if self.cdr else b"")
        self.put("I", len(raw))
        self.body += raw

    def done(self) -> bytes:
        return (b"\0\1\0\0" if self.cdr else b"") + bytes(self.body)


def pointcloud2(
    stamp: float, fields, step: int, columns: dict, cdr=False, big=False, height=1, row_padding=0, point_count=None
) -> bytes:
    """One serialised message with the given layout; bytes between the fields are filled with 0xAB."""
    count = len(next(iter(columns.values())))
    layout = np.dtype(
        {
            "names": [f[0] for f in fields],
            "formats": [(">" if big else "<") + f[1] for f in fields],
            "offsets": [f[2] for f in fields],
            "itemsize": step,
        }
    )
    raw = np.frombuffer(bytearray(b"\xab" * (count * step)), layout)
    for name, values in columns.items():
        raw[name] = values
    width = count // height
    data = b"".join(raw[k * width : (k + 1) * width].tobytes() + bytes(row_padding) for k in range(height))
    out = _Out(cdr)
    if not cdr:
        out.put("I", 7)
    out.put("I", int(stamp), round(stamp % 1 * 1e9))
    out.string("lidar")
    out.put("I", height, width if point_count is None else point_count, len(fields))
    for name, kind, offset in fields:
        out.string(name)
        out.put("I", offset)
        out.put("B", CODES[kind])
        out.put("I", 1)
    out.put("B", int(big))
    out.put("I", step, width * step + row_padding, len(data))
    out.body += data
    out.put("B", 0)
    return out.done()


def livox_cdr(stamp: float, points: np.ndarray) -> bytes:
    """One `livox_ros_driver2/CustomMsg` as ROS2 serialises it."""
    out = _Out(cdr=True)
    out.put("I", int(stamp), round(stamp % 1 * 1e9))
    out.string("livox")
    out.put("Q", int(stamp * 1e9))
    out.put("I", len(points))
    out.put("B", 0, 0, 0, 0)
    out.put("I", len(points))
    for k, (x, y, z) in enumerate(points):
        out.put("I", 1000 * k)
        out.put("f", x, y, z)
        out.put("B", 100, 0x10, 1)
    return out.done()


def write_bag1(path: Path, topics: dict[str, list[tuple[float, bytes]]]) -> Path:
    """A ROS1 bag of PointCloud2 topics."""
    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer1(path) as writer:
        for topic, messages in topics.items():
            connection = writer.add_connection(topic, POINTCLOUD2, typestore=store)
            for stamp, raw in messages:
                writer.write(connection, int(stamp * 1e9), raw)
    return path


def write_bag2(folder: Path, plugin: StoragePlugin, topic: str, kind: str, messages: list[tuple[float, bytes]]) -> Path:
    """A ROS2 bag with one topic."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    definition = {"typestore": store} if kind == POINTCLOUD2 else {"msgdef": "uint8 x\n", "rihs01": "RIHS01_0"}
    with Writer2(folder, version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection(topic, kind, **definition)
        for stamp, raw in messages:
            writer.write(connection, int(stamp * 1e9), raw)
    return folder


def write_mcap(path: Path, profile: str, encodings: tuple[str, str], name: str, messages: list) -> Path:
    """An MCAP file without chunks and summary; `encodings` are of its schema and its messages."""

    def text(value: str | bytes) -> bytes:
        raw = value.encode() if isinstance(value, str) else value
        return struct.pack("<I", len(raw)) + raw

    def record(code: int, body: bytes) -> bytes:
        return struct.pack("<BQ", code, len(body)) + body

    schema, message = encodings
    body = record(1, text(profile) + text(""))
    body += record(3, struct.pack("<H", 1) + text(name) + text(schema) + text("whatever"))
    body += record(4, struct.pack("<HH", 1, 1) + text("/points") + text(message) + text(b""))
    for k, (stamp, raw) in enumerate(messages):
        body += record(5, struct.pack("<HIQQ", 1, k, int(stamp * 1e9), int(stamp * 1e9)) + raw)
    magic = b"\x89MCAP0\r\n"
    path.write_bytes(magic + body + record(15, bytes(4)) + record(2, bytes(20)) + magic)
    return path
