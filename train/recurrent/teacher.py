"""Teachers: agents of the evaluation who are asked what they would do, whoever drives."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax.baselines import navigator
from subterra_jax.baselines.agent import Agent, shown
from subterra_jax.episode import ask, in_tunnel, look
from subterra_jax.policies import networks, senses


def blank(env: Any, agent: Agent, params: Any, n_envs: int) -> Any:
    """Memories of nothing yet; a first observation replaces them."""
    observation = jax.ShapeDtypeStruct((env.observation_size(params),), jnp.float32)
    key = jax.random.key(0)
    shape = jax.eval_shape(lambda flat: _begin(env, agent, key, flat, params), observation)
    return jax.tree.map(lambda leaf: jnp.zeros((n_envs, *leaf.shape), leaf.dtype), shape)


def advise(
    env: Any,
    agent: Agent,
    key: PRNGKeyArray,
    memory: Any,
    observation: Float[Array, "env obs"],
    state: Any,
    first: Bool[Array, "env"],
    params: Any,
) -> tuple[Float[Array, "env n_action"], Any]:
    """What a teacher would do now.

    Args:
        env: The environment.
        agent: The teacher.
        key: Source of its randomness.
        memory: What it remembers of each environment.
        observation: What it sees.
        state: The environments' state, of which it is told what its class says.
        first: The observation begins an episode.
        params: The task.

    Returns:
        Five numbers for each environment, as `Agent.act`, and what it remembers; `driven` still has to tell it what was
        done.
    """

    def one(key: PRNGKeyArray, memory: Any, flat: Array, state: Any, first: Array) -> tuple[Array, Any]:
        here = in_tunnel(env, params, state.tunnel)
        key_begin, key_act = jax.random.split(key)
        memory = _where(first, _begin(env, agent, key_begin, flat, here), memory)
        action, after = ask(env, agent, key_act, memory, look(env, agent, here, flat), state, here)
        return action, _where(jnp.ones((), bool), after, memory)

    return jax.vmap(one)(jax.random.split(key, len(first)), memory, observation, state, first)


def driven(before: Any, after: Any, action: Float[Array, "env 2"]) -> Any:
    """What a teacher remembers of a step once it has seen what was done, which need not be what it advised.

    Args:
        before: Its memory before it advised.
        after: Its memory since.
        action: What was done, m/s and rad/s.
    """
    if isinstance(after, navigator.Memory):
        # It never takes itself to have arrived: it looks again, and says again how far to go.
        mission = dataclasses.replace(after.mission, stopped=jnp.zeros_like(after.mission.stopped))
        # A robot does not back up: a speed below 0 is standing.
        driven = jnp.maximum(action, jnp.array([0.0, -jnp.inf]))
        return dataclasses.replace(after, command=driven, mission=mission)
    if isinstance(after, networks.RecurrentMemory):
        return dataclasses.replace(after, reckoning=senses.replace_action(before.reckoning, after.reckoning, action))
    return after


def _begin(env: Any, agent: Agent, key: PRNGKeyArray, flat: Float[Array, "obs"], params: Any) -> Any:
    """The memory at the start of an episode."""
    return agent.begin(key, look(env, agent, params, flat), shown(params, agent.uses_map))


def _where(condition: Bool[Array, ""], one: Any, other: Any) -> Any:
    """One of two memories, of the types of the second."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b).astype(b.dtype), one, other)
