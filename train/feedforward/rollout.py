"""One unroll of every environment under the current policy, and the stack of its last observations.

The stack is kept while driving and rebuilt from unstacked storage while learning: storing one observation per step
divides the memory of a rollout by the number of frames. Both ways give the same stack, and the tests compare them.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from train.feedforward.networks import Networks, Weights
from train.learning import Statistics
from train.report import Finished


def start_stack(observation: Float[Array, "*batch obs"], n_frames: int) -> Float[Array, "*batch {n_frames} obs"]:
    """Returns the stack at the first step of an episode: that observation, repeated."""
    return jnp.repeat(observation[..., None, :], n_frames, axis=-2)


def push_frame(
    stack: Float[Array, "*batch frames obs"], observation: Float[Array, "*batch obs"], first: Bool[Array, "*batch"]
) -> Float[Array, "*batch frames obs"]:
    """Returns the stack one observation later, oldest frame first.

    Args:
        stack: The stack so far.
        observation: The newest observation.
        first: It begins an episode; the stack then holds nothing older.
    """
    moved = jnp.concatenate([stack[..., 1:, :], observation[..., None, :]], axis=-2)
    return jnp.where(first[..., None, None], start_stack(observation, stack.shape[-2]), moved)


def rebuild_stacks(
    first_stack: Float[Array, "env frames obs"],
    observation: Float[Array, "time env obs"],
    age: Int[Array, "time env"],
) -> Float[Array, "time env frames obs"]:
    """Rebuilds the stacks that `push_frame` kept during a rollout, from its unstacked observations.

    Args:
        first_stack: The stack at the first step of the rollout; its newest frame is `observation[0]`.
        observation: The observation acted upon at every step.
        age: Steps since that environment's episode began, 0 at its first observation.

    Returns:
        Stacks, oldest frame first. None reaches back across the beginning of its episode.
    """
    n_frames, n_steps = first_stack.shape[-2], observation.shape[0]
    history = jnp.moveaxis(first_stack[:, :-1], 1, 0)
    padded = jnp.concatenate([history, observation], axis=0)
    frames = [observation]
    for lag in range(1, n_frames):
        lagged = padded[n_frames - 1 - lag :][:n_steps]
        frames.append(jnp.where((age >= lag)[..., None], lagged, frames[-1]))
    return jnp.stack(frames[::-1], axis=-2)


@struct.dataclass
class Drive:
    """State of the environments between two unrolls.

    Attributes:
        env_state: State of the batch of environments.
        stack: Frame stack, its newest frame the observation to act upon next, `(env, frames, obs)`.
        age: Steps since each episode began, `(env,)`.
        episode_return: Undiscounted reward of each episode so far, `(env,)`.
    """

    env_state: Any
    stack: Float[Array, "env frames obs"]
    age: Int[Array, "env"]
    episode_return: Float[Array, "env"]


@struct.dataclass
class Rollout:
    """Storage of one unroll: observations without their stack, `(time, env, …)`.

    Attributes:
        observation: Observation acted upon.
        age: Steps since the episode began.
        raw_action: The draw before the tanh.
        log_prob: Log density of the action when it was drawn.
        reward: Reward of the environment.
        terminated: The episode ended for good.
        truncated: The episode ended by the clock.
        final_value: Value of the final observation of an episode that was truncated; 0 elsewhere.
    """

    observation: Float[Array, "time env obs"]
    age: Int[Array, "time env"]
    raw_action: Float[Array, "time env action"]
    log_prob: Float[Array, "time env"]
    reward: Float[Array, "time env"]
    terminated: Bool[Array, "time env"]
    truncated: Bool[Array, "time env"]
    final_value: Float[Array, "time env"]


def begin(env: Any, params: Any, key: PRNGKeyArray, n_envs: int, n_frames: int) -> Drive:
    """Starts an episode in every environment."""
    observation, env_state = env.reset(key, params, n_envs)
    return Drive(
        env_state=env_state,
        stack=start_stack(observation, n_frames),
        age=jnp.zeros(n_envs, jnp.int32),
        episode_return=jnp.zeros(n_envs, jnp.float32),
    )


def collect(
    env: Any,
    params: Any,
    networks: Networks,
    weights: dict[str, Weights],
    statistics: Statistics,
    drive: Drive,
    key: PRNGKeyArray,
    n_steps: int,
    axes: tuple[str, ...] = (),
) -> tuple[Drive, Rollout, Finished, dict[str, Float[Array, ""]]]:
    """Drives `n_steps` control periods with the sampled policy.

    Args:
        env: Batched environments that reset themselves.
        params: Their parameters.
        networks: Policy and value.
        weights: Under `policy` and `value`.
        statistics: Normalisation of observations.
        drive: State of the environments.
        key: For actions and environments.
        n_steps: Length of the unroll.
        axes: Names of the axes along which this is vmapped.

    Returns:
        State of the environments afterwards, the stored unroll, the episodes that ended in it, and the mean of every
        reward term per step.
    """

    def step(now: Drive, key_now: PRNGKeyArray) -> tuple[Drive, tuple[Rollout, Finished, dict[str, Array]]]:
        key_action, key_env = jax.random.split(key_now)
        parameters = networks.parameters(weights["policy"], statistics, now.stack)
        raw = networks.distribution.sample_no_postprocessing(parameters, key_action)
        observation, env_state, reward, terminated, truncated, info = env.step(
            key_env, now.env_state, networks.action(raw), params
        )
        done = terminated | truncated

        def value_of_final() -> Array:
            final = push_frame(now.stack, info["final_observation"], jnp.zeros_like(done))
            return networks.value(weights["value"], statistics, final)

        # Truncation is rare, and most steps skip this.
        final_value = jax.lax.cond(anywhere(truncated, axes), value_of_final, lambda: jnp.zeros_like(reward))
        total, length = now.episode_return + reward, now.age + 1
        stored = Rollout(
            observation=now.stack[:, -1],
            age=now.age,
            raw_action=raw,
            log_prob=networks.distribution.log_prob(parameters, raw),
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            final_value=jnp.where(truncated, final_value, 0.0),
        )
        finished = Finished(done, info["coverage"], info["success"], info["contact"], total, length)
        terms = {name: jnp.mean(value) for name, value in info.items() if name.startswith("reward_")}
        after = Drive(
            env_state=env_state,
            stack=push_frame(now.stack, observation, done),
            age=jnp.where(done, 0, length),
            episode_return=jnp.where(done, 0.0, total),
        )
        return after, (stored, finished, terms)

    after, (stored, finished, terms) = jax.lax.scan(step, drive, jax.random.split(key, n_steps))
    return after, stored, finished, jax.tree.map(jnp.mean, terms)


def anywhere(flag: Bool[Array, "env"], axes: tuple[str, ...]) -> Bool[Array, ""]:
    """Returns True where a flag is up in any environment, those of other copies along vmapped axes included.

    A condition that differs between copies would have both of its branches computed for all of them.
    """
    up = jnp.any(flag)
    return jax.lax.pmax(up, axes) if axes else up
