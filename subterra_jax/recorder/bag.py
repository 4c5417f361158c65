"""ROS 2 bags in MCAP: one file that Foxglove opens by itself, in a folder that `ros2 bag play` takes."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from subterra_jax.recorder.messages import nanoseconds, store

_ONCE = "/tf_static"


class Message(NamedTuple):
    """A message: time since the start (s), topic, and its content."""

    time: float
    topic: str
    content: Any


def write_bag(folder: Path, messages: Iterable[Message]) -> dict[str, dict[str, Any]]:
    """Write messages, with the definitions of their types; the same messages give the same bytes.

    Args:
        folder: To make; the file in it is called like it.
        messages: In order of time.

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
                quality = _latched() if message.topic == _ONCE else []
                connections[message.topic] = writer.add_connection(
                    message.topic, kind, typestore=types, offered_qos_profiles=quality
                )
                topics[message.topic] = {"type": kind, "messages": 0}
            raw = types.serialize_cdr(message.content, kind)
            writer.write(connections[message.topic], nanoseconds(message.time), raw)
            topics[message.topic]["messages"] += 1
    return dict(sorted(topics.items()))


def _latched() -> list[Any]:
    """Quality of service of what is said once: whoever comes later still hears it."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    never = QosTime(2147483647, 4294967295)
    return [Qos(
        QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, never, never,
        QosLiveliness.AUTOMATIC, never, False,
    )]  # fmt: skip
