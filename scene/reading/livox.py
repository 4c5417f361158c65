"""Livox `CustomMsg`, parsed as one block of bytes.

Source: livox_ros_driver, message md5 e4d6829bdfe657cb6c21a746c86b21a6; livox_ros_driver2 publishes the same fields.
"""

import struct

import numpy as np

from scene.reading.pointtimes import make_scan
from scene.reading.scan import Scan

MESSAGE_TYPES = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")

_POINT = np.dtype(
    [
        ("offset_time", "<u4"),
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("reflectivity", "u1"),
        ("tag", "u1"),
        ("line", "u1"),
    ]
)
# CDR aligns each point's first word: one byte of padding between points, none after the last.
_POINT_CDR = np.dtype({"names": ["point"], "formats": [_POINT], "itemsize": _POINT.itemsize + 1})
# Bits 4-5 of the tag: 0b00 and 0b01 are returns to trust, the others are noise by intensity or by place.
_TAG_RETURN_MASK = 0x20


def parse_custom_msg(raw: bytes) -> Scan:
    """One ROS1-serialised `CustomMsg` as a scan in the sensor frame.

    Points at the origin (no return), not finite, or tagged as noise are dropped.

    Raises:
        ValueError: The bytes are not a whole `CustomMsg`.
    """
    try:
        _, secs, nsecs, frame_length = struct.unpack_from("<IIII", raw, 0)
        offset = 16 + frame_length + struct.calcsize("<QIB3B")
        (count,) = struct.unpack_from("<I", raw, offset)
        points = np.frombuffer(raw, _POINT, count, offset + 4)
    except (struct.error, ValueError) as error:
        raise ValueError(f"not a whole CustomMsg: {error}") from error
    return _scan(secs + nsecs * 1e-9, points)


def parse_custom_msg_cdr(raw: bytes) -> Scan:
    """One `CustomMsg` as ROS2 serialises it (CDR, little-endian); otherwise as `parse_custom_msg`.

    Raises:
        ValueError: The bytes are not a whole `CustomMsg`.
    """
    try:
        if raw[:2] != b"\x00\x01":
            raise ValueError(f"encapsulation {raw[:2].hex()} is not little-endian CDR")
        body = raw[4:]  # alignment counts from behind the encapsulation header
        secs, nsecs, frame_length = struct.unpack_from("<iII", body, 0)
        timebase = -(-(12 + frame_length) // 8) * 8
        offset = timebase + struct.calcsize("<QIB3B")
        (count,) = struct.unpack_from("<I", body, offset)
        size = count * _POINT_CDR.itemsize
        # One point's padding may be missing at the end.
        padded = body[offset + 4 : offset + 4 + size] + b"\0" * (len(body) == offset + 3 + size)
        points = np.frombuffer(padded, _POINT_CDR, count)["point"]
    except (struct.error, ValueError) as error:
        raise ValueError(f"not a whole CustomMsg: {error}") from error
    return _scan(secs + nsecs * 1e-9, points)


def _scan(stamp: float, points: np.ndarray) -> Scan:
    points = points[points["tag"] & _TAG_RETURN_MASK == 0]
    xyz = np.stack([points["x"], points["y"], points["z"]], axis=1)
    return make_scan(stamp, xyz, points["offset_time"], "offset_time")[0]
