"""Inertial samples beside a LiDAR, and the attitude that follows from them.

The `orientation` field is not read. Where an instrument fills it (`/imu/data` of an Xsens MTi), a filter of its own
made it from these same rates and forces, with errors that are neither stated nor white, and from a magnetometer that
steel lining, rails and cables turn.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from scene.errors import RecordingError
from scene.poses.calibration import Calibration, Mount
from scene.poses.odometry import Guide
from scene.poses.trajectory import Trajectory
from scene.reading.recording import Recording
from scene.reading.source import cause

IMU_TYPE = "sensor_msgs/msg/Imu"
GRAVITY = 9.80665  # m/s²
# A carried or driven IMU averages one g over a recording. Livox publishes g, the others m/s².
_IN_G, _IN_SI = (0.7, 1.4), (0.7 * GRAVITY, 1.4 * GRAVITY)
_MIN_SAMPLES = 50  # of an IMU that is used
_ABSURD = 1e6  # of any unit
_FREE = 0.3 * GRAVITY  # m/s²; a median force below it has no gravity in it
_DEGREES = 2.0  # rad/s; a median rate above it is one in degrees


@dataclass(frozen=True)
class Inertial:
    """One IMU's samples over a recording."""

    times: Float[np.ndarray, " n"]  # s, growing
    rate: Float[np.ndarray, "n 3"]  # Angular rate in the IMU's axes, rad/s
    # Specific force in the IMU's axes, m/s²; at rest it points up and measures one g
    force: Float[np.ndarray, "n 3"]
    topic: str  # Topic of the samples


def imu_topics(recording: Recording) -> list[str]:
    """Return the topics with IMU messages; that of the LiDAR's own housing (`/livox/imu`) comes first."""
    beside = recording.topic.rsplit("/", 1)[0]
    connections = recording.reader.connections if recording.reader else ()
    topics = sorted({c.topic for c in connections if c.msgtype == IMU_TYPE})
    return sorted(topics, key=lambda topic: topic.rsplit("/", 1)[0] != beside)


def imu_samples(recording: Recording, topic: str) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
    """Yields samples in the order of the bag: time (s, header), rate (rad/s), force (the topic's unit).

    Raises `RecordingError`, which says which message is damaged.
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
    """Reads a whole IMU topic, sorted, without repeated times or values not finite, in rad/s and m/s².

    A force without gravity tells no attitude, and is left out: it is 0 then. `None` where fewer than 50 samples are
    left. Raises `RecordingError` for damage, or a force neither in g nor in m/s².
    """
    samples = [(time, *turn, *push) for time, turn, push in imu_samples(recording, topic)]
    rows = np.asarray(samples, np.float64).reshape(-1, 7)
    rows = rows[(np.abs(rows[:, 1:]) < _ABSURD).all(axis=1) & np.isfinite(rows[:, 0])]
    rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
    if len(rows) < _MIN_SAMPLES:
        return None
    turn, size = (float(np.median(np.linalg.norm(rows[:, part], axis=1))) for part in (slice(1, 4), slice(4, 7)))
    degrees = np.pi / 180.0 if turn > _DEGREES else 1.0
    # A force without gravity is small in the mean, too: at rest in g it is 1 along one axis
    free = float(np.linalg.norm(rows[:, 4:].mean(axis=0))) <= 0.5 * size and size < _FREE
    for (low, high), unit in (((0.0, _FREE), 0.0),) if free else ((_IN_G, GRAVITY), (_IN_SI, 1.0)):
        if low <= size < high:
            notes = ["rates in deg/s"] * (degrees != 1.0) + ["force without gravity, which is left out"] * free
            if notes:
                recording.facts["imu_units"] = f"{topic}: {', '.join(notes)}"
                print(f"IMU {recording.facts['imu_units']}", flush=True)
            return Inertial(rows[:, 0], rows[:, 1:4] * degrees, rows[:, 4:] * unit, topic)
    raise RecordingError(f"{recording.path}: {topic} has a median force of {size:.3g}, which is neither g nor m/s²")


def integrals(
    at: Float[np.ndarray, " k"], times: Float[np.ndarray, " n"], values: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "k 3"]:
    """Return the integrals of sampled values from the first sample to some times, s, by the trapezium rule."""
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(times)[:, None]
    total = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    return np.stack([np.interp(at, times, column) for column in total.T], axis=1)


_START_TIME = 0.2  # s; short, since a carrier sways
_LONGEST_GAP = 2.0  # s without IMU samples
_BY_GYRO = (np.deg2rad(0.05), 0.02)  # rad and m from one sweep to the next


def find_inertial(recording: Recording, calibration: Calibration) -> tuple[Inertial | None, Mount | None]:
    """Finds the first IMU whose mount is known and that ran without long pauses."""
    for topic in imu_topics(recording):
        if topic not in calibration.imu:
            continue
        inertial = read_inertial(recording, topic)
        if inertial is not None and np.diff(inertial.times).max() < _LONGEST_GAP:
            return inertial, calibration.imu[topic]
    return None, None


def gyro_guide(inertial: Inertial, mount: Mount) -> Guide:
    """Return attitudes of the LiDAR by the gyro alone, from the first sample on."""
    half = 0.5 * (inertial.rate[1:] + inertial.rate[:-1]) * np.diff(inertial.times)[:, None]
    attitudes = [np.eye(3)]
    for turn in Rotation.from_rotvec(half).as_matrix():
        attitudes.append(attitudes[-1] @ turn)
    turns = Rotation.from_matrix(np.asarray(attitudes) @ mount.rotation)
    return Guide(Trajectory(inertial.times, np.zeros_like(inertial.rate), turns, inertial.topic), False, *_BY_GYRO)


def level_rotation(
    recording: Recording, trajectory: Trajectory, inertial: Inertial | None, mount: Mount | None
) -> Rotation:
    """Return the smallest turn that makes gravity vertical, averaged over the recording; none without an IMU."""
    if inertial is None or mount is None:  # that in the LiDAR's own housing shows at first how it is held
        beside = recording.topic.rsplit("/", 1)[0]
        topic = next((topic for topic in imu_topics(recording) if topic.rsplit("/", 1)[0] == beside), None)
        own = read_inertial(recording, topic) if topic else None
        up = np.zeros(3) if own is None else own.force[own.times < own.times[0] + _START_TIME].sum(axis=0)
    else:
        inside = (inertial.times >= trajectory.times[0]) & (inertial.times <= trajectory.times[-1])
        _, turns = trajectory.at(inertial.times[inside])
        up = turns.apply(inertial.force[inside] @ mount.rotation).mean(axis=0)
    if not np.linalg.norm(up) > 0:
        return Rotation.identity()
    return Rotation.align_vectors([[0.0, 0.0, 1.0]], [up / np.linalg.norm(up)])[0]
