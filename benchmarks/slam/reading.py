"""Recordings as programs read them: bags of a set, their sweeps with the time of every point, and IMU samples."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from benchmarks.command import BenchmarkError

RECORDINGS, TRUTH, INDEX = "recordings", "truth", "set.json"  # folders and file of a set
CALIBRATION, TRUTH_FILE, ODOMETRY = "calibration.yaml", "lidar.tum", "odometry.tum"

Poses = tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 4 4"], float]  # times, s; LiDAR poses; run time, s
# One layout for all drivers: m, reflectivity or intensity as reported, ns after the header's stamp, line.
POINT = np.dtype([
    ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("t", "<u4"), ("ring", "<u2"),
])  # fmt: skip
DOPPLER_POINT = np.dtype([*POINT.descr, ("velocity", "<f4")])  # m/s, positive away
_KINDS = {2: "u1", 4: "<u2", 6: "<u4", 7: "<f4", 8: "<f8"}
_TIMES = {"time": 1e9, "t": 1.0}  # field of Velodyne's and Ouster's drivers, and its unit in ns
# Livox's point in CDR: 19 bytes, aligned to 4.
_LIVOX_CDR = np.dtype({
    "names": ["t", "x", "y", "z", "intensity", "ring"], "formats": ["<u4", "<f4", "<f4", "<f4", "u1", "u1"],
    "offsets": [0, 4, 8, 12, 16, 18], "itemsize": 20,
})  # fmt: skip


def recordings_in(folder: Path) -> list[Path]:
    """Returns the folders of the recordings in a set or in its `recordings/`.

    Raises:
        BenchmarkError: The folder holds no recordings.
    """
    inside = folder / RECORDINGS if (folder / RECORDINGS).is_dir() else folder
    bags = sorted(path for path in inside.glob("*/recording") if path.is_dir()) if inside.is_dir() else []
    if not bags:
        raise BenchmarkError(f"{folder}: holds no recordings (`python -m benchmarks.slam arena` makes some)")
    return [bag.parent for bag in bags]


def check_recording(recording: Path) -> None:
    """Checks that a recording of the arena is whole: its bag, its calibration, and the topics that this names.

    Raises:
        BenchmarkError: A file is missing or damaged, or the bag lacks a topic.
    """
    path = recording / CALIBRATION
    with closing(_open_bag(recording / "recording")) as reader:
        held = {connection.topic: connection.msgcount for connection in reader.connections}
    try:
        facts = yaml.safe_load(path.read_text())
        topics = [facts[part]["topic"] for part in ("lidar", "imu")]
    except OSError as error:
        raise BenchmarkError(f"{path}: is missing; it names topics, extrinsics and noise") from error
    except (yaml.YAMLError, KeyError, TypeError) as error:
        raise BenchmarkError(f"{path}: is no calibration: it must name the topics of lidar and imu") from error
    for topic in topics:
        if not held.get(topic):
            raise BenchmarkError(f"{recording / 'recording'}: has no topic {topic}; it has {', '.join(sorted(held))}")


def measures_speed(recording: Path) -> bool:
    """Tells whether the LiDAR of a recording measures the speed of each range."""
    path = recording / CALIBRATION
    return path.is_file() and "doppler: true" in path.read_text()  # `check_recording` tells what is wrong with a file


def _open_bag(folder: Path) -> Any:
    if not (folder / "metadata.yaml").is_file():
        ros1 = folder.with_suffix(".bag").is_file()
        other = " (programs here read bags of ROS 2, as `--formats mcap` writes them)" if ros1 else ""
        raise BenchmarkError(f"{folder}: is no recording: metadata.yaml is missing{other}")
    try:
        reader = Reader(folder)
        reader.open()
    except Exception as error:  # the library raises many kinds of errors for a damaged file
        raise BenchmarkError(f"{folder}: not a whole recording ({error})") from error
    return reader


def sweep_points(message: Any) -> np.ndarray:
    """Returns the points of a `PointCloud2` of Velodyne or Ouster or of a Livox `CustomMsg`, `(n,)` of `POINT`.

    Those of a Doppler LiDAR are of `DOPPLER_POINT`.

    Beams without a return stay, at (0, 0, 0), where the driver keeps them.

    Raises:
        ValueError: The cloud has no time of its points.
    """
    if hasattr(message, "point_num"):
        rows = [(p.x, p.y, p.z, p.reflectivity, p.offset_time, p.line) for p in message.points]
        return np.array(rows, POINT)
    fields = {field.name: field for field in message.fields}
    names = list(fields)
    layout = np.dtype({
        "names": names, "formats": [_KINDS[fields[name].datatype] for name in names],
        "offsets": [fields[name].offset for name in names], "itemsize": message.point_step,
    })  # fmt: skip
    raw = np.frombuffer(message.data, layout)
    time = next((name for name in _TIMES if name in fields), None)
    if time is None:
        raise ValueError(f"its points have no time; they have {', '.join(names)}")
    points = np.zeros(len(raw), DOPPLER_POINT if "velocity" in fields else POINT)
    for name in {*(points.dtype.names or ())} - {"intensity", "t"}:
        points[name] = raw[name]
    points["intensity"] = raw["reflectivity" if "reflectivity" in fields else "intensity"]  # which no range weakens
    points["t"] = np.rint(_TIMES[time] * raw[time].astype(np.float64))
    return points


def livox_points(raw: bytes) -> tuple[int, np.ndarray]:
    """Returns the stamp, ns, and the points of a serialised `livox_ros_driver2/CustomMsg` of ROS 2, `(n,)` of `POINT`.

    A hundred times as fast as an object for each point.
    """
    seconds, rest, size = np.frombuffer(raw, "<u4", 3, 4).tolist()
    begin = 4 + -(-(12 + size) // 8) * 8  # the time base is aligned to 8 bytes after the first 4
    count = int(np.frombuffer(raw, "<u4", 1, begin + 16)[0])
    rows = np.frombuffer(bytes(raw[begin + 20 :]) + b"\0", _LIVOX_CDR, count)
    points = np.zeros(count, POINT)
    for name in POINT.names or ():
        points[name] = rows[name]
    return seconds * 1_000_000_000 + rest, points


def read_samples(recording: Path) -> Iterator[tuple[int, Any]]:
    """Yields stamps, ns, with pairs of acceleration and turn rate, or arrays of points, in order of recording."""
    facts = yaml.safe_load((recording / CALIBRATION).read_text())
    with AnyReader([recording / "recording"]) as reader:
        topics = (facts["lidar"]["topic"], facts["imu"]["topic"])
        for connection, _, raw in reader.messages([one for one in reader.connections if one.topic in topics]):
            if connection.msgtype.endswith("CustomMsg"):
                yield livox_points(raw)
                continue
            message: Any = reader.deserialize(raw, connection.msgtype)
            stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
            if connection.topic == topics[0]:
                yield stamp, sweep_points(message)
            else:
                force, turn = message.linear_acceleration, message.angular_velocity
                yield stamp, (np.array([force.x, force.y, force.z]), np.array([turn.x, turn.y, turn.z]))
