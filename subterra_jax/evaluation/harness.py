"""Drive an agent through fixed episodes, all of them at once, and record what came of each."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Int, PRNGKeyArray

from subterra_jax.baselines.agent import Agent, Observed, observed, shown
from subterra_jax.env import TunnelEnv
from subterra_jax.evaluation.episodes import Episodes, EvaluationError
from subterra_jax.evaluation.records import Records, finished
from subterra_jax.evaluation.tally import Tally, add_step, start_tally
from subterra_jax.state import EnvParams, State, StepNoise

_CHUNK = 200  # steps from one look at whether anybody is still on the way to the next


@struct.dataclass
class _Episode:
    """One episode under way.

    Attributes:
        env_key: Key of the environment; step t uses it folded with t.
        agent_key: Key of the agent, likewise.
        tunnel: Which tunnel of a stack.
        severity: Severity of the faults.
        state: The environment's state.
        noise: Of the scan that has not been taken yet.
        memory: The agent's memory.
        tally: What has been counted.
        over: The episode is over as published; what comes after only counts as progress.
        ended: The environment has ended it.
    """

    env_key: PRNGKeyArray
    agent_key: PRNGKeyArray
    tunnel: Int[Array, ""]
    severity: Int[Array, ""]
    state: State
    noise: StepNoise
    memory: Any
    tally: Tally
    over: Bool[Array, ""]
    ended: Bool[Array, ""]


def evaluate(env: TunnelEnv, params: EnvParams, agent: Agent, episodes: Episodes, batch: int = 500) -> Records:
    """Drive episodes to their ends.

    An episode depends on its seed, its tunnel and its severity alone, neither on the others nor on `batch`. Where
    coverage is the task, the agent drives on after success to the far mouth, which `progress` alone counts.

    Args:
        env: The environment; it need not have been made with `estimates`.
        params: The task, not batched.
        agent: Who drives.
        episodes: Which, from `listed_episodes`.
        batch: Episodes driven at the same time; memory and speed alone depend on it.

    Returns:
        One record for each episode, in their order.

    Raises:
        EvaluationError: `batch` is not positive.
    """
    if batch < 1:
        raise EvaluationError(f"batch must be at least 1, got {batch}")
    env = dataclasses.replace(env, estimates=True)
    parts = []
    for first in range(0, len(episodes), batch):
        # The last batch is filled up with its last episode, or it would be compiled anew.
        rows = np.minimum(np.arange(first, first + min(batch, len(episodes))), len(episodes) - 1)
        some = Episodes(**{name: values[rows] for name, values in vars(episodes).items()})
        now = _begin(env, agent, params, some.seed, some.tunnel, some.severity)
        for step in range(0, int(params.horizon), _CHUNK):
            now = _drive(env, _CHUNK, agent, params, jnp.int32(step), now)
            if bool(jnp.all(now.ended)):
                break
        parts.append(jax.device_get(now.tally))
    tally = jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(episodes)], *parts)
    return finished(tally, episodes, jax.device_get(params))


@functools.partial(jax.jit, static_argnums=0)
def _begin(env: TunnelEnv, agent: Agent, params: EnvParams, seed: Array, tunnel: Array, severity: Array) -> _Episode:
    """Episodes at their starts."""
    now = jax.vmap(lambda *one: _begin_one(env, params, *one))(seed, tunnel, severity)
    shape = jax.eval_shape(lambda now: _remember(agent, params, now, _observe(env, agent, params, now)), now)
    now = dataclasses.replace(now, memory=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape))
    # A weakly typed leaf would have `_drive` compiled twice.
    return jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype), now)


def _begin_one(
    env: TunnelEnv, params: EnvParams, seed: Int[Array, ""], tunnel: Int[Array, ""], severity: Int[Array, ""]
) -> _Episode:
    env_key, agent_key = jax.random.split(jax.random.key(seed))
    # Steps count from 1: no draw is used twice. What is drawn is what `TunnelEnv.reset` draws.
    start_key, scan_key = jax.random.split(jax.random.fold_in(env_key, 0))
    drawn = env.draw_reset(start_key, (), params)
    if drawn.tunnel is not None:
        drawn = dataclasses.replace(drawn, tunnel=(tunnel + 0.5) / params.tunnel.count)
    state = env.begin(drawn, _severe(params, severity))
    no = jnp.zeros((), bool)
    return _Episode(
        env_key=env_key,
        agent_key=agent_key,
        tunnel=tunnel,
        severity=severity,
        state=state,
        noise=env.draw_step(scan_key, (), params),
        memory=None,
        tally=start_tally(env, state, _here(params, tunnel, severity)),
        over=no,
        ended=no,
    )


@functools.partial(jax.jit, static_argnums=(0, 1))
def _drive(
    env: TunnelEnv, n_steps: int, agent: Agent, params: EnvParams, first: Int[Array, ""], now: _Episode
) -> _Episode:
    """Episodes a number of steps later."""

    def step(now: _Episode, t: Int[Array, ""]) -> tuple[_Episode, None]:
        obs = _observe(env, agent, params, now)
        memory = jax.lax.cond(t == 1, lambda: _remember(agent, params, now, obs), lambda: now.memory)
        now = dataclasses.replace(now, memory=memory)
        return jax.vmap(lambda one, obs: _step_one(env, agent, params, t, one, obs))(now, obs), None

    return jax.lax.scan(step, now, first + jnp.arange(1, n_steps + 1))[0]


def _observe(env: TunnelEnv, agent: Agent, params: EnvParams, now: _Episode) -> Observed:
    """What the agents see."""

    def one(now: _Episode) -> Observed:
        return observed(env, params, env.observe(now.state, now.noise, params), agent.uses_lidar)

    return jax.vmap(one)(now)


def _remember(agent: Agent, params: EnvParams, now: _Episode, obs: Observed) -> Any:
    """The agents' memories at the start."""

    def one(now: _Episode, obs: Observed) -> Any:
        here = shown(_here(params, now.tunnel, now.severity), agent.uses_map)
        return agent.begin(jax.random.fold_in(now.agent_key, 0), obs, here)

    return jax.vmap(one)(now, obs)


