"""Timed scans: point times, Livox and PointCloud2 messages, and the class that a reader of recordings returns.

Drivers of LiDARs differ in unit, sign and origin of their point times, and none of them says so. Relative values only
need their unit: a return's time is the stamp plus the value, whether the stamp is of the end of the sweep (VLP-16,
values mostly negative) or of its start (Ouster, Livox). Absolute values (Hesai, RoboSense) are matched with the stamp.

Source of Livox' layout: livox_ros_driver, message md5 e4d6829bdfe657cb6c21a746c86b21a6; livox_ros_driver2 publishes the
same fields.
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from scene.errors import RecordingError
from scene.reading.source import cause, stack_xyz


@dataclass(frozen=True)
class Scan:
    """A sweep in the sensor frame."""

    stamp: float  # Time of the sweep, s
    points: Float[np.ndarray, "n 3"]  # Returns at their own time, m
    times: Float[np.ndarray, " n"]  # Time of each return after `stamp`, s


class _NoTopics:
    """A bag's reader for recordings that hold nothing beside their scans."""

    connections: tuple[Any, ...] = ()

    def messages(self, **_: Any) -> Iterator[Any]:
        """Return no messages."""
        return iter(())


class ScanSource:
    """An open recording, as a reader returns it.

    Attributes:
        path: The recording, for messages.
        topic: The LiDAR topic; the file's or folder's name where there are no topics.
        scan_count: Number of scans.
        facts: Detected facts, for people and the manifest. `kind` is needed; `point_times` is known after a scan.
        reader: A bag's reader, for the IMU beside the LiDAR: `connections` and `messages(connections=…)`.
    """

    path: Path
    topic: str
    scan_count: int
    facts: dict[str, Any]
    reader: Any = _NoTopics()

    def __init__(
        self,
        path: Path,
        scan_count: int,
        facts: dict[str, Any],
        read: Callable[[int], tuple[Scan, str]],
        close: Callable[[], None] = lambda: None,
    ) -> None:
        """Describes the recording.

        `read` reads the scan of a number from 0, as `make_scan` returns it. It may raise anything on damage.
        """
        self.path, self.topic, self.scan_count, self.facts = path, path.name, scan_count, facts
        self._read, self._close = read, close

    def scans(self, skip: int = 0) -> Iterator[Scan]:
        """Yields the scans from number `skip` on; raises `RecordingError`, which says which is damaged."""
        for index in range(skip, self.scan_count):
            try:
                scan, convention = self._read(index)
            except RecordingError:
                raise
            except Exception as error:  # readers and their libraries raise anything on damage
                raise RecordingError(f"{self.path}: scan {index} is not readable ({cause(error)})") from error
            if convention:
                self.facts.setdefault("point_times", convention)
            yield scan

    def close(self) -> None:
        """Closes the file."""
        self._close()

    def deserialize(self, raw: bytes, message_type: str) -> Any:
        """Return a message of a standard type from `reader` as an object."""
        raise RecordingError(f"{self.path}: holds no {message_type}")


TIME_FIELDS = ("t", "time", "offset_time", "timestamp", "time_stamp", "timestamps", "ts")
STATIC = "none: every sweep is taken as static"
_TIME_UNITS = ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns"))
_LONGEST_SWEEP = 2.0  # s
_SAME_CLOCK = 10.0  # s between stamp and absolute point times
_FIRST_EPOCH = 1e8  # s; absolute times count from 1970, and nothing older than 1973 is a recording


