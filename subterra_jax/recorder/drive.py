"""Drive one episode and keep every state of it.

Keys are drawn as `evaluation.harness` draws them: a listed seed gives the very episode that the leaderboard scores.
"""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from subterra_jax.baselines.agent import Agent, observed, shown
from subterra_jax.env import TunnelEnv
from subterra_jax.state import EnvParams, State, StepNoise

_CHUNK = 200  # steps from one look at whether the episode is over to the next


@struct.dataclass
class _Now:
    """An episode under way: its keys, its state, the noise of the scan to be taken, the agent's memory, its end."""

    env_key: PRNGKeyArray
    agent_key: PRNGKeyArray
    state: State
    noise: StepNoise
    memory: Any
    over: Bool[Array, ""]


@dataclasses.dataclass(frozen=True)
class Trace:
    """An episode of `n` steps, on the host; row k is what was at time k periods, from 0 to n.

    Attributes:
        state: States, each leaf with a leading axis of `n + 1`.
        observation: What the agent saw, `(n + 1, n_obs)`.
        command: Speed (m/s) and yaw rate (rad/s) obeyed from row k to row k + 1, `(n, 2)`.
        period: Control period, s.
        success: The task was achieved.
        contact: It ended at a wall or an obstacle.
    """

    state: State
    observation: Float[np.ndarray, "rows n_obs"]
    command: Float[np.ndarray, "n 2"]
    period: float
    success: bool
    contact: bool

    @property
    def time(self) -> Float[np.ndarray, " rows"]:
        """Time of each row since the start, s."""
        return np.arange(len(self.observation)) * self.period


def drive(
    env: TunnelEnv, params: EnvParams, agent: Agent, seed: int, severity: int | None = None, steps: int | None = None
) -> Trace:
    """Drive to the end of the episode, or for a number of steps.

    Args:
        env: The environment.
        params: The task in one tunnel.
        agent: Who drives.
        seed: Of everything random.
        severity: Of the faults; drawn where it is left out.
        steps: Steps at most; the task's horizon if left out.
    """
    env = dataclasses.replace(env, estimates=True)
    if severity is not None and params.faults is not None:
        level = jnp.int32(severity)
        params = _with(params, faults=_with(params.faults, severity_low=level, severity_high=level))
    now = _begin(env, agent, params, jnp.uint32(seed))
    limit = int(params.horizon) if steps is None else min(steps, int(params.horizon))
    parts = []
    for first in range(0, limit, _CHUNK):
        now, rows = _go(env, agent, params, jnp.int32(first), now)
        parts.append(jax.device_get(rows))
        if bool(now.over):
            break
    rows = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    n = min(limit, int(np.argmax(rows["over"])) + 1 if rows["over"].any() else limit)
    last = jax.device_get(_last(env, params, jax.tree.map(lambda leaf: leaf[n - 1], rows["after"])))
    return Trace(
        state=jax.tree.map(lambda before, end: np.concatenate([before[:n], end[None]]), rows["before"], last[0]),
        observation=np.concatenate([rows["observation"][:n], last[1][None]]),
        command=rows["after"][0].command[:n],
        period=round(float(params.vehicle.period), 6),  # 0.1 in float32 is not 0.1
        success=bool(rows["success"][n - 1]),
        contact=bool(rows["contact"][n - 1]),
    )


@partial(jax.jit, static_argnums=0)
def _begin(env: TunnelEnv, agent: Agent, params: EnvParams, seed: Int[Array, ""]) -> _Now:
    env_key, agent_key = jax.random.split(jax.random.key(seed))
    start_key, scan_key = jax.random.split(jax.random.fold_in(env_key, 0))
    state = env.begin(env.draw_reset(start_key, (), params), params)
    noise = env.draw_step(scan_key, (), params)
    seen = observed(env, params, env.observe(state, noise, params), agent.uses_lidar)
    memory = agent.begin(jax.random.fold_in(agent_key, 0), seen, shown(params, agent.uses_map))
    now = _Now(env_key, agent_key, state, noise, memory, jnp.zeros((), bool))
    # A weakly typed leaf would have `_go` compiled twice.
    return jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype), now)


@partial(jax.jit, static_argnums=0)
def _go(
    env: TunnelEnv, agent: Agent, params: EnvParams, first: Int[Array, ""], now: _Now
) -> tuple[_Now, dict[str, Any]]:
    """The episode `_CHUNK` steps later, and what was in each; steps after its end mean nothing."""

    def step(now: _Now, t: Int[Array, ""]) -> tuple[_Now, dict[str, Any]]:
        flat = env.observe(now.state, now.noise, params)
        seen = observed(env, params, flat, agent.uses_lidar)
        known = env.privileged(now.state, params) if agent.privileged else None
        key = jax.random.fold_in(now.agent_key, t)
        action, memory = agent.act(key, now.memory, seen, shown(params, agent.uses_map), known)
        noise = env.draw_step(jax.random.fold_in(now.env_key, t), (), params)
        state, _, terminated, truncated, info = env.advance(now.state, action[: env.action_size], noise, params)
        over = now.over | terminated | truncated
        row = {"before": now.state, "after": (state, noise), "observation": flat, "over": over}
        row |= {"success": info["success"], "contact": info["contact"]}
        return dataclasses.replace(now, state=state, noise=noise, memory=memory, over=over), row

    return jax.lax.scan(step, now, first + jnp.arange(1, _CHUNK + 1))


@partial(jax.jit, static_argnums=0)
def _last(env: TunnelEnv, params: EnvParams, after: tuple[State, StepNoise]) -> tuple[State, Float[Array, "n_obs"]]:
    """The last state and what is observed in it."""
    state, noise = after
    return state, env.observe(state, noise, params)


def _with(part: Any, **leaves: Any) -> Any:
    return dataclasses.replace(part, **leaves)