def _step_one(
    env: TunnelEnv, agent: Agent, params: EnvParams, t: Int[Array, ""], now: _Episode, obs: Observed
) -> _Episode:
    here = _here(params, now.tunnel, now.severity)
    known = env.privileged(now.state, params) if agent.privileged else None
    action, memory = agent.act(
        jax.random.fold_in(now.agent_key, t), now.memory, obs, shown(here, agent.uses_map), known
    )
    # To the far mouth: the published end of the episode is noticed below.
    onward = _with(_severe(params, now.severity), goal_coverage=jnp.ones_like(params.goal_coverage))
    noise = env.draw_step(jax.random.fold_in(now.env_key, t), (), params)
    state, _, terminated, truncated, info = env.advance(now.state, action[: env.action_size], noise, onward)
    over = terminated | truncated
    if params.goal is None:
        info["success"] = (info["coverage"] >= params.goal_coverage) & ~info["contact"]
        over = over | info["success"]
    counted = add_step(now.tally, now.state, state, action[2:4], info, here)
    tally = jax.tree.map(lambda old, new: jnp.where(now.over, old, new), now.tally, counted)
    progress = jnp.where(now.ended, now.tally.progress, info["coverage"])
    return dataclasses.replace(
        now,
        state=state,
        noise=noise,
        memory=memory,
        tally=dataclasses.replace(tally, progress=progress),
        over=now.over | over,
        ended=now.ended | terminated | truncated,
    )


def _severe(params: EnvParams, severity: Int[Array, ""]) -> EnvParams:
    """The params with faults of one severity."""
    if params.faults is None:
        return params
    return _with(params, faults=_with(params.faults, severity_low=severity, severity_high=severity))


def _with(part: Any, **leaves: Any) -> Any:
    """A part of the params with other leaves, which may be traced."""
    return dataclasses.replace(part, **leaves)


def _here(params: EnvParams, tunnel: Int[Array, ""], severity: Int[Array, ""]) -> EnvParams:
    """The params of one episode: its tunnel, its severity."""
    return _with(_severe(params, severity), tunnel=params.tunnel.pick(tunnel))
