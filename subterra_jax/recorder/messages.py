"""ROS 2 messages of standard types, serialised as CDR, and their MCAP file in a folder that `ros2 bag play` takes."""

import functools
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from subterra_jax.host.errors import MissingLibraryError
from subterra_jax.recorder.sensors import Poses

_ONCE = "/tf_static"
EPOCH = 1_700_000_000  # s since 1970, stamp of the start of every episode
_FIELDS = (("x", 7, 0), ("y", 7, 4), ("z", 7, 8), ("ring", 4, 12))  # name, sensor_msgs/PointField type, byte
POINT = np.dtype({
    "names": ["x", "y", "z", "ring"], "formats": ["<f4", "<f4", "<f4", "<u2"], "offsets": [0, 4, 8, 12], "itemsize": 16,
})  # fmt: skip


@functools.cache
def store() -> Any:
    """Return the message types of ROS 2 Jazzy.

    Raises:
        MissingLibraryError: `rosbags` is not installed.
    """
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise MissingLibraryError("subterra_jax.recorder", "rosbags") from error
    return get_typestore(Stores.ROS2_JAZZY)


def nanoseconds(time: float) -> int:
    """Convert a time since the start, s, to a stamp, ns since 1970."""
    return EPOCH * 1_000_000_000 + round(time * 1e9)


def _make(name: str) -> Callable[..., Any]:
    return store().types[name]


def _header(time: float, frame: str) -> Any:
    seconds, rest = divmod(nanoseconds(time), 1_000_000_000)
    stamp = _make("builtin_interfaces/msg/Time")(sec=seconds, nanosec=rest)
    return _make("std_msgs/msg/Header")(stamp=stamp, frame_id=frame)


def _vector(values: Float[np.ndarray, "3"], kind: str = "Vector3") -> Any:
    return _make(f"geometry_msgs/msg/{kind}")(*(float(value) for value in values))


def _quaternion(values: Float[np.ndarray, "4"]) -> Any:
    return _make("geometry_msgs/msg/Quaternion")(*(float(value) for value in values))


def _twist(linear: Float[np.ndarray, "3"], angular: Float[np.ndarray, "3"]) -> Any:
    return _make("geometry_msgs/msg/Twist")(linear=_vector(linear), angular=_vector(angular))


_BLIND = 0.05  # m; nearer a planar LiDAR of the kind reports nothing, and no wall comes so near to the robot's middle


def laser_scan(time: float, frame: str, ranges: np.ndarray, range_max: float, period: float) -> Any:
    """Return a `sensor_msgs/LaserScan`: +Inf where a beam has no echo within `range_max`, -Inf where it is too near.

    Source: REP-117, Informational Distance Measurements.
    """
    step = 2.0 * np.pi / len(ranges)
    ranges = np.where(ranges >= range_max, np.inf, np.where(ranges < _BLIND, -np.inf, ranges))
    return _make("sensor_msgs/msg/LaserScan")(
        header=_header(time, frame), angle_min=0.0, angle_max=float(step * (len(ranges) - 1)), angle_increment=step,
        time_increment=0.0, scan_time=period, range_min=_BLIND, range_max=range_max,
        ranges=np.asarray(ranges, np.float32), intensities=np.zeros(0, np.float32),
    )  # fmt: skip


def odometry(poses: Poses, k: int, frame: str) -> Any:
    """Return a `nav_msgs/Odometry` of `base_link`, its twist since the last pose; covariances are not stated."""
    before, zero = max(k - 1, 0), np.zeros(3)
    linear, angular, rotation = zero, zero, poses.rotation
    if k > 0:
        period = poses.time[k] - poses.time[before]
        linear = rotation[k].inv().apply(poses.position[k] - poses.position[before]) / period
        angular = (rotation[before].inv() * rotation[k]).as_rotvec() / period
    pose = _make("geometry_msgs/msg/Pose")(
        position=_vector(poses.position[k], "Point"), orientation=_quaternion(rotation[k].as_quat(canonical=True))
    )
    return _make("nav_msgs/msg/Odometry")(
        header=_header(poses.time[k], frame), child_frame_id="base_link",
        pose=_make("geometry_msgs/msg/PoseWithCovariance")(pose=pose, covariance=np.zeros(36)),
        twist=_make("geometry_msgs/msg/TwistWithCovariance")(twist=_twist(linear, angular), covariance=np.zeros(36)),
    )  # fmt: skip


