"""Record one episode into two folders: the robot's own sensors, and the truth."""

import hashlib
import heapq
import json
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from subterra_jax.evaluation.episodes import SHA256
from subterra_jax.host.versions import VERSION
from subterra_jax.recorder import messages
from subterra_jax.recorder.config import (
    RecorderConfig,
    RecorderError,
    World,
    check_config,
    draw_episode,
    open_agent,
    open_world,
)
from subterra_jax.recorder.messages import Message, write_bag
from subterra_jax.recorder.sensors import (
    IMU_RATE,
    Inertial,
    Poses,
    axis_rows,
    measure_imu,
    reckoned_poses,
    true_poses,
    tum_rows,
)
from subterra_jax.recorder.trace import Trace, drive
from subterra_jax.tasks import constants_digest

_IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


def _merge(streams: list[Iterator[Message]]) -> Iterator[Message]:
    return heapq.merge(*streams, key=lambda message: message.time)


def _mounts(height: float, frames: tuple[str, ...]) -> Iterator[Message]:
    lift = np.array([0.0, 0.0, height])
    parts = [messages.transform(0.0, "base_link", frame, lift, _IDENTITY) for frame in frames]
    yield Message(0.0, "/tf_static", messages.transforms(parts))


def _scans(topic: str, trace: Trace, ranges: Float[np.ndarray, "rows n"], range_max: float) -> Iterator[Message]:
    for time, row in zip(trace.time, ranges, strict=True):
        yield Message(time, topic, messages.laser_scan(time, "laser", row, range_max, trace.period))


def _commands(trace: Trace) -> Iterator[Message]:
    """Yield the commands, each at the start of the period in which it is obeyed."""
    for time, (speed, yaw_rate) in zip(trace.time[:-1], trace.command, strict=True):
        yield Message(time, "/cmd_vel", messages.command(time, float(speed), float(yaw_rate)))


def _odometry(topic: str, poses: Poses, frame: str) -> Iterator[Message]:
    for k, time in enumerate(poses.time):
        yield Message(time, topic, messages.odometry(poses, k, frame))


def _frames(poses: Poses, parent: str) -> Iterator[Message]:
    quaternion = poses.rotation.as_quat(canonical=True)
    for k, time in enumerate(poses.time):
        part = messages.transform(time, parent, "base_link", poses.position[k], quaternion[k])
        yield Message(time, "/tf", messages.transforms([part]))


def _imu(samples: Inertial) -> Iterator[Message]:
    for time, gyro, accel in zip(samples.time, samples.gyro, samples.accel, strict=True):
        yield Message(time, "/imu", messages.imu(time, gyro, accel))


def _points(trace: Trace, scans: Float[np.ndarray, "rows m"], sensor: Any, every: int) -> Iterator[Message]:
    """Yield the returns of the agent's own LiDAR in three dimensions, in its frame."""
    beams = np.asarray(sensor.directions)
    ring = np.arange(len(beams)) // sensor.shape[1]
    for time, ranges in zip(trace.time[::every], scans[::every], strict=True):
        hit = np.isfinite(ranges) & (ranges > 0.0) & (ranges < float(sensor.range_max))
        yield Message(time, "/points", messages.point_cloud(time, beams[hit] * ranges[hit, None], ring[hit]))


_RECORDING_SCHEMA, _TRUTH_SCHEMA = "subterra.recording/1", "subterra.recording-truth/1"
_LIBRARIES = ("jax", "numpy", "rosbags")


def _recording_facts(config: RecorderConfig, trace: Trace, world: World, topics: dict[str, Any]) -> dict[str, Any]:
    """Return the facts that do not give the truth away: neither seed nor outcome."""
    env, params, plan = world.env, world.params, world.plan
    parts = {name: where for name, where in env.fields(params).items() if name not in ("ranges", "scan", "odometry")}
    first = {name: float(trace.observation[0, where][0]) for name, where in parts.items() if name != "flag"}
    sensors: dict[str, Any] = {"lidar_height": world.sensor_height, "scan_beams": params.lidar.n_beams}
    if world.is_spatial:
        sensors |= {"sensor": config.sensor, "every": config.every, "cloud_range": float(params.lidar.range_max)}
    if config.imu:
        sensors["imu_rate"] = IMU_RATE
    return {
        "schema": _RECORDING_SCHEMA,
        "task": env.id,
        "tunnel": plan.name,
        "provenance": plan.provenance,
        "lining": config.lining or plan.default_lining,
        "agent": config.agent,
        "motion": config.motion,
        "observed": first,
        "steps": len(trace.command),
        "period": trace.period,
        "epoch": messages.EPOCH,
        "frames": {"odom": "base_link at the start", "sensors": "turned like base_link, lidar_height above it"},
        "sensors": sensors,
        "topics": topics,
        "constants": constants_digest(env, params),
        "versions": {"subterra-jax": VERSION, **{name: version(name) for name in _LIBRARIES}},
    }


