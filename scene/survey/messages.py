"""ROS messages of LiDARs and IMUs, by the thousand, in the conventions of drivers: times, headers, layouts, files.

A survey is written in any of them, so that readers can be tried on all.
"""

import math
import shutil
import struct
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, Literal

import numpy as np
import tyro
import yaml
from jaxtyping import Float
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from scene.survey.lidar import Lidar, Sweep
from subterra_jax.host.files import replace_file, replace_folder

EPOCH = 1_700_000_000  # s: stamp of the first point, the same for every survey

CUSTOM_TYPE, IMU_TYPE = "livox_ros_driver/msg/CustomMsg", "sensor_msgs/msg/Imu"
CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
_RULE = "=" * 80
CUSTOM_DEFINITION = f"""Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points

{_RULE}
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id

{_RULE}
MSG: livox_ros_driver/CustomPoint
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""
STORE = get_typestore(Stores.ROS1_NOETIC)  # definitions of all messages here
STORE.register(get_types_from_msg(CUSTOM_DEFINITION, CUSTOM_TYPE))

# CustomPoint as it lies in the message: 19 bytes, packed.
POINT = np.dtype([
    ("offset_time", "<u4"), ("x", "<f4"), ("y", "<f4"), ("z", "<f4"),
    ("reflectivity", "u1"), ("tag", "u1"), ("line", "u1"),
])  # fmt: skip


def unix_nanoseconds(nanoseconds: int) -> int:
    """Return a time since the start of the survey, ns, as a time since the Unix epoch, ns."""
    return EPOCH * 1_000_000_000 + nanoseconds


def make_header(seq: int, nanoseconds: int, frame: bytes) -> bytes:
    """Serialises a `std_msgs/Header` stamped `nanoseconds` after the start of the survey."""
    seconds, rest = divmod(unix_nanoseconds(nanoseconds), 1_000_000_000)
    return struct.pack("<IIII", seq, seconds, rest, len(frame)) + frame


def custom_message(sweep: Sweep, lidar: Lidar) -> bytes:
    """Serialises a `livox_ros_driver/CustomMsg`; stamp and timebase are the time of the first point.

    A pulse without return keeps its time and line and lies at (0, 0, 0).
    """
    points = np.zeros(len(sweep.points), POINT)
    points["offset_time"], points["line"] = sweep.offset, lidar.line
    points["x"], points["y"], points["z"] = sweep.points.T
    points["reflectivity"] = sweep.reflectivity
    points["tag"] = np.where(sweep.second, 0x10, 0)
    head = make_header(sweep.number, sweep.begin, b"livox_frame")
    head += struct.pack("<QIB3xI", unix_nanoseconds(sweep.begin), len(points), 1, len(points))
    return head + points.tobytes()


def imu_messages(
    frame: str,
    nanoseconds: np.ndarray,
    quaternion: Float[np.ndarray, "n 4"] | None,
    gyro: Float[np.ndarray, "n 3"],
    accel: Float[np.ndarray, "n 3"],
) -> list[bytes]:
    """Serialises `sensor_msgs/Imu` messages of times since the start of the survey, ns.

    `quaternion` is x, y, z, w; `None` leaves zeros and a covariance of -1. Rates are in rad/s, accelerations in the
    topic's own unit.
    """
    layout = np.dtype([
        ("seq", "<u4"), ("sec", "<u4"), ("nsec", "<u4"), ("size", "<u4"), ("frame", f"S{len(frame)}"),
        ("quaternion", "<f8", 4), ("quaternion_cov", "<f8", 9), ("gyro", "<f8", 3), ("gyro_cov", "<f8", 9),
        ("accel", "<f8", 3), ("accel_cov", "<f8", 9),
    ])  # fmt: skip
    rows = np.zeros(len(nanoseconds), layout)
    rows["seq"], rows["size"], rows["frame"] = np.arange(len(rows)), len(frame), frame.encode()
    rows["sec"], rows["nsec"] = np.divmod(unix_nanoseconds(0) + nanoseconds.astype(np.int64), 1_000_000_000)
    if quaternion is None:
        rows["quaternion_cov"][:, 0] = -1.0
    else:
        rows["quaternion"] = quaternion
    rows["gyro"], rows["accel"] = gyro, accel
    return [row.tobytes() for row in rows]


_CODES = {"u1": 2, "u2": 4, "u4": 6, "f4": 7, "f8": 8}  # sensor_msgs/PointField
# velodyne_pointcloud's PointXYZIRT, packed: 22 bytes.
VELODYNE_POINT = np.dtype([
    ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4"),
])  # fmt: skip
# ouster_ros's Point of the ROS1 driver, aligned to 16 bytes: 48 bytes.
OUSTER_POINT = np.dtype({
    "names": ["x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient", "range"],
    "formats": ["<f4", "<f4", "<f4", "<f4", "<u4", "<u2", "u1", "<u2", "<u4"],
    "offsets": [0, 4, 8, 16, 20, 24, 26, 28, 32],
    "itemsize": 48,
})  # fmt: skip
_SIGNAL = 1e4  # photons of an echo of 1 % at 1 m; only ratios of it mean anything


def encode_cloud(seq: int, stamp: int, frame: bytes, rows: int, points: np.ndarray, dense: bool) -> bytes:
    """Serialises records as a PointCloud2 of `rows` rows, stamped `stamp` ns after the start of the survey."""
    layout, width = points.dtype, len(points) // rows
    fields = dict(layout.fields or {})
    out = make_header(seq, stamp, frame) + struct.pack("<III", rows, width, len(fields))
    for name, (kind, offset, *_) in fields.items():
        out += struct.pack("<I", len(name)) + name.encode() + struct.pack("<IBI", offset, _CODES[kind.str[1:]], 1)
    big = any(kind.byteorder == ">" for kind, *_ in fields.values())
    out += struct.pack("<?III", big, layout.itemsize, layout.itemsize * width, layout.itemsize * len(points))
    return out + points.tobytes() + struct.pack("<?", dense)


def velodyne_message(sweep: Sweep, lidar: Lidar) -> bytes:
    """Serialises a VLP-16's sweep: one row of returns; `time` counts from a stamp at the sweep's end, s.

    A Doppler LiDAR adds `velocity`, m/s, positive away.
    """
    seen = sweep.valid
    further = [] if sweep.velocity is None else [("velocity", "<f4")]
    points = np.zeros(int(seen.sum()), np.dtype([*VELODYNE_POINT.descr, *further]))
    points["x"], points["y"], points["z"] = sweep.points[seen].T
    # Velodyne's scale ends at 100 for diffuse surfaces.
    points["intensity"] = np.rint(sweep.reflectivity[seen] / 1.5)
    points["ring"] = lidar.line[seen]
    points["time"] = 1e-9 * (sweep.offset - lidar.stamp)[seen]
    if sweep.velocity is not None:
        points["velocity"] = sweep.velocity[seen]
    return encode_cloud(sweep.number, sweep.begin + lidar.stamp, b"velodyne", 1, points, dense=True)


def ouster_message(sweep: Sweep, lidar: Lidar) -> bytes:
    """Serialises an OS1's sweep: a row for each ring, a column for each firing, `t` in ns after its start.

    A beam without return keeps its time and ring and lies at (0, 0, 0).
    """
    rings = int(lidar.line.max()) + 1
    row_by_row = np.arange(len(sweep.points)).reshape(-1, rings).T.ravel()
    local, reflectivity = sweep.points[row_by_row], sweep.reflectivity[row_by_row] / 1.5
    distance = np.linalg.norm(local.astype(np.float64), axis=1)
    # Filled in place: a copy of these records would leave what it likes in their padding.
    points = np.zeros(len(local), OUSTER_POINT)
    points["x"], points["y"], points["z"] = local.T
    points["t"], points["ring"] = sweep.offset[row_by_row], lidar.line[row_by_row]
    points["range"] = np.rint(1e3 * distance)
    points["reflectivity"] = np.rint(reflectivity)
    points["intensity"] = np.rint(_SIGNAL * reflectivity / np.where(distance > 0.0, distance, 1.0) ** 2)
    return encode_cloud(sweep.number, sweep.begin + lidar.stamp, b"os_sensor", rings, points, dense=False)


# Conventions that drivers have for one and the same drive.

_FLAG = tyro.conf.arg(prefix_name=False)
_TICKS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_UNDERFLOW = 2**32 - 1_000_000  # what a counter of 32 bits makes of -1 ms in ns
_ROS2 = get_typestore(Stores.ROS2_HUMBLE)
_LIVOX = get_types_from_msg(CUSTOM_DEFINITION, CUSTOM_TYPE)
_ROS2.register({name: kind for name, kind in _LIVOX.items() if name not in _ROS2.types})  # its own header stays
_PLUGINS = {"mcap": StoragePlugin.MCAP, "db3": StoragePlugin.SQLITE3}


@dataclass(frozen=True)
class Convention:
    """Layout and container in which sweeps are published and stored."""

    # What the times of points count from: as the sensor's own `driver` has it; the `header`; the begin of the `sweep`,
    # whatever the header is of; 1970 (`epoch`); the `boot` of the sensor. One `constant` a sweep, or `none` at all.
    point_times: Annotated[Literal["driver", "header", "sweep", "epoch", "boot", "constant", "none"], _FLAG] = "driver"
    point_unit: Annotated[Literal["s", "ms", "us", "ns"], _FLAG] = "s"  # Unit of the times of points.
    point_type: Annotated[Literal["f4", "f8", "u4"], _FLAG] = "f8"  # Type of that field; u4 wraps.
    point_field: Annotated[str, _FLAG] = "timestamp"  # Name of that field.
    header_of: Annotated[Literal["start", "end"], _FLAG] = "start"  # Part of a sweep that its header is of.
    boot: Annotated[float, _FLAG] = 320.0  # Time that the sensor had run at the first sweep, s.
    bad_times: Annotated[float, _FLAG] = 0.0  # Fraction of the points whose time is that of no sweep.
    by_ring: Annotated[bool, _FLAG] = False  # Points in the order of rings, not of time.
    # What stands for a beam without return: nothing, a point in the sensor itself, or numbers that are none.
    empty: Annotated[Literal["left out", "zero", "nan"], _FLAG] = "left out"
    chunks: Annotated[int, _FLAG] = 1  # Messages that a sweep is published in, one after another.
    missing: Annotated[float, _FLAG] = 0.0  # Fraction of the messages that never came.
    big_endian: Annotated[bool, _FLAG] = False  # Numbers of points with their highest byte first.
    imu_late: Annotated[float, _FLAG] = 0.0  # How much later the IMU's clock is than the LiDAR's, s.
    container: Annotated[Literal["bag", "mcap", "db3"], _FLAG] = "bag"  # A bag of ROS 1, or a folder of ROS 2.
    bags: Annotated[int, _FLAG] = 1  # Bags that the recording is split into.

    def check(self) -> None:
        """Raises `ValueError` for numbers out of range, and for times that no field of that type can hold."""
        for name in ("bad_times", "missing"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ValueError(f"{name} must lie between 0 and 1, got {getattr(self, name):g}")
        for name in ("bags", "chunks"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("boot", "imu_late"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name} must be finite, got {getattr(self, name):g}")
        if self.point_type == "f4" and self.point_times in ("epoch", "boot"):
            raise ValueError(f"point_type f4 cannot hold times since {self.point_times}")
        negative = self.point_times == "header" and self.header_of == "end"
        if self.point_type == "u4" and (negative or self.point_unit == "s"):
            raise ValueError("point_type u4 holds neither fractions nor times before the header")


def chunks_of(sweep: Sweep, lidar: Lidar, convention: Convention) -> Iterator[tuple[Sweep, Lidar]]:
    """Yields the parts of a sweep that are published as messages of their own, less those that never came."""
    rng = np.random.default_rng([sweep.number, 0x105])
    for beams in np.array_split(np.arange(len(sweep.offset)), convention.chunks):
        if rng.random() < convention.missing:
            continue
        if convention.chunks == 1:
            yield sweep, lidar
            continue
        part = sweep.pick(beams)
        first, offset = int(part.offset[0]), part.offset - part.offset[0]
        model = replace(lidar, offset=offset, line=lidar.line[beams], stamp=min(lidar.stamp, int(offset[-1])))
        yield replace(part, begin=sweep.begin + first, offset=offset), model


def encode(sweep: Sweep, lidar: Lidar, convention: Convention) -> bytes:
    """Serialises a sweep as a `sensor_msgs/PointCloud2` by a convention."""
    seen = np.flatnonzero(sweep.valid) if convention.empty == "left out" else np.arange(len(sweep.valid))
    if convention.by_ring:
        seen = seen[np.argsort(lidar.line[seen], kind="stable")]
    last = int(sweep.offset[-1])
    stamp = sweep.begin + (last if convention.header_of == "end" else 0)
    kinds = {"x": "f4", "y": "f4", "z": "f4", "intensity": "f4", "ring": "u2"}
    times = None
    if convention.point_times != "none":
        kinds[convention.point_field] = convention.point_type
        times = _point_times(sweep, seen, stamp, convention)
    order = ">" if convention.big_endian else "<"
    points = np.zeros(len(seen), [(name, order + kind) for name, kind in kinds.items()])
    none = np.nan if convention.empty == "nan" else 0.0
    points["x"], points["y"], points["z"] = np.where(sweep.valid[seen, None], sweep.points[seen], none).T
    points["intensity"], points["ring"] = sweep.reflectivity[seen], lidar.line[seen]
    if times is not None:
        points[convention.point_field] = times
    rings = int(lidar.line.max()) + 1
    rows = rings if convention.by_ring and convention.empty != "left out" and len(seen) % rings == 0 else 1
    return encode_cloud(sweep.number, stamp, lidar.name.encode(), rows, points, dense=convention.empty == "left out")


def _point_times(sweep: Sweep, seen: np.ndarray, stamp: int, convention: Convention) -> np.ndarray:
    """Return the times of the returns `seen` of a sweep as its driver writes them, with their bad ones."""
    since = sweep.begin + sweep.offset[seen]  # ns since the start of the survey
    begins = {
        "header": stamp, "sweep": sweep.begin, "epoch": -unix_nanoseconds(0), "boot": -round(1e9 * convention.boot),
    }  # fmt: skip
    if convention.point_times == "constant":
        since, begin = np.full(len(seen), sweep.begin), 0
    else:
        begin = begins[convention.point_times]
    ticks = (since - begin) * (1e-9 * _TICKS[convention.point_unit])
    rng = np.random.default_rng([sweep.number, 0xBAD])
    bad = rng.random(len(seen)) < convention.bad_times
    if convention.point_type == "u4":
        return np.where(bad, _UNDERFLOW, np.rint(ticks).astype(np.int64) % 2**32)
    return np.where(bad, 50.0 * np.abs(ticks).max(initial=0.0) + 1e9, ticks)


class Recorder:
    """Writes the messages of ROS 1 to the files of a recording, in the convention's container, part after part.

    Attributes:
        path: What a user would give: the bag, or the folder of them.
    """

    def __init__(self, path: Path, kinds: dict[str, str], convention: Convention) -> None:
        """`path` is the name of a bag of ROS 1; other recordings become a folder of its name without the ending."""
        self._kinds, self._convention, self._stack = kinds, convention, ExitStack()
        self._folder = path.parent  # where the parts go
        self._writer: Any = None
        self._topics: dict[str, Any] = {}
        self._ros1 = convention.container == "bag"
        self._alone = self._ros1 and convention.bags == 1
        self._path, self.path, self._part = path, path if self._alone else path.with_suffix(""), -1

    def __enter__(self) -> "Recorder":
        if not self._alone:
            self._folder = self._stack.enter_context(replace_folder(self.path))
        self.start_part()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is not None:
            self._writer.__exit__(kind, error, trace)
        if error is None and not self._ros1:
            _join_parts(self._folder, self._path.stem, self._part + 1)
        self._stack.__exit__(kind, error, trace)

    def start_part(self) -> None:
        """Closes the part that is being written and goes on in the next."""
        if self._writer is not None:
            self._writer.__exit__(None, None, None)
        self._part += 1
        if self._ros1:
            part = self._folder / f"{self._path.stem}_{self._part}.bag"
            self._writer = Writer1(self._stack.enter_context(replace_file(self._path)) if self._alone else part)
            store = STORE
        else:
            plugin, store = _PLUGINS[self._convention.container], _ROS2
            self._writer = Writer2(self._folder / f"{self._path.stem}_{self._part}", version=9, storage_plugin=plugin)
        self._writer.__enter__()
        names = sorted(self._kinds)
        self._topics = {name: self._writer.add_connection(name, self._kinds[name], typestore=store) for name in names}

    def write(self, topic: str, nanoseconds: int, raw: bytes) -> None:
        """Writes a message recorded at a time, ns since the start of the survey."""
        data = raw if self._ros1 else bytes(_ROS2.ros1_to_cdr(raw, self._kinds[topic]))
        self._writer.write(self._topics[topic], unix_nanoseconds(nanoseconds), data)


def _join_parts(folder: Path, stem: str, count: int) -> None:
    """Makes one recording of folders of ROS 2 that were written one after another."""
    whole: dict[str, Any] = {}
    for k in range(count):
        part = folder / f"{stem}_{k}"
        facts = yaml.safe_load((part / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
        for name in facts["relative_file_paths"]:
            (part / name).rename(folder / name)
        shutil.rmtree(part)
        if not whole:
            whole = facts
            continue
        for key in ("relative_file_paths", "files"):
            whole[key] += facts[key]
        whole["message_count"] += facts["message_count"]
        whole["duration"]["nanoseconds"] += facts["duration"]["nanoseconds"]
        for one, other in zip(whole["topics_with_message_count"], facts["topics_with_message_count"], strict=True):
            one["message_count"] += other["message_count"]
    (folder / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": whole}, sort_keys=False))
