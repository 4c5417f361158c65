"""`sensor_msgs/PointCloud2` of any driver: fields by name, whatever their order, padding and endianness."""

from typing import Any

import numpy as np
from jaxtyping import Shaped

from scene.reading.pointtimes import FIELDS, make_scan
from scene.reading.scan import Scan

MESSAGE_TYPE = "sensor_msgs/msg/PointCloud2"
# Source: sensor_msgs/PointField, INT8 = 1 … FLOAT64 = 8.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def parse_pointcloud2(message: Any, stamp: float) -> tuple[Scan, str]:
    """One deserialised message as a sweep in the sensor's frame, and the convention of its point times.

    Args:
        message: With the fields of `sensor_msgs/PointCloud2`.
        stamp: Of its header, s.

    Raises:
        ValueError: Without coordinates, of a layout that contradicts itself, or with times of no sweep.
    """
    points = _records(message)
    names = points.dtype.names or ()
    time = next((name for name in FIELDS if name in names), None)
    xyz = np.stack([points["x"], points["y"], points["z"]], axis=1)
    if xyz.dtype != np.float64:
        xyz = xyz.astype(np.float32)  # native byte order
    return make_scan(stamp, xyz, None if time is None else points[time], time or "")


def _records(message: Any) -> Shaped[np.ndarray, " n"]:
    """The points as records of x, y, z and any time, without padding at the end of rows."""
    width, height, step, row = message.width, message.height, message.point_step, message.row_step
    if not width * height:
        return np.empty(0, [("x", "f4"), ("y", "f4"), ("z", "f4")])
    layout = _layout(message, step)
    data = np.asarray(message.data, np.uint8)
    row = row or width * step
    if row < width * step or (height - 1) * row + width * step > len(data):
        raise ValueError(
            f"a PointCloud2 of {height} rows of {width} points of {step} bytes (row_step {row}) in {len(data)} bytes"
        )
    if row == width * step:
        return np.frombuffer(data.tobytes(), layout, width * height)
    return np.concatenate([np.frombuffer(data[k * row :].tobytes(), layout, width) for k in range(height)])


def _layout(message: Any, step: int) -> np.dtype:
    order = ">" if message.is_bigendian else "<"
    fields: dict[str, tuple[str, int]] = {}
    for field in message.fields:
        if field.name in ("x", "y", "z", *FIELDS) and field.name not in fields:
            if field.datatype not in _TYPES:
                raise ValueError(f"a PointCloud2 whose field {field.name} is of unknown type {field.datatype}")
            fields[field.name] = (order + _TYPES[field.datatype], field.offset)
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise ValueError(f"a PointCloud2 without the field {', '.join(missing)}")
    for name, (kind, offset) in fields.items():
        if offset + np.dtype(kind).itemsize > step:
            raise ValueError(f"a PointCloud2 whose field {name} at byte {offset} lies outside its {step}-byte points")
    formats, offsets = zip(*fields.values(), strict=True)
    return np.dtype({"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": step})
