"""One stream of ROS 1 messages as a ROS 1 bag and as a ROS 2 bag in MCAP, byte for byte the same content."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from scene.survey import messages

FormatName = Literal["mcap", "bag"]
BAG, MCAP = "recording.bag", "recording"
ODOMETRY, STATIC = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
_LIVOX_2 = "livox_ros_driver2/msg/CustomMsg"  # the same fields under the name of the ROS 2 driver

_LAYOUT: Any = {
    "names": messages.POINT.names,
    "formats": [kind for kind, *_ in (messages.POINT.fields or {}).values()],
    "offsets": [offset for _, offset, *_ in (messages.POINT.fields or {}).values()],
    "itemsize": messages.POINT.itemsize + 1,
}
_PADDED = np.dtype(_LAYOUT)


class Message(NamedTuple):
    """A message: time since the start of the recording (ns), topic, type of ROS 1 and its bytes there."""

    time: int
    topic: str
    kind: str
    raw: bytes


@cache
def ros1_store() -> Typestore:
    """Returns the types of ROS 1 with Livox's and those of transforms."""
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", STATIC))
    store.register(get_types_from_msg(messages.CUSTOM_DEFINITION, messages.CUSTOM_TYPE))
    return store


@cache
def ros2_store() -> Typestore:
    """Returns the types of ROS 2 with Livox's."""
    store = get_typestore(Stores.ROS2_JAZZY)
    text = "std_msgs/Header header\n" + messages.CUSTOM_DEFINITION.split("\n", 1)[1].split("\n\n", 1)[0]
    point = messages.CUSTOM_DEFINITION.rsplit("CustomPoint\n", 1)[1]
    store.register(get_types_from_msg(text, _LIVOX_2))
    store.register(get_types_from_msg(point, "livox_ros_driver2/msg/CustomPoint"))
    return store


def transform(child: str, shift: Float[np.ndarray, "3"], quaternion: Float[np.ndarray, "4"]) -> Any:
    """Returns a `geometry_msgs/TransformStamped` from `base_link` to a frame, m; stamped at the start."""
    types = ros1_store().types
    return types["geometry_msgs/msg/TransformStamped"](
        header=_header(0, "base_link"), child_frame_id=child,
        transform=types["geometry_msgs/msg/Transform"](
            translation=_vector(shift), rotation=types["geometry_msgs/msg/Quaternion"](*map(float, quaternion))
        ),
    )  # fmt: skip


def static_message(transforms: list[Any]) -> Message:
    """Returns the message of `/tf_static`."""
    content = ros1_store().types[STATIC](transforms=transforms)
    return Message(0, "/tf_static", STATIC, bytes(ros1_store().serialize_ros1(content, STATIC)))


def odometry_message(
    time: int, position: Float[np.ndarray, "3"], quaternion: Float[np.ndarray, "4"], child: str
) -> Message:
    """Returns a `nav_msgs/Odometry` of a frame, without speeds, at a time, ns."""
    types = ros1_store().types
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](*map(float, position)),
        orientation=types["geometry_msgs/msg/Quaternion"](*map(float, quaternion)),
    )
    twist = types["geometry_msgs/msg/Twist"](linear=_vector(np.zeros(3)), angular=_vector(np.zeros(3)))
    content = types[ODOMETRY](
        header=_header(time, "odom"), child_frame_id=child,
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
    )  # fmt: skip
    return Message(time, "/odom", ODOMETRY, bytes(ros1_store().serialize_ros1(content, ODOMETRY)))


def _vector(values: Float[np.ndarray, "3"]) -> Any:
    return ros1_store().types["geometry_msgs/msg/Vector3"](*map(float, values))


def _header(time: int, frame: str) -> Any:
    types, (seconds, rest) = ros1_store().types, divmod(messages.unix_nanoseconds(time), 1_000_000_000)
    return types["std_msgs/msg/Header"](
        seq=0, stamp=types["builtin_interfaces/msg/Time"](seconds, rest), frame_id=frame
    )


def write_bags(folder: Path, formats: Iterable[FormatName], stream: Iterable[Message]) -> Iterator[Message]:
    """Writes a stream, in order of time, to `recording.bag`, `recording/` or both, and passes it on.

    Args:
        folder: Folder that holds neither yet.
        formats: `bag`, `mcap`.
        stream: Messages.
    """
    with ExitStack() as stack:
        writers: list[Callable[[Message], None]] = []
        if "bag" in formats:
            bag = rosbag1.Writer(folder / BAG)
            bag.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
            writers.append(partial(_write_1, stack.enter_context(bag), {}))
        if "mcap" in formats:
            writer = rosbag2.Writer(folder / MCAP, version=9, storage_plugin=StoragePlugin.MCAP)
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            writers.append(partial(_write_2, stack.enter_context(writer), {}))
        for message in stream:
            for write in writers:
                write(message)
            yield message


def _write_1(writer: rosbag1.Writer, topics: dict[str, Any], message: Message) -> None:
    if message.topic not in topics:
        text, md5 = ros1_store().generate_msgdef(message.kind)
        topics[message.topic] = writer.add_connection(
            message.topic, message.kind, msgdef=text, md5sum=md5, latching=int(message.kind == STATIC)
        )
    writer.write(topics[message.topic], messages.unix_nanoseconds(message.time), message.raw)


def custom_cdr(raw: bytes) -> bytes:
    """Converts Livox's message to CDR, where a point takes 20 bytes and the last one 19."""
    count = int.from_bytes(raw[16 + int.from_bytes(raw[12:16], "little") :][16:20], "little")
    points = np.frombuffer(raw[len(raw) - count * messages.POINT.itemsize :], messages.POINT)
    empty = raw[: len(raw) - points.nbytes - 4] + bytes(4)
    head = bytes(ros2_store().ros1_to_cdr(empty, _LIVOX_2))
    padded = np.zeros(count, _PADDED)
    for name in messages.POINT.names or ():
        padded[name] = points[name]
    return head[:-4] + count.to_bytes(4, "little") + padded.tobytes()[: -1 if count else None]


def _write_2(writer: rosbag2.Writer, topics: dict[str, Any], message: Message) -> None:
    kind = _LIVOX_2 if message.kind == messages.CUSTOM_TYPE else message.kind
    if message.topic not in topics:
        topics[message.topic] = writer.add_connection(message.topic, kind, typestore=ros2_store())
    raw = custom_cdr(message.raw) if kind == _LIVOX_2 else bytes(ros2_store().ros1_to_cdr(message.raw, kind))
    writer.write(topics[message.topic], messages.unix_nanoseconds(message.time), raw)
