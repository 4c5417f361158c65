"""One unroll of every environment under the sampled policy, stored as learning needs it."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from train.driver import Driver, Policy
from train.report import Finished


@struct.dataclass
class Drive:
    """State of the environments between two unrolls.

    Attributes:
        env_state: State of the batch of environments.
        kept: What the policy keeps, with the observation to act upon next.
        memory: Memory of its network, `(env, cell)`.
        age: Steps since each episode began, `(env,)`.
        episode_return: Undiscounted reward of each episode so far, `(env,)`.
    """

    env_state: Any
    kept: Any
    memory: Float[Array, "env cell"]
    age: Int[Array, "env"]
    episode_return: Float[Array, "env"]


@struct.dataclass
class Rollout:
    """Storage of one unroll, `(time, env, …)`.

    Attributes:
        inputs: Inputs that were acted upon.
        first: The step begins an episode.
        raw: The draw before the tanh.
        log_prob: Log density of the draw.
        value: Value of the state acted upon.
        reward: Reward of the environment.
        terminated: The episode ended for good.
        truncated: The episode ended by the clock.
        final_value: Value of the final observation of an episode that was truncated; 0 elsewhere.
        error: True less reckoned way to go, m: the auxiliary target; no numbers without one. No input holds it.
    """

    inputs: Float[Array, "time env n"]
    first: Bool[Array, "time env"]
    raw: Float[Array, "time env action"]
    log_prob: Float[Array, "time env"]
    value: Float[Array, "time env"]
    reward: Float[Array, "time env"]
    terminated: Bool[Array, "time env"]
    truncated: Bool[Array, "time env"]
    final_value: Float[Array, "time env"]
    error: Float[Array, "time env n"]


def begin(env: Any, driver: Driver, policy: Policy, params: Any, key: PRNGKeyArray, n_envs: int) -> Drive:
    """Starts an episode in every environment."""
    observation, env_state = env.reset(key, params, n_envs)
    zero = jnp.zeros(n_envs)
    kept = driver.begin(policy, observation, params)
    return Drive(env_state, kept, driver.start_memory((n_envs,)), zero.astype(jnp.int32), zero)


def collect(
    env: Any,
    driver: Driver,
    policy: Policy,
    params: Any,
    drive: Drive,
    key: PRNGKeyArray,
    n_steps: int,
    axes: tuple[str, ...] = (),
) -> tuple[Drive, Rollout, Finished, dict[str, Float[Array, ""]]]:
    """Drives `n_steps` control periods with the sampled policy.

    Args:
        env: Batched environments that reset themselves.
        driver: What drives.
        policy: Its weights.
        params: Parameters of the environments.
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
        inputs = driver.inputs(policy, now.kept)
        out, memory = driver.answer(policy, inputs, now.memory)
        raw = driver.sample(out, key_action)
        action = driver.action(raw)
        error = driver.target(now.env_state, now.kept, params)
        observation, env_state, reward, terminated, truncated, info = env.step(key_env, now.env_state, action, params)
        done = terminated | truncated

        def value_of_final() -> Array:
            final = driver.take(policy, now.kept, action, info["final_observation"], params)
            return driver.answer(policy, driver.inputs(policy, final), memory)[0].value

        # Truncation is rare, and most steps skip this.
        final_value = jax.lax.cond(anywhere(truncated, axes), value_of_final, lambda: jnp.zeros_like(reward))
        total, length = now.episode_return + reward, now.age + 1
        stored = Rollout(
            inputs=inputs,
            first=now.age == 0,
            raw=raw,
            log_prob=driver.log_prob(out, raw),
            value=out.value,
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            final_value=jnp.where(truncated, final_value, 0.0),
            error=error,
        )
        finished = Finished(done, info["coverage"], info["success"], info["contact"], total, length)
        terms = {name: jnp.mean(value) for name, value in info.items() if name.startswith("reward_")}
        after = Drive(
            env_state=env_state,
            kept=driver.go_on(policy, now.kept, action, observation, done, params),
            memory=jnp.where(done[:, None], 0.0, memory),
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
