"""Sets of evaluation recordings, and the sweeps that SLAM programs read from them."""

import dataclasses
import hashlib
import json
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from jaxtyping import Float
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from benchmarks.command import BenchmarkError
from benchmarks.results import write_file
from scene.reading.scans import parse_pointcloud2
from subterra_jax.evaluation.episodes import N_LISTED
from subterra_jax.host.task_ids import no_task
from subterra_jax.recorder import RecorderConfig, record
from subterra_jax.recorder.config import check_config, open_world
from subterra_jax.tasks import TASKS

SCHEMA = "subterra.recording-set/1"
RECORDINGS, TRUTH, INDEX = "recordings", "truth", "set.json"
# The oracle brings every episode to its end; on Relocalise it would not move, so the particle filter drives there.
_DRIVER, _SEEKER = "oracle", "particle-filter"
_WITHOUT_CLOUD = ("Obstructed", "Faulted")  # clouds show neither boxes nor faults


@dataclasses.dataclass(frozen=True)
class SetConfig:
    """Settings of a set of recordings.

    Attributes:
        out: Folder of the set: `recordings/` to hand out, `truth/` to keep.
        tasks: Task ids, as `StopAt`.
        linings: Variants of the walls.
        episodes: Number of episodes of each task, from the start of its list.
        scene: Built scene folder; its tunnel is driven and clouds are recorded in it.
        tunnel: Tunnel to use instead, without clouds.
        cloud: 3-D LiDAR, if a scene is given and the task has no boxes or faults.
        columns: Columns of its sweep.
        beams: Beams of `/scan_dense`.
        steps: Largest number of steps of a recording.
        secret: Number from which episodes are drawn instead of the public list, for a test whose truth nobody else
            can reproduce. It is kept with the truth only.
    """

    out: Path
    tasks: tuple[str, ...] = ("Traverse", "StopAt", "Return", "Obstructed", "Faulted", "Relocalise")
    linings: tuple[str, ...] = ("pockets",)
    episodes: int = 3
    scene: Path | None = None
    tunnel: str | None = None
    cloud: Literal["vlp16", "os1"] = "vlp16"
    columns: int = 900
    beams: int = 720
    steps: int | None = None
    secret: int | None = None


def plan_set(config: SetConfig) -> list[tuple[str, RecorderConfig]]:
    """Returns the recordings of a set with their names, as `StopAt-pockets-000`.

    Raises:
        BenchmarkError: There is no such task, nothing to record, or a number is out of range.
    """
    if config.episodes < 1 or not config.tasks or not config.linings:
        raise BenchmarkError(f"nothing to record: {config.episodes} episodes of tasks {config.tasks}, {config.linings}")
    if config.episodes > N_LISTED and config.secret is None:
        raise BenchmarkError(f"episodes must be at most {N_LISTED}, the length of the list, got {config.episodes}")
    if config.secret is not None and config.secret < 0:
        raise BenchmarkError(f"secret must not be negative, got {config.secret}")
    plan = []
    for task in config.tasks:
        short = task.removeprefix("Subterra/").removesuffix("-v1")
        if f"Subterra/{short}-v1" not in TASKS:
            raise BenchmarkError(no_task(task, TASKS))
        for lining in config.linings:
            for episode in range(config.episodes):
                name = f"{short}-{lining}-{episode:03d}"
                plan.append((name, _recording(config, name, short, lining, episode)))
    return plan


def _recording(config: SetConfig, name: str, task: str, lining: str, episode: int) -> RecorderConfig:
    with_cloud = config.scene is not None and not task.startswith(_WITHOUT_CLOUD)
    one = RecorderConfig(
        out=config.out / RECORDINGS / name, truth=config.out / TRUTH / name, task=task, lining=lining,
        agent=_SEEKER if task.startswith("Relocalise") else _DRIVER, tunnel=config.tunnel, scene=config.scene,
        cloud=config.cloud if with_cloud else "none", columns=config.columns, beams=config.beams, imu=True,
        steps=config.steps,
    )  # fmt: skip
    if config.secret is None:
        return dataclasses.replace(one, episode=episode)
    return dataclasses.replace(one, seed=_secret_seed(config.secret, name))


def _secret_seed(secret: int, name: str) -> int:
    """Returns the seed of a recording's name; it cannot be computed without the secret."""
    return int.from_bytes(hashlib.sha256(f"{SCHEMA} {secret} {name}".encode()).digest()[:4], "little")


def make_set(config: SetConfig) -> Iterator[tuple[str, bool]]:
    """Records what is missing; yields each name and whether it was there already.

    Raises:
        BenchmarkError: The folder was recorded with other settings or cannot be written.
        SubterraError: A recording cannot be made.
    """
    plan = plan_set(config)
    _check(plan)
    settings = {key: value for key, value in dataclasses.asdict(config).items() if key not in ("out", "tasks")}
    _keep_settings(
        config.out / TRUTH / INDEX, json.dumps({"schema": SCHEMA, "config": settings}, indent=1, default=str)
    )
    for name, one in plan:
        exists = one.recording_folder.is_dir() and one.truth_folder.is_dir()
        if not exists:
            record(one)
        yield name, exists
    public = {key: value for key, value in settings.items() if key != "secret"}
    content = {"schema": SCHEMA, "recordings": [name for name, _ in plan], "config": public}
    (config.out / INDEX).write_text(json.dumps(content, indent=1, default=str) + "\n")


