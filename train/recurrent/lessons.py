"""One unroll of every environment, some driven by the teacher and some by the student, with the teacher's advice."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax.baselines import navigator
from subterra_jax.baselines.agent import Agent, shown
from subterra_jax.episode import ask, in_tunnel, look
from subterra_jax.policies import senses
from subterra_jax.policies.networks import RecurrentMemory
from train.recurrent import drive as driving
from train.recurrent.network import Kept, RecurrentNetworks, Weights
from train.report import Finished


def blank(env: Any, agent: Agent, params: Any, n_envs: int) -> Any:
    """Returns empty memories; a first observation replaces them."""
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
    """Asks a teacher for its action.

    Args:
        env: The environment.
        agent: The teacher.
        key: Source of its randomness.
        memory: Its memory of each environment.
        observation: Its observation.
        state: The environments' state; a privileged teacher is told the truth.
        first: The observation begins an episode.
        params: The task.

    Returns:
        Five numbers for each environment, as `Agent.act`, and its memory, to which `note_action` must add the action.
    """

    def one(key: PRNGKeyArray, memory: Any, flat: Array, state: Any, first: Array) -> tuple[Array, Any]:
        here = in_tunnel(env, params, state.tunnel)
        key_begin, key_act = jax.random.split(key)
        memory = _where(first, _begin(env, agent, key_begin, flat, here), memory)
        action, after = ask(env, agent, key_act, memory, look(env, agent, here, flat), state, here)
        return action, _where(jnp.ones((), bool), after, memory)

    return jax.vmap(one)(jax.random.split(key, len(first)), memory, observation, state, first)


def correct_memory(before: Any, after: Any, action: Float[Array, "env 2"]) -> Any:
    """Corrects a teacher's memory of a step by the action that was taken, which need not be the one it advised.

    Args:
        before: Its memory before it advised.
        after: Its memory since.
        action: Action taken, m/s and rad/s.
    """
    if isinstance(after, navigator.Memory):
        # It never takes itself to have arrived: it looks again, and says again how far to go.
        mission = dataclasses.replace(after.mission, stopped=jnp.zeros_like(after.mission.stopped))
        # A robot does not back up: a speed below 0 is standing.
        driven = jnp.maximum(action, jnp.array([0.0, -jnp.inf]))
        return dataclasses.replace(after, command=driven, mission=mission)
    if isinstance(after, RecurrentMemory):
        return dataclasses.replace(after, reckoning=senses.replace_action(before.reckoning, after.reckoning, action))
    return after


def _begin(env: Any, agent: Agent, key: PRNGKeyArray, flat: Float[Array, "obs"], params: Any) -> Any:
    """Returns the memory at the start of an episode."""
    return agent.begin(key, look(env, agent, params, flat), shown(params, agent.uses_map))


def _where(condition: Bool[Array, ""], one: Any, other: Any) -> Any:
    """Returns one of two memories, in the types of the second."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b).astype(b.dtype), one, other)


@struct.dataclass
class Classroom:
    """State of the environments between two unrolls.

    Attributes:
        student: As in training by reward.
        teacher: The teacher's memory of each environment.
        taught: The teacher drives this episode.
    """

    student: driving.Drive
    teacher: Any
    taught: Bool[Array, "env"]


@struct.dataclass
class Advised:
    """Storage of one unroll, `(time, env, …)`.

    Attributes:
        features: Inputs of the network.
        first: The episode begins with this step.
        ahead: Goal less tracked distance, m.
        error: True less tracked distance, m.
        advice: The teacher's action, m/s and rad/s.
    """

    features: Kept
    first: Bool[Array, "time env"]
    ahead: Float[Array, "time env"]
    error: Float[Array, "time env"]
    advice: Float[Array, "time env 2"]


def begin(env: Any, agent: Agent, params: Any, student: driving.Drive) -> Classroom:
    """Starts an episode in every environment, all driven by the teacher."""
    n_envs = len(student.first)
    return Classroom(student, blank(env, agent, params, n_envs), jnp.ones(n_envs, bool))


def collect(
    env: Any,
    params: Any,
    agent: Agent,
    networks: RecurrentNetworks,
    weights: dict[str, Weights],
    drive: Classroom,
    key: PRNGKeyArray,
    n_steps: int,
    taught: Float[Array, ""],
) -> tuple[Classroom, Advised, Finished, dict[str, Float[Array, ""]]]:
    """Drives `n_steps` control periods; the student without exploration noise.

    Args:
        env: Batched environments that reset themselves.
        params: Their parameters.
        agent: The teacher.
        networks: The student's.
        weights: The student's.
        drive: State of the environments.
        key: For environments, teacher, and who drives the next episode.
        n_steps: Length of the unroll.
        taught: Share of the episodes that begin now which the teacher drives.

    Returns:
        State of the environments afterwards, the stored unroll, the student's episodes that ended in it, and means per
        step: the reward, and how far off estimate, ring tracker and dead reckoning are (m).
    """
    low, high = jnp.asarray(networks.layout.action_low), jnp.asarray(networks.layout.action_high)

    def step(now: Classroom, key_now: PRNGKeyArray) -> tuple[Classroom, tuple[Advised, Finished, dict[str, Array]]]:
        key_teacher, key_env, key_who = jax.random.split(key_now, 3)
        student, state = now.student, now.student.env_state
        forward = driving.think(env, params, networks, weights, student)
        view, thought = forward.view, forward.thought
        advice, memory = advise(
            env.env, agent, key_teacher, now.teacher, student.observation, state, student.first, params
        )
        advice = jnp.clip(advice[:, : networks.n_action], low, high)
        own = networks.action(thought.parameters[:, : networks.n_action])
        action = jnp.where(now.taught[:, None], advice, own)
        stepped = env.step(key_env, state, action, params)
        station = student.env_state.station - params.start.station
        stored = Advised(networks.keep(forward.inputs), student.first, view.ahead, station - view.station, advice)
        terms = {
            **driving.mean_errors(station, view, thought),
            "reward": jnp.mean(stepped[2]),
            "taught": jnp.mean(now.taught),
        }
        following, finished = driving.follow(student, stepped, view, forward.hidden, action)
        done = following.first
        finished = dataclasses.replace(finished, done=done & ~now.taught)
        again = jax.random.uniform(key_who, done.shape) < taught
        after = Classroom(following, correct_memory(now.teacher, memory, action), jnp.where(done, again, now.taught))
        return after, (stored, finished, terms)

    after, (stored, finished, terms) = jax.lax.scan(step, drive, jax.random.split(key, n_steps))
    return after, stored, finished, jax.tree.map(jnp.mean, terms)
