"""The recording of one device: its LiDAR and its IMUs in one ROS1 bag."""

from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer

from scene.survey import imu, messages, pointcloud, rack, write
from scene.survey.avia import avia
from scene.survey.carrier import Carried
from scene.survey.config import LidarName, SurveyConfig
from scene.survey.lidar import SCAN_PERIOD, Lidar, Sweep
from scene.survey.os1 import os1
from scene.survey.vlp16 import vlp16

Message = tuple[int, str, bytes]  # time in ns since the start of the survey, topic, bytes


@dataclass(frozen=True)
class Device:
    """One LiDAR of the rack and how its driver publishes it.

    Attributes:
        lidar: The model.
        suffix: Of the names of its files.
        topic: Of its sweeps.
        kind: Type, definition and MD5 sum of its messages.
        encode: A sweep as one of them.
    """

    lidar: Lidar
    suffix: str
    topic: str
    kind: tuple[str, str, str]
    encode: Callable[[Sweep, Lidar], bytes]


_LIVOX = (messages.CUSTOM_TYPE, messages.CUSTOM_DEFINITION, messages.CUSTOM_MD5)
_CLOUD = (pointcloud.CLOUD_TYPE, pointcloud.CLOUD_DEFINITION, pointcloud.CLOUD_MD5)


def device(name: LidarName, config: SurveyConfig) -> Device:
    """The device called `name`."""
    if name == "avia":
        return Device(avia(config.point_rate), "", "/livox/lidar", _LIVOX, messages.custom_message)
    if name == "vlp16":
        return Device(vlp16(), "_vlp16", "/velodyne_points", _CLOUD, pointcloud.velodyne_message)
    return Device(os1(), "_os1", "/ouster/points", _CLOUD, pointcloud.ouster_message)


def inertial(
    seeds: list[np.random.SeedSequence], name: LidarName, carried: Carried, config: SurveyConfig
) -> list[Message]:
    """Messages of all IMUs of a device, in order of time.

    Args:
        seeds: One for each IMU.
        name: Of the device.
        carried: Motion of its LiDAR.
        config: Of the survey.
    """
    out = []
    for seed, one in zip(seeds, rack.IMUS[name], strict=True):
        sample = imu.measure_inertial(np.random.default_rng(seed), carried, one.rate, one.mount, config.errors)
        at = np.rint(sample.time * 1e9).astype(np.int64)
        accel = sample.accel / (imu.GRAVITY if one.in_g else 1.0)
        raw = messages.imu_messages(one.frame, at, sample.quaternion if one.orientation else None, sample.gyro, accel)
        out += [(int(t), one.topic, m) for t, m in zip(at, raw, strict=True)]
    return sorted(out, key=lambda m: m[:2])


def record(
    path: Path, device: Device, sweeps: Iterable[Sweep], inertial: list[Message], cloud: write.CloudWriter | None
) -> int:
    """Write the bag, and the cloud if asked; return the number of returns.

    A message is recorded when it is complete: a sweep one period after its first point.

    Args:
        path: Bag to write.
        device: What it holds.
        sweeps: In order of time.
        inertial: Messages of the IMUs, in order of time.
        cloud: Where to put the placed returns too.
    """
    returns, waiting = 0, iter([*inertial, (2**62, "", b"")])
    kinds = {topic: (messages.IMU_TYPE, messages.IMU_DEFINITION, messages.IMU_MD5) for _, topic, _ in inertial}
    kinds[device.topic] = device.kind
    with ExitStack() as stack:
        bag = stack.enter_context(Writer(stack.enter_context(write.replacing(path))))
        topics = {
            name: bag.add_connection(name, kind, msgdef=text, md5sum=md5)
            for name, (kind, text, md5) in sorted(kinds.items())
        }
        at, topic, raw = next(waiting)
        for sweep in sweeps:
            end = sweep.begin + round(SCAN_PERIOD * 1e9)
            while at < end:
                bag.write(topics[topic], messages.stamp(at), raw)
                at, topic, raw = next(waiting)
            bag.write(topics[device.topic], messages.stamp(end), device.encode(sweep, device.lidar))
            returns += int(sweep.valid.sum())
            if cloud:
                cloud.add(sweep.placed[sweep.valid], sweep.reflectivity[sweep.valid])
        while topic:
            bag.write(topics[topic], messages.stamp(at), raw)
            at, topic, raw = next(waiting)
    return returns