def _outcome(trace: Trace, seed: int, severity: int | None) -> dict[str, Any]:
    state = trace.state
    moved = np.hypot(*np.diff(np.asarray(state.position, np.float64), axis=0).T)
    return {
        "seed": seed,
        "severity": severity,
        "success": trace.success,
        "contact": trace.contact,
        "travelled": float(moved.sum()),
        "station_first": float(state.station[0]),
        "station_last": float(state.station[-1]),
    }


def _truth_facts(
    config: RecorderConfig, recording: Path, outcome: dict[str, Any], topics: dict[str, Any]
) -> dict[str, Any]:
    bag = recording / f"{recording.name}.mcap"
    return {
        "schema": _TRUTH_SCHEMA,
        "episode": config.episode,
        "list_sha256": None if config.episode is None else SHA256,
        **outcome,
        "recording_sha256": hashlib.sha256(bag.read_bytes()).hexdigest(),
        "topics": topics,
        "files": {
            "lidar.tum": "poses of the LiDARs in the tunnel frame",
            "base_link.tum": "poses of base_link in the tunnel frame",
            "axis.csv": "centre of the track: station, x, y, z, m",
        },
    }


def _write_facts(folder: Path, content: dict[str, Any]) -> None:
    (folder / f"{folder.name}.json").write_text(json.dumps(content, indent=1, default=str) + "\n")


_POSE_FORMAT = "%.9f"


def record(config: RecorderConfig) -> Trace:
    """Drive an episode and record it; the same config gives the same bytes.

    Args:
        config: Settings of the recording.

    Returns:
        The episode.

    Raises:
        RecorderError: The settings are wrong, or a folder exists or cannot be written.
        SubterraError: Tunnel or agent are missing or wrong.
    """
    config = check_config(config)
    messages.store()
    world = open_world(config)
    agent = open_agent(config, world)
    seed, severity = draw_episode(config, world)
    trace = drive(world.env, world.params, agent, seed, severity, config.steps)
    with ExitStack() as stack:
        recording, truth = (stack.enter_context(_new_folder(f)) for f in (config.recording_folder, config.truth_folder))
        _write_recording(recording, config, trace, world, seed)
        _write_truth(truth, recording, config, trace, world, _outcome(trace, seed, severity))
    return trace


def _write_recording(folder: Path, config: RecorderConfig, trace: Trace, world: World, seed: int) -> None:
    """Write the messages and facts that the robot itself knows."""
    parts, range_max = world.env.fields(world.params), float(world.params.lidar.range_max)
    height = world.sensor_height
    reckoned = reckoned_poses(trace, trace.observation[:, parts["odometry"]])
    sensor = true_poses(trace, world.plan, world.track).lift(height)
    mounted = {"laser": not world.is_spatial, "lidar": world.is_spatial, "imu": config.imu}
    streams: list[Iterator[Message]] = [
        _mounts(height, tuple(frame for frame, there in mounted.items() if there)),
        _frames(reckoned, "odom"),
        _odometry("/odom", reckoned, "odom"),
        _commands(trace),
    ]
    if world.is_spatial:
        streams.append(_points(trace, trace.observation[:, parts["scan"]], world.params.lidar, config.every))
    else:
        streams.append(_scans("/scan", trace, trace.observation[:, parts["ranges"]], range_max))
    if config.imu:
        streams.append(_imu(measure_imu(sensor, seed)))
    topics = write_bag(folder, _merge(streams))
    _save_tum(folder / "odometry.tum", reckoned.lift(height))
    _write_facts(folder, _recording_facts(config, trace, world, topics))


def _write_truth(
    folder: Path, recording: Path, config: RecorderConfig, trace: Trace, world: World, outcome: dict[str, Any]
) -> None:
    """Write the messages and facts that the robot does not know."""
    body = true_poses(trace, world.plan, world.track)
    streams: list[Iterator[Message]] = [_frames(body, "map"), _odometry("/truth/odometry", body, "map")]
    topics = write_bag(folder, _merge(streams))
    _save_tum(folder / "lidar.tum", body.lift(world.sensor_height))
    _save_tum(folder / "base_link.tum", body)
    header = "station,x,y,z"
    np.savetxt(folder / "axis.csv", axis_rows(world.plan), fmt="%.6f", delimiter=",", header=header, comments="")
    _write_facts(folder, _truth_facts(config, recording, outcome, topics))


def _save_tum(path: Path, poses: Poses) -> None:
    np.savetxt(path, tum_rows(poses, messages.EPOCH), fmt=_POSE_FORMAT)


@contextmanager
def _new_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder that takes its name once complete; nothing is left after a failure."""
    partial = folder.with_name(f".{folder.name}.partial") / folder.name
    try:
        shutil.rmtree(partial.parent, ignore_errors=True)
        partial.parent.mkdir(parents=True)
        yield partial
        partial.rename(folder)
    except OSError as error:
        raise RecorderError(f"{folder}: cannot be written ({error.strerror})") from error
    finally:
        shutil.rmtree(partial.parent, ignore_errors=True)
