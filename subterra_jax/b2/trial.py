"""Many B2s on their way at once, each drawn anew, and what came of them."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.b2.hierarchy import MissionEnv
from subterra_jax.b2.mission import MissionParams
from subterra_jax.baselines.agent import Agent, observed, shown

_CHUNK = 25  # steps from one look at whether anybody is still on the way to the next


@struct.dataclass
class Walk:
    """One robot on its way.

    Attributes:
        state: Of the environment.
        noise: Of the scan not yet taken.
        memory: Of the agent.
        over: Whether it has arrived or failed.
        success: Whether it has arrived.
        contact: Whether it touched a wall.
        fall: Whether it fell.
        steps: It has taken.
    """

    state: Any
    noise: Any
    memory: Any
    over: Bool[Array, "*n"]
    success: Bool[Array, "*n"]
    contact: Bool[Array, "*n"]
    fall: Bool[Array, "*n"]
    steps: Int[Array, "*n"]


def drive(
    env: MissionEnv,
    params: MissionParams,
    agent: Agent,
    n_robots: int,
    seed: int = 0,
    watch: Callable[[Walk], None] | None = None,
) -> tuple[Walk, Float[np.ndarray, "n"]]:
    """Lets robots walk until all have arrived or failed.

    Args:
        env: The task.
        params: Its params.
        agent: Who steers.
        n_robots: How many.
        seed: Of all that is drawn.
        watch: Called now and then with how they are.

    Returns:
        The robots at their ends, and all lateral offsets on the way, m.
    """
    now = _begin(env, n_robots, params, agent, jnp.int32(seed))
    key, offsets = jax.random.key(seed + 1), []
    for first in range(0, int(params.horizon), _CHUNK):
        now, lateral = _onward(env, params, agent, jax.random.split(jax.random.fold_in(key, first), _CHUNK), now)
        offsets.append(np.asarray(lateral).ravel())
        if watch is not None:
            watch(jax.device_get(now))
        if np.asarray(now.over).all():
            break
    found = np.concatenate(offsets)
    return jax.device_get(now), found[~np.isnan(found)]


def figures(now: Walk, lateral: Float[np.ndarray, "n"], params: MissionParams) -> dict[str, float]:
    """What came of it: percentages of robots, of the tunnel and of the way, speed (m/s) and offset (m)."""
    begun, period, length = (float(np.asarray(x)) for x in (
        params.start.station, params.vehicle.period, params.tunnel.length
    ))  # fmt: skip
    walked = np.asarray(now.state.station) - begun
    error = (np.asarray(now.state.odometry.distance) - walked) / np.maximum(walked, 1.0)
    share = 100.0 / len(now.over)
    return {
        "robots": float(len(now.over)),
        "success_percent": share * float(np.sum(now.success)),
        "fall_percent": share * float(np.sum(now.fall)),
        "contact_percent": share * float(np.sum(now.contact)),
        "coverage_median_percent": 100.0 * float(np.median(now.state.furthest)) / length,
        "speed_mean": float(np.mean(walked / (np.asarray(now.steps) * period))),
        "lateral_rms": float(np.sqrt(np.mean(np.square(lateral)))),
        "odometer_error_percent": 100.0 * float(np.mean(error)),
        "odometer_error_sigma_percent": 100.0 * float(np.std(error)),
    }


@functools.partial(jax.jit, static_argnums=(0, 1))
def _begin(env: MissionEnv, n_robots: int, params: MissionParams, agent: Agent, seed: Int[Array, ""]) -> Walk:
    """All robots at the start."""
    no, sees_map = jnp.zeros((), bool), agent.uses_map

    def one(key: Array) -> Walk:
        start_key, scan_key = jax.random.split(key)
        state = env.begin(env.draw_reset(start_key, (), params), params)
        noise = env.draw_step(scan_key, (), params)
        obs = observed(env, params, env.observe(state, noise, params), agent.uses_lidar)
        memory = agent.begin(key, obs, shown(params, sees_map))
        return Walk(state, noise, memory, no, no, no, no, jnp.zeros((), jnp.int32))

    begun = jax.vmap(one)(jax.random.split(jax.random.key(seed), n_robots))
    # A weakly typed leaf would have `_onward` compiled twice.
    return jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype), begun)


@functools.partial(jax.jit, static_argnums=0)
def _onward(
    env: MissionEnv, params: MissionParams, agent: Agent, keys: Array, now: Walk
) -> tuple[Walk, Float[Array, "t n"]]:
    """All robots as many steps later as there are keys, and their lateral offsets on the way; NaN once over."""

    def one(key: Array, now: Walk) -> Walk:
        agent_key, env_key = jax.random.split(key)
        obs = observed(env, params, env.observe(now.state, now.noise, params), agent.uses_lidar)
        known = env.privileged(now.state, params) if agent.privileged else None
        action, memory = agent.act(agent_key, now.memory, obs, shown(params, agent.uses_map), known)
        noise = env.draw_step(env_key, (), params)
        state, _, terminated, truncated, info = env.advance(now.state, action[: env.action_size], noise, params)
        flags = (terminated | truncated, info["success"], info["contact"], info["fall"])
        after = Walk(state, noise, memory, *flags, steps=now.steps + 1)
        return jax.tree.map(lambda new, old: jnp.where(now.over, old, new), after, now)

    def step(now: Walk, key: Array) -> tuple[Walk, Array]:
        after = jax.vmap(one)(jax.random.split(key, now.over.shape[0]), now)
        return after, jnp.where(now.over, jnp.nan, after.state.lateral)

    return jax.lax.scan(step, now, keys)
