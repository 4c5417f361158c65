"""Drive an episode for the viewer, a piece at a time, so that the first picture does not wait for the last step."""

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from subterra_jax.baselines.agent import Agent
from subterra_jax.baselines.cloud import Cloud
from subterra_jax.episode import Driver, Episode, Taken
from subterra_jax.lidar3d.beams import level_ring
from subterra_jax.lidar3d.space import into_tunnel, turned
from subterra_jax.parts.obstacles import PITCH
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel_env import TunnelEnv
from subterra_jax.viewer.recording import N_POSE, Recording


class Gait:
    """Collects the poses of a walking robot as MuJoCo moves it; none for a wheeled one.

    Args:
        env: The environment; legs must be simulated by MuJoCo itself.

    Attributes:
        walks: Whether the robot has legs.
    """

    def __init__(self, env: TunnelEnv):
        walk: Any = getattr(env.motion, "walk", None)
        self.walks = walk is not None
        self._poses: list[np.ndarray] = []
        if walk is not None:
            walk.physics.bench.watch = lambda data, origin: self._poses.append(data.qpos[3:19].astype(np.float32))

    def standing(self) -> Float[np.ndarray, "m 16"]:
        """Return the poses before the first step."""
        if not self.walks:
            return np.zeros((0, N_POSE), np.float32)
        from subterra_jax.b2.kinematics import standing_pose
        from subterra_jax.b2.mission import PERIODS

        pose = np.concatenate([[1.0, 0.0, 0.0, 0.0], np.asarray(standing_pose()[0], np.float64)])
        return np.tile(pose.astype(np.float32), (PERIODS, 1))

    def take(self, n_rows: int) -> Float[np.ndarray, "n_rows m 16"]:
        """Return the poses since the last call, in `n_rows` rows."""
        poses, self._poses = self._poses, []
        return np.array(poses, np.float32).reshape(n_rows, -1, N_POSE) if poses else np.zeros((n_rows, 0, N_POSE), "f4")


_CHUNK, _FEW = 100, 5  # steps between two pieces: of a robot on wheels, of one on legs
_POINTS = 2048  # points of a scan that are kept: a browser without a GPU shows them
_PARTICLES = 96  # particles that are kept: enough to show the shape of a cloud


def drive(env: TunnelEnv, params: EnvParams, agent: Agent, seed: int, names: dict[str, str]) -> Iterator[Recording]:
    """Drive an episode to its end: the one that `evaluation.evaluate` drives for the same seed.

    Where the task has faults, their severity is drawn by the environment and is not that of the listed episode.

    Args:
        env: The environment; it need not have been made with `estimates`.
        params: The task, in one tunnel.
        agent: The agent that drives.
        seed: Seed of the episode.
        names: `tunnel`, `tunnel_sha256`, `lining` and `agent` as the recording is to hold them.

    Yields:
        The recording so far: first the start alone, at last the whole.
    """
    env, gait = dataclasses.replace(env, estimates=True), Gait(env)
    driver = Driver(env, keep=_Rows(env).keep)
    now = driver.begin(params, agent, seed)
    first = jax.device_get(_first_row(driver, params, now))
    first["pose"] = gait.standing()
    recording = _start_recording(env, params, now, seed, names, first)
    yield recording
    chunk = _FEW if gait.walks else _CHUNK
    step = 0
    for _, kept in driver.drive(params, agent, now, chunk):
        rows = jax.device_get(kept)
        rows["pose"] = gait.take(chunk)
        n = min(int(np.argmax(rows["over"])) + 1 if rows["over"].any() else chunk, int(params.horizon) - step)
        success, contact = (float(rows[name][n - 1]) for name in ("success", "contact"))
        series = {name: values[:n] for name, values in rows.items() if name not in ("over", "success", "contact")}
        recording = recording.extend(series, success, contact)
        yield recording
        step += chunk


@dataclasses.dataclass(frozen=True)
class _Rows:
    """Rows of a recording; hashable, so that two episodes of one task share their compiled program."""

    env: TunnelEnv

    def keep(self, now: Episode, taken: Taken, params: EnvParams) -> dict[str, Array]:
        """Keep the state after a step and the observation made in it."""
        del now
        obs = self.env.observe(taken.after, taken.noise, params)
        row = self.row(taken.after, obs, taken.action, taken.memory, taken.reward, taken.info["coverage"], params)
        ends = {"success": taken.info["success"], "contact": taken.info["contact"]}
        return {**row, "over": taken.terminated | taken.truncated, **ends}

    def row(
        self, state: State, obs: Array, action: Array, memory: Any, reward: Array, coverage: Array, params: EnvParams
    ) -> dict[str, Array]:
        """Return one row of every series."""
        fields, station = self.env.fields(params), action[2]
        sigma = jnp.where(jnp.isnan(station), jnp.nan, jnp.exp(jnp.clip(action[3], -5.0, 5.0)))
        return {
            "position": state.position,
            "heading": state.heading,
            "station": state.station,
            "odometry": obs[fields["odometry"]],
            "ranges": _level_ranges(obs, fields, params),
            "points": _points(obs, fields, params, state),
            "command": state.command,
            "estimate": jnp.stack([station, sigma]),
            "reward": reward,
            "coverage": coverage,
            "cloud": _particles(memory),
            "trunk": self.env.motion.height(state, params),
        }


