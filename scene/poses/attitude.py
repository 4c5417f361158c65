"""Attitude from an IMU: which one, a guide for the odometry, and what is level."""

import numpy as np
from scipy.spatial.transform import Rotation

from scene.poses import rotation as so3
from scene.poses.calibration import Calibration, Mount
from scene.poses.imu import Inertial, imu_topics, read_inertial
from scene.poses.tracker import Guide
from scene.poses.trajectory import Trajectory
from scene.reading.recording import Recording

_LEVEL_TIME = 0.2  # s; short, since a carrier sways
_LONGEST_GAP = 2.0  # s without IMU samples
_BY_GYRO = (np.deg2rad(0.05), 0.02)  # rad and m from one sweep to the next


def find_inertial(recording: Recording, calibration: Calibration) -> tuple[Inertial | None, Mount | None]:
    """The first IMU whose place on the carrier is known and that ran without long pauses."""
    for topic in imu_topics(recording):
        if topic not in calibration.imu:
            continue
        inertial = read_inertial(recording, topic)
        if inertial is not None and np.diff(inertial.times).max() < _LONGEST_GAP:
            return inertial, calibration.imu[topic]
    return None, None


def gyro_guide(inertial: Inertial, mount: Mount) -> Guide:
    """Attitudes of the LiDAR by the gyro alone, from the first sample on."""
    half = 0.5 * (inertial.rate[1:] + inertial.rate[:-1]) * np.diff(inertial.times)[:, None]
    attitudes = [np.eye(3)]
    for turn in so3.exp(half):
        attitudes.append(attitudes[-1] @ turn)
    turns = Rotation.from_matrix(np.asarray(attitudes) @ mount.rotation)
    return Guide(Trajectory(inertial.times, np.zeros_like(inertial.rate), turns, inertial.topic), False, *_BY_GYRO)


def levelling(recording: Recording, trajectory: Trajectory, inertial: Inertial | None, mount: Mount | None) -> Rotation:
    """The smallest turn that makes gravity vertical, averaged over the recording; none without an IMU."""
    if inertial is None or mount is None:
        up = recording.up_at_start(_LEVEL_TIME)
    else:
        inside = (inertial.times >= trajectory.times[0]) & (inertial.times <= trajectory.times[-1])
        _, turns = trajectory.at(inertial.times[inside])
        up = turns.apply(inertial.force[inside] @ mount.rotation).mean(axis=0)
    if up is None or not np.linalg.norm(up) > 0:
        return Rotation.identity()
    return Rotation.align_vectors([[0.0, 0.0, 1.0]], [up / np.linalg.norm(up)])[0]
