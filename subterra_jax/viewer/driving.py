"""Drive an episode for the viewer, a piece at a time, so that the first picture does not wait for the last step."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from subterra_jax.baselines.agent import Agent
from subterra_jax.lidar3d.beams import level_ring
from subterra_jax.lidar3d.space import into_tunnel, turned
from subterra_jax.parts.obstacles import PITCH
from subterra_jax.recorder.trace import Trace
from subterra_jax.recorder.trace import drive as drive_trace
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel_env import TunnelEnv
from subterra_jax.viewer.recording import Recording

_POINTS = 2048  # points of a scan that are kept: a browser without a GPU shows them


def drive(env: TunnelEnv, params: EnvParams, agent: Agent, seed: int, names: dict[str, str]) -> Iterator[Recording]:
    """Drive an episode to its end; see `recorder.trace.drive`.

    Where the task has faults, their severity is drawn by the environment and is not that of the listed episode.

    Args:
        env: The environment.
        params: The task, in one tunnel.
        agent: The agent that drives.
        seed: Seed of the episode.
        names: `tunnel`, `tunnel_sha256`, `lining` and `agent` as the recording is to hold them.

    Yields:
        The recording so far: first the start alone, at last the whole.
    """
    recording: Recording | None = None
    done = 0
    for trace in drive_trace(env, params, agent, seed):
        rows = {name: values.astype(np.float32) for name, values in _series(trace, done, env, params).items()}
        if recording is None:
            whole: dict[str, Any] = {**_facts(trace, env, params), **names, **rows}
            recording = Recording(seed=float(seed), success=0.0, contact=0.0, **whole)
        else:
            recording = recording.extend(rows, float(trace.success), float(trace.contact))
        done = len(trace) + 1
        yield recording


def _facts(trace: Trace, env: TunnelEnv, params: EnvParams) -> dict[str, Any]:
    """Return what the start of an episode says of the whole."""
    first = {name: float(trace.observation[0, where.start]) for name, where in env.fields(params).items()}
    return {
        "task": env.id,
        "period": trace.period,
        "radius": float(params.vehicle.radius),
        "range_max": float(params.lidar.range_max),
        "length": float(params.tunnel.length),
        "start": first.get("start", float(params.start.station)),
        "goal": first.get("goal", np.nan),
        "boxes": _boxes(env, jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), trace.state), params),
    }


def _series(trace: Trace, done: int, env: TunnelEnv, params: EnvParams) -> dict[str, Any]:
    fields, rows, before = env.fields(params), slice(done, None), slice(max(done - 1, 0), None)
    obs, state, pose = trace.observation[rows], trace.state, trace.pose[rows]
    action, reward, coverage, command = (
        values[before] for values in (trace.action, trace.reward, trace.coverage, trace.command)
    )
    station, log_sigma = action[:, 2], np.clip(action[:, 3], -5.0, 5.0)
    estimate = np.stack([station, np.where(np.isnan(station), np.nan, np.exp(log_sigma))], axis=-1)
    if done == 0:  # nothing led to the first row
        command, estimate = np.vstack([np.zeros((1, 2)), command]), np.vstack([np.full((1, 2), np.nan), estimate])
        reward, coverage = np.append(0.0, reward), np.append(state.station[0] / params.tunnel.length, coverage)
    return {
        "position": state.position[rows],
        "heading": state.heading[rows],
        "station": state.station[rows],
        "odometry": obs[:, fields["odometry"]],
        "ranges": obs[:, fields["ranges"]]
        if "ranges" in fields
        else level_ring(obs[:, fields["scan"]], params.lidar.shape),
        "points": _points(trace, rows, fields, params),
        "command": command,
        "estimate": estimate,
        "reward": reward,
        "coverage": coverage,
        "cloud": trace.cloud[rows],
        "trunk": pose[:, -1, 2] if pose.shape[1] else np.zeros(len(obs)),
        "pose": pose[..., 3:],
    }


def _points(trace: Trace, rows: slice, fields: dict[str, slice], params: EnvParams) -> Float[np.ndarray, "n p 3"]:
    """Return about `_POINTS` returns of a LiDAR in three dimensions, robot's frame, m; none of a planar one."""
    obs = trace.observation[rows]
    if "scan" not in fields:
        return np.zeros((len(obs), 0, 3))
    sensor = params.lidar
    stride = max(1, -(-sensor.n_beams // _POINTS))
    ranges = obs[:, fields["scan"]][:, ::stride, None]
    level: Any = tuple(tuple(axis) for axis in jnp.eye(3))
    points = ranges * np.asarray(into_tunnel(turned(level, sensor.mount), sensor.directions[::stride]))
    points = points + np.array([0.0, float(sensor.mount.lateral), 0.0])
    if trace.pose.shape[1]:
        points = _from_trunk(points, trace.state, rows, params)
    else:
        points = points + np.array([0.0, 0.0, float(sensor.mount.height)])
    return np.where((ranges > 0.0) & (ranges < float(sensor.range_max)), points, np.nan)


def _from_trunk(
    points: Float[np.ndarray, "n p 3"], state: State, rows: slice, params: EnvParams
) -> Float[np.ndarray, "n p 3"]:
    """Return points of a trunk's LiDAR, which leans with it, in the robot's level frame, from the ground, m."""
    from subterra_jax.b2.constants import LIDAR  # MuJoCo is loaded only where a robot walks

    qpos, heading = state.legs.walk.body.qpos[rows], np.asarray(state.heading[rows], np.float64)
    lean = Rotation.from_euler("z", -heading) * Rotation.from_quat(qpos[:, [4, 5, 6, 3]])
    height = (qpos[:, 2] + float(params.walk.track.protrusion))[:, None, None]
    return (points + np.array(LIDAR)) @ lean.as_matrix().transpose(0, 2, 1) + height * np.array([0.0, 0.0, 1.0])


def _boxes(env: TunnelEnv, state: State, params: EnvParams) -> Float[np.ndarray, "n 6"]:
    """Return all obstacles of an episode: middle, unit vector along the first side, half sides, m."""
    stations = jnp.arange(0.0, float(params.tunnel.length) + PITCH, PITCH)
    rows = [np.zeros((0, 6), np.float32)]
    for boxes in jax.device_get(jax.vmap(lambda s: env.boxes(state.replace(station=s), params))(stations)):
        row = np.concatenate([boxes.centre, boxes.axis, boxes.half], axis=-1).reshape(-1, 6)
        rows.append(np.unique(row[np.abs(row[:, 0]) < 1e5], axis=0).astype(np.float32))
    return np.concatenate(rows)
