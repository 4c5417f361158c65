"""Driving every environment for one unroll, some by the teacher and some by the student, with the teacher's advice."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax.baselines.agent import Agent
from subterra_jax.policies import senses
from train.recurrent import drive as driving
from train.recurrent import teacher as teaching
from train.recurrent.network import RecurrentNetworks, Weights
from train.run.report import Finished


@struct.dataclass
class Classroom:
    """Where the environments are between two unrolls.

    Attributes:
        student: As in training by reward.
        teacher: What the teacher remembers of each environment.
        taught: The teacher drives this episode.
    """

    student: driving.Drive
    teacher: Any
    taught: Bool[Array, "env"]


@struct.dataclass
class Advised:
    """One unroll as it is stored, `(time, env, …)`.

    Attributes:
        features: Inputs of the network.
        first: The episode begins with this step.
        ahead: Goal less tracked distance, m.
        error: True less tracked distance, m.
        advice: What the teacher would have done, m/s and rad/s.
    """

    features: Float[Array, "time env n"]
    first: Bool[Array, "time env"]
    ahead: Float[Array, "time env"]
    error: Float[Array, "time env"]
    advice: Float[Array, "time env 2"]


def begin(env: Any, agent: Agent, params: Any, student: driving.Drive) -> Classroom:
    """Every environment at the start of an episode, all driven by the teacher."""
    n_envs = len(student.first)
    return Classroom(student, teaching.blank(env, agent, params, n_envs), jnp.ones(n_envs, bool))


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
        drive: Where the environments are.
        key: For environments, teacher, and who drives the next episode.
        n_steps: Length of the unroll.
        taught: Share of the episodes that begin now which the teacher drives.

    Returns:
        Where the environments are afterwards, the stored unroll, the student's episodes that ended in it, and means per
        step: the reward, and how far off estimate, ring tracker and dead reckoning are (m).
    """
    low, high = jnp.asarray(networks.layout.action_low), jnp.asarray(networks.layout.action_high)

    def step(now: Classroom, key_now: PRNGKeyArray) -> tuple[Classroom, tuple[Advised, Finished, dict[str, Array]]]:
        key_teacher, key_env, key_who = jax.random.split(key_now, 3)
        student, state = now.student, now.student.env_state
        view = driving.look(env.env, params, student.observation, student.reckoning)
        hidden, _ = networks.remember(weights, view.features[None], student.hidden, student.first[None])
        thought = networks.think(weights, hidden, view.ahead)
        advice, memory = teaching.advise(
            env.env, agent, key_teacher, now.teacher, student.observation, state, student.first, params
        )
        advice = jnp.clip(advice[:, : networks.n_action], low, high)
        own = networks.action(thought.parameters[:, : networks.n_action])
        action = jnp.where(now.taught[:, None], advice, own)
        observation, state, reward, terminated, truncated, info = env.step(key_env, state, action, params)
        done = terminated | truncated
        station = student.env_state.station - params.start.station
        stored = Advised(view.features, student.first, view.ahead, station - view.station, advice)
        terms = {
            "estimate_error": jnp.mean(jnp.abs(stored.error - thought.error)),
            "tracking_error": jnp.mean(jnp.abs(stored.error)),
            "reckoning_error": jnp.mean(jnp.abs(station - view.reckoning.rings.reckoned)),
            "reward": jnp.mean(reward),
            "taught": jnp.mean(now.taught),
        }
        total, length = student.episode_return + reward, student.env_state.steps + 1
        own_done = done & ~now.taught
        finished = Finished(own_done, info["coverage"], info["success"], info["contact"], total, length)
        following = driving.Drive(
            env_state=state,
            observation=observation,
            reckoning=senses.advance(view.reckoning, action, done),
            hidden=hidden,
            first=done,
            episode_return=jnp.where(done, 0.0, total),
        )
        again = jax.random.uniform(key_who, done.shape) < taught
        after = Classroom(following, teaching.driven(now.teacher, memory, action), jnp.where(done, again, now.taught))
        return after, (stored, finished, terms)

    after, (stored, finished, terms) = jax.lax.scan(step, drive, jax.random.split(key, n_steps))
    return after, stored, finished, jax.tree.map(jnp.mean, terms)
