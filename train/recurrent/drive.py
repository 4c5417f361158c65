"""Driving every environment for one unroll with memory, and what is kept of it."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax.policies import senses
from train.recurrent.network import RecurrentLayout, RecurrentNetworks, Weights
from train.run.report import Finished


@struct.dataclass
class Drive:
    """Where the environments are between two unrolls.

    Attributes:
        env_state: State of the batch of environments.
        observation: To act upon next.
        reckoning: Dead reckoning and rings of each episode so far.
        hidden: Memory.
        first: The observation begins an episode.
        episode_return: Undiscounted reward of each episode so far.
    """

    env_state: Any
    observation: Float[Array, "env obs"]
    reckoning: senses.Reckoning
    hidden: Float[Array, "env hidden"]
    first: Bool[Array, "env"]
    episode_return: Float[Array, "env"]


@struct.dataclass
class Rollout:
    """One unroll as it is stored, `(time, env, …)`.

    Attributes:
        features: Inputs of the network.
        first: The episode begins with this step.
        ahead: Goal less tracked distance, m.
        error: True less tracked distance, m: what the estimation head is to learn.
        truth: Inputs of the critic.
        raw_action: The draw before the tanh.
        log_prob: Its log density when it was drawn.
        reward: As the environment paid it.
        terminated: The episode ended for good.
        truncated: The episode ended by the clock.
    """

    features: Float[Array, "time env n"]
    first: Bool[Array, "time env"]
    ahead: Float[Array, "time env"]
    error: Float[Array, "time env"]
    truth: Float[Array, "time env n"]
    raw_action: Float[Array, "time env action"]
    log_prob: Float[Array, "time env"]
    reward: Float[Array, "time env"]
    terminated: Bool[Array, "time env"]
    truncated: Bool[Array, "time env"]


def look(env: Any, params: Any, observation: Float[Array, "env obs"], reckoning: senses.Reckoning) -> senses.Sight:
    """The inputs of the network for a batch of observations."""
    part = {name: observation[..., where] for name, where in env.fields(params).items()}
    return senses.look(part, params.start.station, reckoning)


def truth(env: Any, params: Any, state: Any, view: senses.Sight, error: Float[Array, "env"]) -> Float[Array, "env n"]:
    """What the critic is shown: the true state, and how wrong the agent's estimate of it is.

    Args:
        env: The environment.
        params: Its params.
        state: Batched state.
        view: What the agent sees.
        error: The agent's own estimate of true less tracked distance, m.
    """
    known = jax.vmap(env.privileged, (0, None))(state, params)
    ahead = known["to_goal"]
    wrong = view.station + params.start.station + error - known["station"]
    parts = [
        known["offset"],
        known["heading_sin"],
        known["heading_cos"],
        jnp.tanh(ahead),
        jnp.tanh(ahead / 10.0),
        ahead / 100.0,
        jnp.tanh(wrong),
        wrong / 5.0,
        10.0 * known["slip"],
        known["still"] / 10.0,
        *jnp.moveaxis(state.command, -1, 0),
    ]
    return jnp.stack(parts, axis=-1)


def begin(env: Any, params: Any, key: PRNGKeyArray, n_envs: int, layout: RecurrentLayout) -> Drive:
    """Every environment at the start of an episode."""
    observation, state = env.reset(key, params, n_envs)
    return Drive(
        env_state=state,
        observation=observation,
        reckoning=senses.start((n_envs,), params.lidar.n_beams, layout.shown),
        hidden=jnp.zeros((n_envs, layout.hidden)),
        first=jnp.ones(n_envs, bool),
        episode_return=jnp.zeros(n_envs),
    )


def collect(
    env: Any,
    params: Any,
    networks: RecurrentNetworks,
    weights: dict[str, Weights],
    drive: Drive,
    key: PRNGKeyArray,
    n_steps: int,
) -> tuple[Drive, Rollout, Finished, dict[str, Float[Array, ""]]]:
    """Drives `n_steps` control periods with the sampled policy.

    Returns:
        Where the environments are afterwards, the stored unroll, the episodes that ended in it, and means per step: of
        every reward term, and of how far off estimate, ring tracker and dead reckoning are (m).
    """

    def step(now: Drive, key_now: PRNGKeyArray) -> tuple[Drive, tuple[Rollout, Finished, dict[str, Array]]]:
        key_action, key_env = jax.random.split(key_now)
        view = look(env.env, params, now.observation, now.reckoning)
        hidden, _ = networks.remember(weights, view.features[None], now.hidden, now.first[None])
        thought = networks.think(weights, hidden, view.ahead)
        raw = networks.distribution.sample_no_postprocessing(thought.parameters, key_action)
        action = networks.action(raw)
        observation, state, reward, terminated, truncated, info = env.step(key_env, now.env_state, action, params)
        done = terminated | truncated
        station = now.env_state.station - params.start.station
        stored = Rollout(
            features=view.features,
            first=now.first,
            ahead=view.ahead,
            error=station - view.station,
            truth=truth(env.env, params, now.env_state, view, thought.error),
            raw_action=raw,
            log_prob=networks.distribution.log_prob(thought.parameters, raw),
            reward=reward,
            terminated=terminated,
            truncated=truncated,
        )
        terms = {
            "estimate_error": jnp.mean(jnp.abs(stored.error - thought.error)),
            "tracking_error": jnp.mean(jnp.abs(stored.error)),
            "reckoning_error": jnp.mean(jnp.abs(station - view.reckoning.rings.reckoned)),
            **{name: jnp.mean(value) for name, value in info.items() if name.startswith("reward_")},
        }
        total, length = now.episode_return + reward, now.env_state.steps + 1
        finished = Finished(done, info["coverage"], info["success"], info["contact"], total, length)
        after = Drive(
            env_state=state,
            observation=observation,
            reckoning=senses.advance(view.reckoning, action, done),
            hidden=hidden,
            first=done,
            episode_return=jnp.where(done, 0.0, total),
        )
        return after, (stored, finished, terms)

    after, (stored, finished, terms) = jax.lax.scan(step, drive, jax.random.split(key, n_steps))
    return after, stored, finished, jax.tree.map(jnp.mean, terms)