def make_scan(
    stamp: float, points: Float[np.ndarray, "n 3"], values: Shaped[np.ndarray, " n"] | None, name: str = ""
) -> tuple[Scan, str]:
    """Return a sweep with its returns in the order of time, and the convention of its point times.

    Returns at the origin (nothing came back) and those that are not finite, in place or time, are dropped. Raises
    `ValueError` where the point times span more than a sweep can last.

    Args:
        stamp: Stamp of the message, s.
        points: Points in the sensor frame, m.
        values: Point times as stored; `None` where there are none.
        name: Name of their field.
    """
    good = np.isfinite(points).all(axis=1) & (points != 0).any(axis=1)
    if values is None:
        return Scan(stamp, points[good], np.zeros(int(good.sum()))), STATIC
    raw = values.astype(np.float64)
    good &= np.isfinite(raw)
    points, raw = points[good], raw[good]
    if not len(raw):
        return Scan(stamp, points, raw), ""
    start, times, convention = _interpret_times(name, raw, np.issubdtype(values.dtype, np.integer), stamp)
    if (np.diff(times) < 0).any():
        order = np.argsort(times, kind="stable")
        points, times = points[order], times[order]
    return Scan(start, points, times), convention


def scan_from_records(stamp: float, records: Shaped[np.ndarray, " n"]) -> tuple[Scan, str]:
    """Return a sweep from points with fields x, y, z (m) and perhaps a time, and the convention of its point times.

    Raises `ValueError` where a coordinate is missing, or the times span more than a sweep can last.
    """
    name = next((name for name in TIME_FIELDS if name in (records.dtype.names or ())), None)
    points = stack_xyz(records).astype(np.float32)
    return make_scan(stamp, points, None if name is None else records[name], name or "")


def _interpret_times(name: str, raw: np.ndarray, integer: bool, stamp: float) -> tuple[float, np.ndarray, str]:
    """Start of the sweep (s), times after it (s), and the convention in words."""
    low, high = float(raw.min()), float(raw.max())
    if low == high == 0:
        return stamp, raw, f"`{name}` is 0 throughout: every sweep is taken as static"
    for scale, unit in _TIME_UNITS:
        if low * scale > _FIRST_EPOCH and abs(low * scale - stamp) < _SAME_CLOCK:
            times = _check_span(name, (raw - low) * scale)
            return low * scale, times, f"`{name}`, absolute, {unit}"
    if low > _FIRST_EPOCH and not integer:
        scale, unit = next((s, u) for s, u in reversed(_TIME_UNITS) if low * s > _FIRST_EPOCH or s == 1.0)
        return stamp, _check_span(name, (raw - low) * scale), f"`{name}`, absolute by another clock, {unit}"
    largest = max(-low, high)
    # Whole numbers are nanoseconds by every driver's convention; other values are seconds unless that is absurd.
    units = _TIME_UNITS[-1:] if integer else _TIME_UNITS
    scale, unit = next(((s, u) for s, u in units if largest * s <= _LONGEST_SWEEP), units[-1])
    times = _check_span(name, raw * scale)
    side = "before the stamp (its end)" if -low > high else "after the stamp (its start)"
    shift = min(low * scale, 0.0)
    return stamp + shift, times - shift, f"`{name}`, {unit} {side}"


def _check_span(name: str, times: np.ndarray) -> np.ndarray:
    span = float(times.max() - times.min())
    if span > _LONGEST_SWEEP:
        raise ValueError(f"a sweep whose `{name}` spans {span:.3g} s; at most {_LONGEST_SWEEP:g} s are possible")
    return times


LIVOX_TYPES = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")

_LIVOX_POINT = np.dtype([
    ("offset_time", "<u4"), ("x", "<f4"), ("y", "<f4"), ("z", "<f4"),
    ("reflectivity", "u1"), ("tag", "u1"), ("line", "u1"),
])  # fmt: skip
# CDR aligns each point's first word: one byte of padding between points, none after the last.
_LIVOX_POINT_CDR = np.dtype({"names": ["point"], "formats": [_LIVOX_POINT], "itemsize": _LIVOX_POINT.itemsize + 1})
# Bits 4-5 of the tag: 0b00 and 0b01 are returns to trust, the others are noise by intensity or by place.
_TAG_RETURN_MASK = 0x20


