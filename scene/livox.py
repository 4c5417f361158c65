"""Livox `CustomMsg`, parsed as one block of bytes.

Source: livox_ros_driver, message md5 e4d6829bdfe657cb6c21a746c86b21a6.
"""

import struct

import numpy as np

from scene.scan import Scan

MESSAGE_TYPES = ("livox_ros_driver/CustomMsg", "livox_ros_driver/msg/CustomMsg")

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
    xyz = np.stack([points["x"], points["y"], points["z"]], axis=1)
    good = np.isfinite(xyz).all(axis=1) & (np.abs(xyz).max(axis=1) > 0) & (points["tag"] & _TAG_RETURN_MASK == 0)
    return Scan(secs + nsecs * 1e-9, xyz[good], points["offset_time"][good].astype(np.float64) * 1e-9)
