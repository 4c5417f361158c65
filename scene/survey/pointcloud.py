"""`sensor_msgs/PointCloud2` as the drivers of Velodyne and Ouster fill it."""

import struct

import numpy as np

from scene.survey import os1
from scene.survey.lidar import Lidar, Sweep
from scene.survey.messages import HEADER, RULE, header

CLOUD_TYPE, CLOUD_MD5 = "sensor_msgs/msg/PointCloud2", "1158d486dd51d683ce2f1be655c3c181"
CLOUD_DEFINITION = f"""std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense

{HEADER}
{RULE}
MSG: sensor_msgs/PointField
uint8 INT8=1
uint8 UINT8=2
uint8 INT16=3
uint8 UINT16=4
uint8 INT32=5
uint8 UINT32=6
uint8 FLOAT32=7
uint8 FLOAT64=8
string name
uint32 offset
uint8 datatype
uint32 count
"""
_CODES = {"u1": 2, "u2": 4, "u4": 6, "f4": 7}
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


def _message(seq: int, stamp: int, frame: bytes, rows: int, points: np.ndarray, dense: bool) -> bytes:
    """A PointCloud2 of `rows` rows, stamped `stamp` ns after the start of the survey."""
    layout, width = points.dtype, len(points) // rows
    fields = dict(layout.fields or {})
    out = header(seq, stamp, frame) + struct.pack("<III", rows, width, len(fields))
    for name, (kind, offset, *_) in fields.items():
        out += struct.pack("<I", len(name)) + name.encode() + struct.pack("<IBI", offset, _CODES[kind.str[1:]], 1)
    out += struct.pack("<?III", False, layout.itemsize, layout.itemsize * width, layout.itemsize * len(points))
    return out + points.tobytes() + struct.pack("<?", dense)


def velodyne_message(sweep: Sweep, lidar: Lidar) -> bytes:
    """A VLP-16's sweep: one row of returns, whose `time` counts from a stamp at the end of the sweep, s."""
    seen = sweep.valid
    points = np.zeros(int(seen.sum()), VELODYNE_POINT)
    points["x"], points["y"], points["z"] = sweep.points[seen].T
    # Velodyne's scale ends at 100 for diffuse surfaces.
    points["intensity"] = np.rint(sweep.reflectivity[seen] / 1.5)
    points["ring"] = lidar.line[seen]
    points["time"] = 1e-9 * (sweep.offset - lidar.stamp)[seen]
    return _message(sweep.number, sweep.begin + lidar.stamp, b"velodyne", 1, points, dense=True)


def ouster_message(sweep: Sweep, lidar: Lidar) -> bytes:
    """An OS1's sweep: a row for each ring, a column for each firing, `t` in ns after the stamp at its start.

    A beam without return keeps its time and ring and lies at (0, 0, 0).
    """
    row_by_row = np.arange(len(sweep.points)).reshape(os1.N_COLUMNS, os1.N_RINGS).T.ravel()
    local, reflectivity = sweep.points[row_by_row], sweep.reflectivity[row_by_row] / 1.5
    distance = np.linalg.norm(local.astype(np.float64), axis=1)
    # Filled in place: a copy of these records would leave what it likes in their padding.
    points = np.zeros(len(local), OUSTER_POINT)
    points["x"], points["y"], points["z"] = local.T
    points["t"], points["ring"] = sweep.offset[row_by_row], lidar.line[row_by_row]
    points["range"] = np.rint(1e3 * distance)
    points["reflectivity"] = np.rint(reflectivity)
    points["intensity"] = np.rint(_SIGNAL * reflectivity / np.where(distance > 0.0, distance, 1.0) ** 2)
    return _message(sweep.number, sweep.begin + lidar.stamp, b"os_sensor", os1.N_RINGS, points, dense=False)
