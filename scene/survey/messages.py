"""ROS1 messages of a Livox LiDAR and of IMUs, serialised by the message or by the thousand, never point by point."""

import struct

import numpy as np
from jaxtyping import Float

from scene.survey.lidar import Lidar, Sweep

EPOCH = 1_700_000_000  # s: stamp of the first point, the same for every survey

CUSTOM_TYPE, CUSTOM_MD5 = "livox_ros_driver/msg/CustomMsg", "e4d6829bdfe657cb6c21a746c86b21a6"
IMU_TYPE, IMU_MD5 = "sensor_msgs/msg/Imu", "6a62c6daae103f4ff57a132d6f95cec2"
RULE = "=" * 80
HEADER = f"""{RULE}
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
"""
CUSTOM_DEFINITION = f"""Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points

{HEADER}
{RULE}
MSG: livox_ros_driver/CustomPoint
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""
IMU_DEFINITION = f"""Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance

{HEADER}
{RULE}
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w

{RULE}
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""

# CustomPoint as it lies in the message: 19 bytes, packed.
POINT = np.dtype([
    ("offset_time", "<u4"), ("x", "<f4"), ("y", "<f4"), ("z", "<f4"),
    ("reflectivity", "u1"), ("tag", "u1"), ("line", "u1"),
])  # fmt: skip


def stamp(nanoseconds: int) -> int:
    """Time in ns since the Unix epoch of a time in ns since the start of the survey."""
    return EPOCH * 1_000_000_000 + nanoseconds


def header(seq: int, nanoseconds: int, frame: bytes) -> bytes:
    """A `std_msgs/Header` stamped `nanoseconds` after the start of the survey."""
    seconds, rest = divmod(stamp(nanoseconds), 1_000_000_000)
    return struct.pack("<IIII", seq, seconds, rest, len(frame)) + frame


def custom_message(sweep: Sweep, lidar: Lidar) -> bytes:
    """A `livox_ros_driver/CustomMsg`; stamp and timebase are the time of the first point.

    A pulse without return keeps its time and line and lies at (0, 0, 0).
    """
    points = np.zeros(len(sweep.points), POINT)
    points["offset_time"], points["line"] = sweep.offset, lidar.line
    points["x"], points["y"], points["z"] = sweep.points.T
    points["reflectivity"] = sweep.reflectivity
    points["tag"] = np.where(sweep.second, 0x10, 0)
    head = header(sweep.number, sweep.begin, b"livox_frame")
    head += struct.pack("<QIB3xI", stamp(sweep.begin), len(points), 1, len(points))
    return head + points.tobytes()


def imu_messages(
    frame: str,
    nanoseconds: np.ndarray,
    quaternion: Float[np.ndarray, "n 4"] | None,
    gyro: Float[np.ndarray, "n 3"],
    accel: Float[np.ndarray, "n 3"],
) -> list[bytes]:
    """`sensor_msgs/Imu` messages.

    Args:
        frame: Frame id.
        nanoseconds: Times since the start of the survey, ns.
        quaternion: Orientations x, y, z, w; None leaves zeros and says so by a covariance of -1.
        gyro: rad/s.
        accel: In the unit in which the topic is published.
    """
    layout = np.dtype([
        ("seq", "<u4"), ("sec", "<u4"), ("nsec", "<u4"), ("size", "<u4"), ("frame", f"S{len(frame)}"),
        ("quaternion", "<f8", 4), ("quaternion_cov", "<f8", 9), ("gyro", "<f8", 3), ("gyro_cov", "<f8", 9),
        ("accel", "<f8", 3), ("accel_cov", "<f8", 9),
    ])  # fmt: skip
    rows = np.zeros(len(nanoseconds), layout)
    rows["seq"], rows["size"], rows["frame"] = np.arange(len(rows)), len(frame), frame.encode()
    rows["sec"], rows["nsec"] = np.divmod(stamp(0) + nanoseconds.astype(np.int64), 1_000_000_000)
    if quaternion is None:
        rows["quaternion_cov"][:, 0] = -1.0
    else:
        rows["quaternion"] = quaternion
    rows["gyro"], rows["accel"] = gyro, accel
    return [row.tobytes() for row in rows]