def _level_ranges(obs: Array, fields: dict[str, slice], params: EnvParams) -> Array:
    """Return the planar scan, or the level ring of one in three dimensions, m."""
    return obs[fields["ranges"]] if "ranges" in fields else level_ring(obs[fields["scan"]], params.lidar.shape)


def _points(obs: Array, fields: dict[str, slice], params: EnvParams, state: State) -> Array:
    """Return about `_POINTS` returns of a LiDAR in three dimensions, robot's frame, m; none of a planar one."""
    if "scan" not in fields:
        return jnp.zeros((0, 3))
    sensor = params.lidar
    stride = max(1, -(-sensor.n_beams // _POINTS))
    ranges, beams = obs[fields["scan"]][::stride], sensor.directions[::stride]
    seen = (ranges > 0.0) & (ranges < sensor.range_max)
    axes = turned(tuple(tuple(axis) for axis in jnp.eye(3)), sensor.mount)  # type: ignore[arg-type]
    points = into_tunnel(axes, beams * ranges[:, None])
    if "legs" in state.parts:
        points = _from_trunk(points, state, params)
    else:
        points = points + jnp.stack([0.0, sensor.mount.lateral, sensor.mount.height])
    return jnp.where(seen[:, None], points, jnp.nan)


def _from_trunk(points: Array, state: State, params: EnvParams) -> Array:
    """Return points of a trunk's LiDAR, which leans with it, in the robot's level frame, from the ground, m."""
    from subterra_jax.b2.kinematics import rotate
    from subterra_jax.b2.mission import lidar_place

    walk = state.legs.walk
    mount, _ = lidar_place(walk, params.walk, params.lidar.mount.lateral)
    leaning = jax.vmap(rotate, (None, 0))(walk.body.qpos[3:7], points) + mount - walk.body.qpos[:3]
    cos, sin = jnp.cos(state.heading), jnp.sin(state.heading)
    x, y, z = leaning.T
    up = walk.body.qpos[2] + params.walk.track.protrusion
    return jnp.stack([cos * x + sin * y, cos * y - sin * x, z + up], axis=-1)


@functools.partial(jax.jit, static_argnums=0)
def _first_row(driver: Driver, params: EnvParams, now: Episode) -> dict[str, Array]:
    """Return the row of the start."""
    rows, state = _Rows(driver.env), now.state
    nothing = jnp.array([0.0, 0.0, jnp.nan, jnp.nan, 0.0])
    obs = driver.env.observe(state, now.noise, params)
    return rows.row(state, obs, nothing, now.memory, jnp.zeros(()), state.station / params.tunnel.length, params)


def _particles(memory: Any) -> Array:
    """Return about `_PARTICLES` of the particles in an agent's memory; none for an agent without."""
    clouds = [leaf for leaf in jax.tree.leaves(memory, is_leaf=_is_cloud) if _is_cloud(leaf)]
    if not clouds:
        return jnp.zeros((0, 3))
    cloud: Cloud = clouds[0]
    stride = max(1, cloud.log_weight.shape[0] // _PARTICLES)
    weight = jnp.exp(cloud.log_weight) * cloud.log_weight.shape[0]
    return jnp.stack([cloud.pose.station, cloud.pose.lateral, weight], axis=-1)[::stride][:_PARTICLES]


def _is_cloud(leaf: Any) -> bool:
    return isinstance(leaf, Cloud)


def _start_recording(
    env: TunnelEnv, params: EnvParams, now: Episode, seed: int, names: dict[str, str], first: dict[str, np.ndarray]
) -> Recording:
    """Return a recording of the start alone."""
    series: dict[str, Any] = {name: np.asarray(value)[None] for name, value in first.items()}
    named: dict[str, Any] = dict(names)
    fields = env.fields(params)
    obs = np.asarray(env.observe(now.state, now.noise, params))
    return Recording(
        task=env.id,
        **named,
        seed=float(seed),
        period=float(params.vehicle.period),
        radius=float(params.vehicle.radius),
        range_max=float(params.lidar.range_max),
        length=float(params.tunnel.length),
        start=float(obs[fields["start"]][0]) if "start" in fields else float(params.start.station),
        goal=float(obs[fields["goal"]][0]) if "goal" in fields else np.nan,
        success=0.0,
        contact=0.0,
        boxes=_boxes(env, now.state, params),
        **series,
    )


def _boxes(env: TunnelEnv, state: State, params: EnvParams) -> np.ndarray:
    """Return all obstacles of an episode, `(n, 6)`: middle, unit vector along the first side, half sides, m."""
    stations = jnp.arange(0.0, float(params.tunnel.length) + PITCH, PITCH)
    rows = [np.zeros((0, 6), np.float32)]
    for boxes in jax.device_get(jax.vmap(lambda s: env.boxes(state.replace(station=s), params))(stations)):
        row = np.concatenate([boxes.centre, boxes.axis, boxes.half], axis=-1).reshape(-1, 6)
        rows.append(np.unique(row[np.abs(row[:, 0]) < 1e5], axis=0).astype(np.float32))
    return np.concatenate(rows)
