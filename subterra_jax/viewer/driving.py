"""Drives one episode and records it, piece by piece, so that it can be watched while it is still being driven."""

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from subterra_jax import obstacles
from subterra_jax.baselines.agent import Agent, observed, shown
from subterra_jax.baselines.particle.cloud import Cloud
from subterra_jax.env import TunnelEnv
from subterra_jax.state import EnvParams, State
from subterra_jax.viewer.gait import Gait
from subterra_jax.viewer.recording import Recording

_CHUNK, _FEW = 100, 5  # steps between two looks at whether the episode is over, of who rolls and of who walks
_PARTICLES = 96  # of a cloud, are kept: as many as tell its shape


def drive(env: TunnelEnv, params: EnvParams, agent: Agent, seed: int, names: dict[str, str]) -> Iterator[Recording]:
    """Drives an episode to its end: the one that `evaluation.evaluate` drives for the same seed.

    Where the task has faults, their severity is drawn by the environment and is not that of the listed episode.

    Args:
        env: The environment; it need not have been made with `estimates`.
        params: The task, in one tunnel.
        agent: Who drives.
        seed: Seed of the episode.
        names: `tunnel`, `tunnel_sha256`, `lining` and `agent` as the recording is to hold them.

    Yields:
        The recording so far: first the start alone, at last the whole.
    """
    env, gait = dataclasses.replace(env, estimates=True), Gait(env)
    now, first = jax.device_get(_begin(env, agent, params, jnp.uint32(seed)))
    first["pose"] = gait.standing()
    recording = _started(env, params, now[2], seed, names, first)
    yield recording
    success = contact = 0.0
    chunk = _FEW if gait.walks else _CHUNK
    for step in range(0, int(params.horizon), chunk):
        now, rows = jax.device_get(_drive(env, chunk, agent, params, jnp.int32(step), now))
        rows["pose"] = gait.taken(chunk)
        n = min(int(np.argmax(rows["over"])) + 1 if rows["over"].any() else chunk, int(params.horizon) - step)
        success, contact = (float(rows[name][n - 1]) for name in ("success", "contact"))
        over = bool(rows["over"][n - 1])
        series = {name: values[:n] for name, values in rows.items() if name not in ("over", "success", "contact")}
        recording = recording.extended(series, success, contact)
        yield recording
        if over:
            return


@functools.partial(jax.jit, static_argnums=0)
def _begin(env: TunnelEnv, agent: Agent, params: EnvParams, seed: Array) -> Any:
    """Keys, state, observation and memory at the start, and the first row of every series."""
    env_key, agent_key = jax.random.split(jax.random.key(seed))
    obs, state = env.reset(jax.random.fold_in(env_key, 0), params)
    seen = observed(env, params, obs, agent.uses_lidar)
    memory = agent.begin(jax.random.fold_in(agent_key, 0), seen, shown(params, agent.uses_map))
    nothing = jnp.array([0.0, 0.0, jnp.nan, jnp.nan, 0.0])
    row = _row(env, params, state, obs, nothing, memory, jnp.zeros(()), state.station / params.tunnel.length)
    return (jax.random.key_data(env_key), jax.random.key_data(agent_key), state, obs, memory), row


@functools.partial(jax.jit, static_argnums=(0, 1))
def _drive(env: TunnelEnv, n_steps: int, agent: Agent, params: EnvParams, first: Array, now: Any) -> Any:
    """Some steps further, and their rows; those after the end mean nothing."""
    env_key, agent_key = (jax.random.wrap_key_data(data) for data in now[:2])

    def step(carry: Any, t: Array) -> tuple[Any, dict[str, Array]]:
        state, obs, memory = carry
        known = env.privileged(state, params) if agent.privileged else None
        seen = observed(env, params, obs, agent.uses_lidar)
        here = shown(params, agent.uses_map)
        action, memory = agent.act(jax.random.fold_in(agent_key, t), memory, seen, here, known)
        key = jax.random.fold_in(env_key, t)
        obs, state, reward, terminated, truncated, info = env.step(key, state, action[: env.action_size], params)
        row = _row(env, params, state, obs, action, memory, reward, info["coverage"])
        ends = {"over": terminated | truncated, "success": info["success"], "contact": info["contact"]}
        return (state, obs, memory), {**row, **ends}

    carry, rows = jax.lax.scan(step, now[2:], first + jnp.arange(1, n_steps + 1))
    return (*now[:2], *carry), rows