def _check(plan: list[tuple[str, RecorderConfig]]) -> None:
    """Checks numbers, folders, and each task with each lining before anything is written."""
    for _, one in plan:
        if not one.recording_folder.is_dir():
            check_config(one)
    for one in {(one.task, one.lining): one for _, one in plan}.values():
        open_world(one)


def _keep_settings(path: Path, settings: str) -> None:
    """Keeps the settings of a set with the truth; refuses other settings later."""
    if path.is_file() and path.read_text() != settings:
        raise BenchmarkError(f"{path.parent.parent}: was recorded with other settings; choose another folder")
    write_file(path, settings.encode())


def recordings_in(folder: Path) -> list[tuple[str, Path]]:
    """Returns names and bags of the recordings in a set or in its `recordings/`.

    Raises:
        BenchmarkError: The folder holds no recordings.
    """
    inside = folder / RECORDINGS if (folder / RECORDINGS).is_dir() else folder
    bags = sorted(path for path in inside.glob("*/recording") if path.is_dir()) if inside.is_dir() else []
    if not bags:
        raise BenchmarkError(f"{folder}: holds no recordings (`python -m benchmarks.slam record` makes some)")
    return [(bag.parent.name, bag) for bag in bags]


Sweep = tuple[float, Float[np.ndarray, "n 3"]]  # stamp, s; points in the sensor's frame, m
CLOUDS, PLANAR = "/points", "/scan_dense"


def read_clouds(folder: Path, topic: str = CLOUDS) -> Iterator[Sweep]:
    """Reads the sweeps of the 3-D LiDAR.

    Args:
        folder: Bag of the recording.
        topic: Topic of `sensor_msgs/PointCloud2`.

    Raises:
        BenchmarkError: The folder holds no bag, a damaged one, or one without this topic.
    """
    for message in _messages(folder, topic):
        scan = parse_pointcloud2(message, _stamp(message))
        yield scan.stamp, np.asarray(scan.points, np.float64)


def read_planar(folder: Path, topic: str = PLANAR) -> Iterator[Sweep]:
    """Reads planar scans as points at height 0; beams that hit nothing are left out.

    Args:
        folder: Bag of the recording.
        topic: Topic of `sensor_msgs/LaserScan`.

    Raises:
        BenchmarkError: As for `read_clouds`.
    """
    for message in _messages(folder, topic):
        ranges = np.asarray(message.ranges, np.float64)
        bearing = message.angle_min + message.angle_increment * np.arange(len(ranges))
        hit = (ranges >= message.range_min) & (ranges < message.range_max)
        level = ranges[hit, None] * np.column_stack([np.cos(bearing[hit]), np.sin(bearing[hit])])
        yield _stamp(message), np.column_stack([level, np.zeros(len(level))])


def count_messages(folder: Path) -> dict[str, int]:
    """Returns the number of messages of each topic of a bag.

    Raises:
        BenchmarkError: The folder holds no bag or a damaged one.
    """
    with closing(_open_bag(folder)) as reader:
        return {connection.topic: connection.msgcount for connection in reader.connections}


CALIBRATION = "calibration.yaml"


def check_recording(folder: Path) -> None:
    """Checks that a recording of the arena is whole: its bag, its calibration, and the topics that this names.

    Raises:
        BenchmarkError: A file is missing or damaged, or the bag lacks a topic.
    """
    held, path = count_messages(folder / "recording"), folder / CALIBRATION
    try:
        facts = yaml.safe_load(path.read_text())
        topics = [facts[part]["topic"] for part in ("lidar", "imu")]
    except OSError as error:
        raise BenchmarkError(f"{path}: is missing; it names topics, extrinsics and noise") from error
    except (yaml.YAMLError, KeyError, TypeError) as error:
        raise BenchmarkError(f"{path}: is no calibration: it must name the topics of lidar and imu") from error
    for topic in topics:
        if not held.get(topic):
            raise BenchmarkError(f"{folder / 'recording'}: has no topic {topic}; it has {', '.join(sorted(held))}")


def _messages(folder: Path, topic: str) -> Iterator[Any]:
    types = get_typestore(Stores.ROS2_JAZZY)
    with closing(_open_bag(folder)) as reader:
        some = [connection for connection in reader.connections if connection.topic == topic]
        if not some:
            held = ", ".join(sorted(connection.topic for connection in reader.connections))
            raise BenchmarkError(f"{folder}: has no topic {topic}; it has {held}")
        for connection, _, raw in reader.messages(connections=some):
            yield types.deserialize_cdr(raw, connection.msgtype)


def _open_bag(folder: Path) -> Any:
    if not (folder / "metadata.yaml").is_file():
        other = " (programs here read bags of ROS 2, as `--formats mcap` writes them)"
        ros1 = folder.with_suffix(".bag").is_file()
        raise BenchmarkError(f"{folder}: is no recording: metadata.yaml is missing{other if ros1 else ''}")
    try:
        reader = Reader(folder)
        reader.open()
    except Exception as error:  # the library raises many kinds of errors for a damaged file
        raise BenchmarkError(f"{folder}: not a whole recording ({error})") from error
    return reader


def _stamp(message: Any) -> float:
    return float(message.header.stamp.sec + message.header.stamp.nanosec * 1e-9)
