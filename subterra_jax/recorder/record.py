"""One episode to two folders: what the sensors recorded, and the truth."""

import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from subterra_jax.lidar3d import Relief
from subterra_jax.recorder import facts, messages, sensing, streams
from subterra_jax.recorder.config import Recording, RecordingError, checked
from subterra_jax.recorder.drive import Trace, drive
from subterra_jax.recorder.messages import Message, write_bag
from subterra_jax.recorder.poses import Poses, axis_rows, measure_imu, reckoned_poses, true_poses, tum_rows
from subterra_jax.recorder.world import World, draw, open_agent, open_world

_POSE_FORMAT = "%.9f"


def record(config: Recording) -> Trace:
    """Drive an episode and write it down; the same config gives the same bytes.

    Args:
        config: What to record and where to.

    Returns:
        The episode.

    Raises:
        RecordingError: It cannot be had, or the folders exist or cannot be written.
        SubterraError: Tunnel, scene, agent or policy are missing or wrong.
    """
    config = checked(config)
    messages.store()
    world = open_world(config)
    agent = open_agent(config, world)
    relief = None if config.cloud == "none" else Relief.from_scene(config.scene or "", config.lining or "pockets")
    seed, severity = draw(config, world)
    trace = drive(world.env, world.params, agent, seed, severity, config.steps)
    with ExitStack() as stack:
        recording, truth = (stack.enter_context(_new(f)) for f in (config.recording_folder, config.truth_folder))
        _write_recording(recording, config, trace, world, relief, seed)
        _write_truth(truth, recording, config, trace, world, facts.outcome(trace, seed, severity))
    return trace


def _write_recording(
    folder: Path, config: Recording, trace: Trace, world: World, relief: Relief | None, seed: int
) -> None:
    """All that the robot itself knows."""
    parts, range_max = world.env.fields(world.params), float(world.params.lidar.range_max)
    height = world.plan.lidar_height
    reckoned = reckoned_poses(trace, trace.observation[:, parts["odometry"]])
    sensor = true_poses(trace, world.plan).lifted(height)
    wanted = {"laser": True, "lidar": relief is not None, "imu": config.imu}
    found = [
        streams.mounts(height, tuple(frame for frame, there in wanted.items() if there)),
        streams.frames(reckoned, "odom"),
        streams.odometry("/odom", reckoned, "odom"),
        streams.commands(trace),
        streams.scans("/scan", trace, trace.observation[:, parts["ranges"]], range_max),
    ]
    if config.beams:
        dense = sensing.dense_scans(trace, world.env, world.params, config.beams, seed)
        found.append(streams.scans("/scan_dense", trace, dense, range_max))
    if config.imu:
        found.append(streams.inertial(measure_imu(sensor, seed)))
    if relief is not None:
        found.append(streams.points(relief, sensor, np.asarray(trace.state.station), config, seed))
    topics = write_bag(folder, streams.merged(found))
    _save_tum(folder / "odometry.tum", reckoned.lifted(height))
    facts.write(folder, facts.recording(config, trace, world, topics))


def _write_truth(
    folder: Path, recording: Path, config: Recording, trace: Trace, world: World, outcome: dict[str, Any]
) -> None:
    """All that the robot does not know."""
    body = true_poses(trace, world.plan)
    found: list[Iterator[Message]] = [streams.frames(body, "map"), streams.odometry("/truth/odometry", body, "map")]
    topics = write_bag(folder, streams.merged(found))
    _save_tum(folder / "lidar.tum", body.lifted(world.plan.lidar_height))
    _save_tum(folder / "base_link.tum", body)
    header = "station,x,y,z"
    np.savetxt(folder / "axis.csv", axis_rows(world.plan), fmt="%.6f", delimiter=",", header=header, comments="")
    facts.write(folder, facts.truth(config, recording, outcome, topics))


def _save_tum(path: Path, poses: Poses) -> None:
    np.savetxt(path, tum_rows(poses, messages.EPOCH), fmt=_POSE_FORMAT)


@contextmanager
def _new(folder: Path) -> Iterator[Path]:
    """A folder that appears under its name once all is in it, and not at all where something fails."""
    partial = folder.with_name(f".{folder.name}.partial") / folder.name
    try:
        shutil.rmtree(partial.parent, ignore_errors=True)
        partial.parent.mkdir(parents=True)
        yield partial
        partial.rename(folder)
    except OSError as error:
        raise RecordingError(f"{folder}: cannot be written ({error.strerror})") from error
    finally:
        shutil.rmtree(partial.parent, ignore_errors=True)
