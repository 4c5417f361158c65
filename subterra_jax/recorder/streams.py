"""The topics of a recording, each a stream of messages in order of time."""

import heapq
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from subterra_jax.lidar3d import Relief
from subterra_jax.recorder import messages
from subterra_jax.recorder.config import Recording
from subterra_jax.recorder.drive import Trace
from subterra_jax.recorder.messages import Message
from subterra_jax.recorder.poses import Inertial, Poses
from subterra_jax.recorder.sensing import clouds

_IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


def merged(streams: list[Iterator[Message]]) -> Iterator[Message]:
    """Several streams as one in order of time; at equal times in the order of the list."""
    return heapq.merge(*streams, key=lambda message: message.time)


def mounts(height: float, frames: tuple[str, ...]) -> Iterator[Message]:
    """Where the sensors sit, said once."""
    lift = np.array([0.0, 0.0, height])
    parts = [messages.transform(0.0, "base_link", frame, lift, _IDENTITY) for frame in frames]
    yield Message(0.0, "/tf_static", messages.transforms(parts))


def scans(topic: str, trace: Trace, ranges: Float[np.ndarray, "rows n"], range_max: float) -> Iterator[Message]:
    """A planar LiDAR."""
    for time, row in zip(trace.time, ranges, strict=True):
        yield Message(time, topic, messages.laser_scan(time, "laser", row, range_max, trace.period))


def commands(trace: Trace) -> Iterator[Message]:
    """What the robot was told, at the start of the period in which it obeyed."""
    for time, (speed, yaw_rate) in zip(trace.time[:-1], trace.command, strict=True):
        yield Message(time, "/cmd_vel", messages.command(time, float(speed), float(yaw_rate)))


def odometry(topic: str, poses: Poses, frame: str) -> Iterator[Message]:
    """Poses of `base_link` in a frame."""
    for k, time in enumerate(poses.time):
        yield Message(time, topic, messages.odometry(poses, k, frame))


def frames(poses: Poses, parent: str) -> Iterator[Message]:
    """The same as transforms."""
    quaternion = poses.rotation.as_quat(canonical=True)
    for k, time in enumerate(poses.time):
        part = messages.transform(time, parent, "base_link", poses.position[k], quaternion[k])
        yield Message(time, "/tf", messages.transforms([part]))


def inertial(samples: Inertial) -> Iterator[Message]:
    """An IMU."""
    for time, gyro, accel in zip(samples.time, samples.gyro, samples.accel, strict=True):
        yield Message(time, "/imu", messages.imu(time, gyro, accel))


def points(
    relief: Relief, poses: Poses, station: Float[np.ndarray, " n"], config: Recording, seed: int
) -> Iterator[Message]:
    """A LiDAR in three dimensions: the returns of each sweep, in its own frame."""
    some = slice(None, None, config.every)
    taken = Poses(poses.time[some], poses.position[some], poses.rotation[some])
    beams = config.directions
    ring = np.arange(len(beams)) % config.n_rings
    for time, ranges in zip(taken.time, clouds(relief, taken, station[some], beams, seed), strict=True):
        seen = np.isfinite(ranges)
        yield Message(time, "/points", messages.point_cloud(time, beams[seen] * ranges[seen, None], ring[seen]))
