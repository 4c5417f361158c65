"""ROS1 messages of LiDARs and IMUs, serialised by the message or by the thousand, never point by point."""

import struct

import numpy as np
from jaxtyping import Float
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from scene.survey.lidar import Lidar, Sweep

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