def parse_custom_msg(raw: bytes) -> Scan:
    """Parses a `CustomMsg` as ROS1 serialises it; raises `ValueError` where the bytes are not a whole one.

    Points at the origin (no return), not finite, or tagged as noise are dropped.
    """
    try:
        _, secs, nsecs, frame_length = struct.unpack_from("<IIII", raw, 0)
        offset = 16 + frame_length + struct.calcsize("<QIB3B")
        (count,) = struct.unpack_from("<I", raw, offset)
        points = np.frombuffer(raw, _LIVOX_POINT, count, offset + 4)
    except (struct.error, ValueError) as error:
        raise ValueError(f"not a whole CustomMsg: {error}") from error
    return _livox_scan(secs + nsecs * 1e-9, points)


def parse_custom_msg_cdr(raw: bytes) -> Scan:
    """Parses a `CustomMsg` as ROS2 serialises it (CDR, little-endian); otherwise as `parse_custom_msg`."""
    try:
        if raw[:2] != b"\x00\x01":
            raise ValueError(f"encapsulation {raw[:2].hex()} is not little-endian CDR")
        body = raw[4:]  # alignment counts from behind the encapsulation header
        secs, nsecs, frame_length = struct.unpack_from("<iII", body, 0)
        timebase = -(-(12 + frame_length) // 8) * 8
        offset = timebase + struct.calcsize("<QIB3B")
        (count,) = struct.unpack_from("<I", body, offset)
        size = count * _LIVOX_POINT_CDR.itemsize
        # One point's padding may be missing at the end.
        padded = body[offset + 4 : offset + 4 + size] + b"\0" * (len(body) == offset + 3 + size)
        points = np.frombuffer(padded, _LIVOX_POINT_CDR, count)["point"]
    except (struct.error, ValueError) as error:
        raise ValueError(f"not a whole CustomMsg: {error}") from error
    return _livox_scan(secs + nsecs * 1e-9, points)


def _livox_scan(stamp: float, points: np.ndarray) -> Scan:
    points = points[points["tag"] & _TAG_RETURN_MASK == 0]
    xyz = np.stack([points["x"], points["y"], points["z"]], axis=1)
    return make_scan(stamp, xyz, points["offset_time"], "offset_time")[0]


POINTCLOUD2_TYPE = "sensor_msgs/msg/PointCloud2"
# Source: sensor_msgs/PointField, INT8 = 1 … FLOAT64 = 8.
_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def parse_pointcloud2(message: Any, stamp: float) -> tuple[Scan, str]:
    """Parses a deserialised message with the stamp of its header, s; returns the sweep and the convention of its times.

    Raises `ValueError` without coordinates, for a layout that contradicts itself, or times of no sweep.
    """
    points = _cloud_records(message)
    names = points.dtype.names or ()
    time = next((name for name in TIME_FIELDS if name in names), None)
    xyz = np.stack([points["x"], points["y"], points["z"]], axis=1)
    if xyz.dtype != np.float64:
        xyz = xyz.astype(np.float32)  # native byte order
    return make_scan(stamp, xyz, None if time is None else points[time], time or "")


def _cloud_records(message: Any) -> Shaped[np.ndarray, " n"]:
    """Return the points as records of x, y, z and any time, without padding at the end of rows."""
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
    fields: dict[str, tuple[str, int]] = {}
    for field in message.fields:
        if field.name in ("x", "y", "z", *TIME_FIELDS) and field.name not in fields:
            if field.datatype not in _FIELD_TYPES:
                raise ValueError(f"a PointCloud2 whose field {field.name} is of unknown type {field.datatype}")
            fields[field.name] = (order + _FIELD_TYPES[field.datatype], field.offset)
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise ValueError(f"a PointCloud2 without the field {', '.join(missing)}")
    for name, (kind, offset) in fields.items():
        if offset + np.dtype(kind).itemsize > step:
            raise ValueError(f"a PointCloud2 whose field {name} at byte {offset} lies outside its {step}-byte points")
    formats, offsets = zip(*fields.values(), strict=True)
    return np.dtype({"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": step})
