"""`python -m benchmarks.rewrite RECORDING --out a.bag`: sweeps and IMUs of a recording, as another driver has them.

Of the recorder's episodes, of simulated surveys and of one's own recordings. Intensities and rings are not taken along.
"""

import heapq
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from benchmarks.command import run_main
from scene.poses.imu import IMU_TYPE, imu_samples, imu_topics
from scene.reading.recording import Recording
from scene.survey import messages
from scene.survey.lidar import Lidar, Sweep
from scene.survey.messages import Convention, Recorder, chunks_of, encode


@dataclass(frozen=True)
class RewriteConfig:
    """The sweeps and IMUs of a recording, as another driver publishes them."""

    recording: Annotated[Path, tyro.conf.Positional]  # What `scene.build` reads.
    out: Path  # Bag of ROS 1; other recordings become a folder of its name without the ending.
    topic: str | None = None  # LiDAR topic of the recording.
    # The convention; what it calls the driver's own is as `header` here.
    convention: Convention = field(default_factory=lambda: Convention(point_times="header"))


def rewrite(config: RewriteConfig) -> Path:
    """Writes a recording anew; returns what a user would name.

    Raises `RecordingError` where it cannot be read, and `ValueError` for a convention that no driver has.
    """
    config.convention.check()
    with Recording(config.recording, config.topic) as recording:
        recording.peek()
        kinds = {recording.topic: messages.CLOUD_TYPE} | dict.fromkeys(imu_topics(recording), IMU_TYPE)
        starts = {k * recording.scan_count // config.convention.bags for k in range(1, config.convention.bags)}
        streams = [_sweeps(recording, config.convention)]
        streams += [_samples(recording, topic, config.convention) for topic in imu_topics(recording)]
        with Recorder(config.out, kinds, config.convention) as bag:
            for at, topic, number, raws in heapq.merge(*streams, key=lambda row: row[0]):
                if number in starts:
                    bag.start_part()
                for raw in raws:
                    bag.write(topic, at, raw)
    return bag.path


_Row = tuple[int, str, int, list[bytes]]  # ns since the epoch of surveys, topic, number of a sweep or -1, messages


def _sweeps(recording: Recording, convention: Convention) -> Iterator[_Row]:
    for number, scan in enumerate(recording.scans()):
        offset, none = np.rint(1e9 * scan.times).astype(np.int64), np.zeros(len(scan.points), np.uint8)
        lidar = Lidar("lidar", offset, 0, none, lambda *_: np.zeros((0, 3)), 0.0, np.inf, 0.0, 0.0)
        sweep = Sweep(number, _since(scan.stamp), offset, none == 0, scan.points, none, none > 0)
        raws = [encode(*chunk, convention) for chunk in chunks_of(sweep, lidar, convention)]
        yield sweep.begin + int(offset.max(initial=0)), recording.topic, number, raws


def _samples(recording: Recording, topic: str, convention: Convention) -> Iterator[_Row]:
    for time, turn, push in imu_samples(recording, topic):
        stamp = _since(time + convention.imu_late)
        raw = messages.imu_messages("imu", np.array([stamp]), None, turn[None], push[None])
        yield _since(time), topic, -1, raw


def _since(time: float) -> int:
    return round(1e9 * (time - messages.EPOCH))


if __name__ == "__main__":
    sys.exit(run_main("rewrite", RewriteConfig, lambda config: print(rewrite(config)), description=__doc__))
