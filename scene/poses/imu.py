"""Inertial samples beside a LiDAR: rates and specific forces.

The `orientation` field is not read. Where an instrument fills it (`/imu/data` of an Xsens MTi), a filter of its own
made it from these same rates and forces, with errors that are neither stated nor white, and from a magnetometer that
steel lining, rails and cables turn.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from scene.errors import RecordingError
from scene.reading.cause import cause
from scene.reading.recording import Recording

IMU_TYPE = "sensor_msgs/msg/Imu"
GRAVITY = 9.80665  # m/s²
# A carried or driven IMU averages one g over a recording. Livox publishes g, the others m/s².
_IN_G, _IN_SI = (0.7, 1.4), (0.7 * GRAVITY, 1.4 * GRAVITY)
_MIN_SAMPLES = 50


@dataclass(frozen=True)
class Inertial:
    """One IMU's samples over a recording.

    Attributes:
        times: s, growing, `(n,)`.
        rate: Angular rate in the IMU's axes, rad/s, `(n, 3)`.
        force: Specific force in the IMU's axes, m/s², `(n, 3)`; at rest it points up and measures one g.
        topic: Where it was read.
    """

    times: Float[np.ndarray, " n"]
    rate: Float[np.ndarray, "n 3"]
    force: Float[np.ndarray, "n 3"]
    topic: str


def imu_topics(recording: Recording) -> list[str]:
    """Topics that carry IMU messages; the one in the LiDAR's own housing (`/livox/imu` to `/livox/lidar`) first."""
    beside = recording.topic.rsplit("/", 1)[0]
    topics = sorted({c.topic for c in recording.reader.connections if c.msgtype == IMU_TYPE})
    return sorted(topics, key=lambda topic: topic.rsplit("/", 1)[0] != beside)


def imu(recording: Recording, topic: str) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
    """Samples in the order of the bag: time (s, of the header), rate (rad/s) and force (the topic's own unit).

    Raises:
        RecordingError: A message is damaged; says which.
    """
    connections = [c for c in recording.reader.connections if c.topic == topic and c.msgtype == IMU_TYPE]
    messages, index = recording.reader.messages(connections=connections), 0
    while True:
        try:
            _, _, raw = next(messages)
            message = recording.deserialize(raw, IMU_TYPE)
        except StopIteration:
            return
        except Exception as error:  # the library raises anything from struct.error to AssertionError on damage
            raise RecordingError(f"{recording.path}: message {index} of {topic} is damaged ({cause(error)})") from error
        stamp, turn, push = message.header.stamp, message.angular_velocity, message.linear_acceleration
        yield stamp.sec + stamp.nanosec * 1e-9, np.array([turn.x, turn.y, turn.z]), np.array([push.x, push.y, push.z])
        index += 1


def read_inertial(recording: Recording, topic: str) -> Inertial | None:
    """A whole IMU topic: sorted, repeated times and samples that are not finite dropped, force in m/s².

    Returns:
        `None` where fewer than 50 samples are left.

    Raises:
        RecordingError: Damaged, or its force is neither in g nor in m/s².
    """
    samples = [(time, *turn, *push) for time, turn, push in imu(recording, topic)]
    rows = np.asarray(samples, np.float64).reshape(-1, 7)
    rows = rows[np.isfinite(rows).all(axis=1)]
    rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
    if len(rows) < _MIN_SAMPLES:
        return None
    size = float(np.median(np.linalg.norm(rows[:, 4:], axis=1)))
    for (low, high), unit in ((_IN_G, GRAVITY), (_IN_SI, 1.0)):
        if low < size < high:
            return Inertial(rows[:, 0], rows[:, 1:4], rows[:, 4:] * unit, topic)
    raise RecordingError(f"{recording.path}: {topic} has a median force of {size:.3g}, which is neither g nor m/s²")