def _row(
    env: TunnelEnv, params: EnvParams, state: State, obs: Array, action: Array, memory: Any, reward: Array, cover: Array
) -> dict[str, Array]:
    """One row of every series."""
    parts = env.fields(params)
    return {
        "position": state.position,
        "heading": state.heading,
        "station": state.station,
        "odometry": obs[parts["odometry"]],
        "ranges": obs[parts["ranges"]],
        "command": state.command,
        "estimate": jnp.stack(
            [action[2], jnp.where(jnp.isnan(action[2]), jnp.nan, jnp.exp(jnp.clip(action[3], -5.0, 5.0)))]
        ),
        "reward": reward,
        "coverage": cover,
        "cloud": _particles(memory),
        "trunk": _trunk(state, params),
    }


def _trunk(state: State, params: EnvParams) -> Array:
    """Height of the trunk of who walks, m; 0 of who rolls."""
    walk: Any = getattr(state, "walk", None)
    if walk is None:
        return jnp.zeros(())
    track = params.walk.track  # type: ignore[attr-defined]  # of `MissionParams`
    return track.position[walk.anchor, 2] + walk.body.qpos[2]


def _particles(memory: Any) -> Array:
    """Particles in an agent's memory, every so many; none of an agent without."""
    found = [leaf for leaf in jax.tree.leaves(memory, is_leaf=_is_cloud) if _is_cloud(leaf)]
    if not found:
        return jnp.zeros((0, 3))
    cloud: Cloud = found[0]
    stride = max(1, cloud.log_weight.shape[0] // _PARTICLES)
    weight = jnp.exp(cloud.log_weight) * cloud.log_weight.shape[0]
    return jnp.stack([cloud.place.station, cloud.place.lateral, weight], axis=-1)[::stride][:_PARTICLES]


def _is_cloud(leaf: Any) -> bool:
    return isinstance(leaf, Cloud)


def _started(
    env: TunnelEnv, params: EnvParams, state: State, seed: int, names: dict[str, str], first: dict[str, np.ndarray]
) -> Recording:
    """A recording of the start alone."""
    series: dict[str, Any] = {name: np.asarray(value)[None] for name, value in first.items()}
    named: dict[str, Any] = dict(names)
    has_goal = state.goal is not None and "goal" in env.fields(params)
    return Recording(
        task=env.id,
        **named,
        seed=float(seed),
        period=float(params.vehicle.period),
        radius=float(params.vehicle.radius),
        range_max=float(params.lidar.range_max),
        length=float(params.tunnel.length),
        start=float(params.start.station),
        goal=float(state.goal.station) if has_goal and state.goal is not None else np.nan,
        success=0.0,
        contact=0.0,
        boxes=_boxes(params, state),
        **series,
    )


def _boxes(params: EnvParams, state: State) -> np.ndarray:
    """All obstacles of an episode."""
    if params.obstacles is None or state.obstacles is None:
        return np.zeros((0, 6), np.float32)
    slots = jnp.arange(int(float(params.tunnel.length) // obstacles.PITCH) + 1)
    boxes = jax.device_get(obstacles.boxes_in(jnp.asarray(state.obstacles), slots, params.tunnel, params.obstacles))
    there = np.abs(boxes.centre[:, 0]) < 1e5
    return np.concatenate([boxes.centre, boxes.axis, boxes.half], axis=1)[there].astype(np.float32)