def transform(time: float, parent: str, child: str, position: np.ndarray, quaternion: np.ndarray) -> Any:
    """Return a `geometry_msgs/TransformStamped`; quaternion x, y, z, w."""
    move = _make("geometry_msgs/msg/Transform")(translation=_vector(position), rotation=_quaternion(quaternion))
    return _make("geometry_msgs/msg/TransformStamped")(
        header=_header(time, parent), child_frame_id=child, transform=move
    )


def transforms(parts: list[Any]) -> Any:
    """Return a `tf2_msgs/TFMessage`."""
    return _make("tf2_msgs/msg/TFMessage")(transforms=parts)


def command(time: float, speed: float, yaw_rate: float) -> Any:
    """Return a `geometry_msgs/TwistStamped` of a command, m/s and rad/s."""
    twist = _twist(np.array([speed, 0.0, 0.0]), np.array([0.0, 0.0, yaw_rate]))
    return _make("geometry_msgs/msg/TwistStamped")(header=_header(time, "base_link"), twist=twist)


def imu(time: float, gyro: Float[np.ndarray, "3"], accel: Float[np.ndarray, "3"]) -> Any:
    """Return a `sensor_msgs/Imu` without an orientation, which a covariance of -1 marks."""
    unknown = np.zeros(9)
    unknown[0] = -1.0
    return _make("sensor_msgs/msg/Imu")(
        header=_header(time, "imu"), orientation=_quaternion(np.array([0.0, 0.0, 0.0, 1.0])),
        orientation_covariance=unknown, angular_velocity=_vector(gyro), angular_velocity_covariance=np.zeros(9),
        linear_acceleration=_vector(accel), linear_acceleration_covariance=np.zeros(9),
    )  # fmt: skip


def point_cloud(time: float, points: Float[np.ndarray, "n 3"], ring: np.ndarray) -> Any:
    """Return a `sensor_msgs/PointCloud2` of the returns of one sweep: x, y, z (m) and ring."""
    rows = np.zeros(len(points), POINT)
    rows["x"], rows["y"], rows["z"] = points.T
    rows["ring"] = ring
    field = _make("sensor_msgs/msg/PointField")
    return _make("sensor_msgs/msg/PointCloud2")(
        header=_header(time, "lidar"), height=1, width=len(rows),
        fields=[field(name=name, offset=place, datatype=kind, count=1) for name, kind, place in _FIELDS],
        is_bigendian=False, point_step=POINT.itemsize, row_step=POINT.itemsize * len(rows),
        data=rows.view(np.uint8).reshape(-1), is_dense=True,
    )  # fmt: skip


class Message(NamedTuple):
    """A message of a topic: time since the start (s), topic and content."""

    time: float
    topic: str
    content: Any


def write_bag(folder: Path, messages: Iterable[Message]) -> dict[str, dict[str, Any]]:
    """Write messages with the definitions of their types; the same messages give the same bytes.

    Args:
        folder: Folder to make; the file in it has the same name.
        messages: Messages in order of time.

    Returns:
        Type and number of messages of each topic.
    """
    from rosbags.rosbag2 import CompressionMode, StoragePlugin, Writer
    from rosbags.rosbag2.enums import CompressionFormat

    types, connections, topics = store(), {}, {}
    writer = Writer(folder, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        for message in messages:
            kind = message.content.__msgtype__
            if message.topic not in connections:
                quality = _latched_quality() if message.topic == _ONCE else []
                connections[message.topic] = writer.add_connection(
                    message.topic, kind, typestore=types, offered_qos_profiles=quality
                )
                topics[message.topic] = {"type": kind, "messages": 0}
            raw = types.serialize_cdr(message.content, kind)
            writer.write(connections[message.topic], nanoseconds(message.time), raw)
            topics[message.topic]["messages"] += 1
    return dict(sorted(topics.items()))


def _latched_quality() -> list[Any]:
    """Return the quality of service of a message sent once: late subscribers still receive it."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    never = QosTime(2147483647, 4294967295)
    return [Qos(
        QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, never, never,
        QosLiveliness.AUTOMATIC, never, False,
    )]  # fmt: skip
