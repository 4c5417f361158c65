"""Drive an agent through episodes: for evaluation, recorder, viewer and the walking robot alike.

An episode depends on its seed, tunnel and level alone. Its key is split into one of the environment and one of the
agent; step t uses each folded with t, counted from 1; 0 is the start. So a seed gives the same episode to everyone.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from subterra_jax.baselines.agent import Agent, Observed, observed, shown
from subterra_jax.compiled import in_32_bits
from subterra_jax.env import Info
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel_env import TunnelEnv


@struct.dataclass
class Episode:
    """One episode under way."""

    env_key: PRNGKeyArray  # key of the environment
    agent_key: PRNGKeyArray  # key of the agent
    tunnel: Int[Array, ""]  # number of the tunnel in a stack
    level: Int[Array, ""]  # level of difficulty
    state: State  # state of the environment
    noise: Any  # random numbers of the scan to be taken next
    memory: Any  # memory of the agent
    tally: Any  # what the caller counts
    over: Bool[Array, ""]  # the environment has ended the episode


@struct.dataclass
class Taken:
    """One step taken, as those who count or record see it."""

    before: State  # state before
    observation: Float[Array, n_obs]  # observation that the agent acted on
    # action as the agent gave it: speed (m/s), yaw rate (rad/s), estimated station (m; NaN for none), log of its
    # standard deviation, direction
    action: Float[Array, 5]
    memory: Any  # memory of the agent afterwards
    after: State  # state afterwards
    noise: Any  # random numbers of the step, for the scan of `after`
    reward: Float[Array, ""]  # reward
    terminated: Bool[Array, ""]  # the episode ended for good
    truncated: Bool[Array, ""]  # the episode ended at the horizon
    info: Info  # the step's info


Start = Callable[[State, EnvParams], Any]
Add = Callable[[Episode, Taken, EnvParams], tuple[Any, Array]]
Keep = Callable[[Episode, Taken, EnvParams], Any]


@dataclasses.dataclass(frozen=True)
class Driver:
    """Drives an agent through episodes of one task. Static: jit knows its functions, which must be module-level."""

    env: TunnelEnv  # the environment; its action holds the estimate where the caller wants it scored
    # makes the tally of an episode, from the first state and the params of its tunnel and level
    start: Start = lambda state, params: ()
    # from an episode, a step taken and those params to the tally and to whether the episode is over
    add: Add = lambda now, taken, params: (now.tally, taken.terminated | taken.truncated)
    keep: Keep = lambda now, taken, params: ()  # from the same to what is kept of the step

    @in_32_bits()
    def begin(self, params: EnvParams, agent: Agent, seed: Any, tunnel: Any = 0, level: Any = None) -> Episode:
        """Begin one episode, or one for each of an array of seeds.

        Args:
            seed: Seed of everything random, `()` or `(n,)`.
            tunnel: Number of the tunnel in a stack, of the same shape.
            level: Level of difficulty, of the same shape; None to let the episode draw it.
        """
        seed = jnp.asarray(seed, jnp.uint32)
        whole = lambda value: jnp.broadcast_to(jnp.asarray(value, jnp.int32), seed.shape)  # noqa: E731
        return _begin(self, agent, params, seed, whole(tunnel), whole(-1 if level is None else level))

    @in_32_bits()
    def go(self, params: EnvParams, agent: Agent, now: Episode, first: int, n_steps: int) -> tuple[Episode, Any]:
        """Take `n_steps` steps after step `first`; steps after an episode's end leave it as it is.

        Returns:
            The episodes, and what `keep` kept, the steps as first axis (rows after an episode's end mean nothing).
        """
        return _go(self, n_steps, agent, params, jnp.int32(first), now)

    @in_32_bits()
    def bytes_needed(self, params: EnvParams, agent: Agent, n: int, n_steps: int) -> int:
        """Return the bytes that `begin` and `go` take for `n` episodes at once, as compiled, beside params and agent.

        What is compiled here is not compiled again by `begin` and `go` of as many episodes and steps. 0 where the
        device does not tell.
        """
        seed, whole = jax.ShapeDtypeStruct((n,), jnp.uint32), jax.ShapeDtypeStruct((n,), jnp.int32)
        begin = _begin.lower(self, agent, params, seed, whole, whole)
        first = jax.ShapeDtypeStruct((), jnp.int32)
        gone = _go.lower(self, n_steps, agent, params, first, begin.out_info)
        found = (program.compile().memory_analysis() for program in (begin, gone))
        return max(int(one.temp_size_in_bytes + one.output_size_in_bytes) if one else 0 for one in found)

    def drive(
        self, params: EnvParams, agent: Agent, now: Episode, chunk: int, limit: int | None = None
    ) -> Iterator[tuple[Episode, Any]]:
        """Drive until all episodes are over, or for `limit` steps (the horizon if None), `chunk` steps at a time."""
        limit = int(params.horizon) if limit is None else min(limit, int(params.horizon))
        for first in range(0, limit, chunk):
            now, rows = self.go(params, agent, now, first, chunk)
            yield now, rows
            if bool(jnp.all(now.over)):
                return


@in_32_bits()
def ask(
    env: TunnelEnv, agent: Agent, key: PRNGKeyArray, memory: Any, obs: Observed, state: State, here: EnvParams
) -> tuple[Float[Array, 5], Any]:
    """Ask an agent for an action; it gets only the inputs that it declares.

    Args:
        state: The true state, of which only a privileged agent is given.
        here: The task in the tunnel that the robot is in.
    """
    known = env.privileged(state, here) if agent.privileged else None
    return agent.act(key, memory, obs, shown(here, agent.uses_map), known)


def look(env: TunnelEnv, agent: Agent, params: EnvParams, flat: Float[Array, n_obs]) -> Observed:
    """Take an observation apart for an agent; without `uses_lidar` it gets no ranges."""
    return observed(env, params, flat, agent.uses_lidar)


def in_tunnel(env: TunnelEnv, params: EnvParams, tunnel: Any, level: Any = None) -> EnvParams:
    """Return the params of one tunnel of a stack, and of one level where that is not negative."""
    params = env.motion.in_tunnel(params, tunnel)
    if level is None:
        return params

    def choose(one: Array, whole: Array) -> Array:
        # Leaves that no level changes stay shared by the batch. A level below 0 leaves the range of levels as it is.
        return whole if one is whole else jnp.where(level < 0, whole, one).astype(jnp.result_type(whole))

    return jax.tree.map(choose, env.at_level(params, level), params)


@functools.partial(jax.jit, static_argnums=0)
def _begin(driver: Driver, agent: Agent, params: EnvParams, seed: Array, tunnel: Array, level: Array) -> Episode:
    function = functools.partial(_begin_one, driver, agent, params)
    now = jax.vmap(function)(seed, tunnel, level) if seed.ndim else function(seed, tunnel, level)
    # A weakly typed leaf would have `_go` compiled twice.
    return jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype), now)


def _begin_one(driver: Driver, agent: Agent, params: EnvParams, seed: Array, tunnel: Array, level: Array) -> Episode:
    env, here = driver.env, in_tunnel(driver.env, params, tunnel, level)
    env_key, agent_key = jax.random.split(jax.random.key(seed))
    start_key, scan_key = jax.random.split(jax.random.fold_in(env_key, 0))
    state = env.begin(env.draw_reset(start_key, (), here), here)
    noise = env.draw_step(scan_key, (), here)
    obs = look(env, agent, here, env.observe(state, noise, here))
    memory = agent.begin(jax.random.fold_in(agent_key, 0), obs, shown(here, agent.uses_map))
    over = jnp.zeros((), bool)
    return Episode(env_key, agent_key, tunnel, level, state, noise, memory, driver.start(state, here), over)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _go(
    driver: Driver, n_steps: int, agent: Agent, params: EnvParams, first: Int[Array, ""], now: Episode
) -> tuple[Episode, Any]:
    one = functools.partial(_step_one, driver, agent, params)

    def step(now: Episode, t: Int[Array, ""]) -> tuple[Episode, Any]:
        return (jax.vmap(one, (0, None)) if now.over.ndim else one)(now, t)

    return jax.lax.scan(step, now, first + jnp.arange(1, n_steps + 1, dtype=jnp.int32))


def _step_one(driver: Driver, agent: Agent, params: EnvParams, now: Episode, t: Array) -> tuple[Episode, Any]:
    env, here = driver.env, in_tunnel(driver.env, params, now.tunnel, now.level)
    flat = env.observe(now.state, now.noise, here)
    action, memory = ask(
        env, agent, jax.random.fold_in(now.agent_key, t), now.memory, look(env, agent, here, flat), now.state, here
    )
    noise = env.draw_step(jax.random.fold_in(now.env_key, t), (), here)
    state, reward, terminated, truncated, info = env.advance(now.state, action[: env.action_size], noise, here)
    taken = Taken(now.state, flat, action, memory, state, noise, reward, terminated, truncated, info)
    tally, over = driver.add(now, taken, here)
    after = dataclasses.replace(now, state=state, noise=noise, memory=memory, tally=tally, over=now.over | over)
    kept = driver.keep(now, taken, here)
    return jax.tree.map(functools.partial(_unless, now.over), now, after), kept


def _unless(over: Bool[Array, ""], old: Array, new: Array) -> Array:
    return jnp.where(over, old, new)
