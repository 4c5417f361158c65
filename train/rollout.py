"""One unroll of every environment under the sampled policy, stored as learning needs it."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from train.driver import Driver, Policy
from train.report import Finished


@struct.dataclass
class Drive:
    """State of the environments between two unrolls."""

    env_state: Any  # state of the batch of environments
    kept: Any  # what the policy keeps, with the observation to act upon next
    memory: Float[Array, "env cell"]  # memory of its network, `(env, cell)`
    age: Int[Array, "env"]  # steps since each episode began, `(env,)`
    episode_return: Float[Array, "env"]  # undiscounted reward of each episode so far, `(env,)`


@struct.dataclass
class Rollout:
    """Storage of one unroll, `(time, env, …)`."""

    inputs: Float[Array, "time env n"]  # inputs that were acted upon
    first: Bool[Array, "time env"]  # the step begins an episode
    raw: Float[Array, "time env action"]  # the draw before the tanh
    log_prob: Float[Array, "time env"]  # log density of the draw
    value: Float[Array, "time env"]  # value of the state acted upon
    reward: Float[Array, "time env"]  # reward of the environment
    terminated: Bool[Array, "time env"]  # the episode ended for good
    truncated: Bool[Array, "time env"]  # the episode ended by the clock
    # value of the final observation of an episode that was truncated; 0 elsewhere
    final_value: Float[Array, "time env"]
    # True less reckoned way to go, m: the auxiliary target; no numbers without one. No input holds it.
    error: Float[Array, "time env n"]


def begin(env: Any, driver: Driver, policy: Policy, params: Any, key: PRNGKeyArray, n_envs: int) -> Drive:
    """Starts an episode in every environment."""
    start_key, scan_key = jax.random.split(key)
    env_state = _begin(env, params, start_key, n_envs)
    zero = jnp.zeros(n_envs)
    kept = driver.begin(policy, _see(driver, params, env_state, env.draw_step(scan_key, (n_envs,), params)), params)
    return Drive(env_state, kept, driver.start_memory((n_envs,)), zero.astype(jnp.int32), zero)


@struct.dataclass
class Last:
    """The last step of each environment that was cut off by the clock, from which its value is bootstrapped."""

    env_state: Any  # state after it
    kept: Any  # what the policy kept before it
    action: Float[Array, "env action"]  # the action
    memory: Float[Array, "env cell"]  # memory of the network after its inputs


def collect(
    env: Any, driver: Driver, policy: Policy, params: Any, drive: Drive, key: PRNGKeyArray, n_steps: int
) -> tuple[Drive, Rollout, Finished, dict[str, Float[Array, ""]]]:
    """Drives `n_steps` control periods with the sampled policy; who has finished begins anew.

    Nothing in a step depends on whether any episode has ended, so that the device never waits for the host. What the
    clock cut off is valued once, after the unroll: an episode is longer than that, so each environment has one at most.

    Args:
        env: The environment, not batched.
        driver: What drives.
        policy: Its weights.
        params: Parameters of the environments.
        drive: State of the environments.
        key: For actions and environments.
        n_steps: Length of the unroll, less than the horizon.

    Returns:
        State of the environments afterwards, the stored unroll, the episodes that ended in it, and the mean of every
        reward term per step.
    """
    n_envs = drive.age.shape[0]

    def step(carry: tuple[Drive, Last], key_now: PRNGKeyArray) -> tuple[tuple[Drive, Last], Any]:
        now, last = carry
        key_action, key_env, key_start = jax.random.split(key_now, 3)
        inputs = driver.inputs(policy, now.kept)
        out, memory = driver.answer(policy, inputs, now.memory)
        raw = driver.sample(out, key_action)
        action = driver.act(raw, now.kept, params)
        error = driver.target(now.env_state, now.kept, params)
        noise = env.draw_step(key_env, (n_envs,), params)
        stepped, reward, terminated, truncated, info = jax.vmap(env.advance, (0, 0, 0, None))(
            now.env_state, action, noise, params
        )
        done = terminated | truncated
        env_state = _choose(done, _begin(env, params, key_start, n_envs), stepped)
        seen = _see(driver, params, env_state, noise)
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
            final_value=jnp.zeros_like(reward),
            error=error,
        )
        finished = Finished(done, info["coverage"], info["success"], info["contact"], total, length)
        terms = {name: jnp.mean(value) for name, value in info.items() if name.startswith("reward_")}
        last = _choose(truncated, Last(stepped, now.kept, action, memory), last)
        after = Drive(
            env_state=env_state,
            kept=driver.go_on(policy, now.kept, action, seen, done, params),
            memory=jnp.where(done[:, None], 0.0, memory),
            age=jnp.where(done, 0, length),
            episode_return=jnp.where(done, 0.0, total),
        )
        return (after, last), (stored, finished, terms)

    key_steps, key_last = jax.random.split(key)
    nobody = Last(drive.env_state, drive.kept, jnp.zeros((n_envs, driver.n_action)), drive.memory)
    keys = jax.random.split(key_steps, n_steps)
    (after, last), (stored, finished, terms) = jax.lax.scan(step, (drive, nobody), keys)
    final = _see(driver, params, last.env_state, env.draw_step(key_last, (n_envs,), params))
    kept = driver.take(policy, last.kept, last.action, final, params)
    value = driver.answer(policy, driver.inputs(policy, kept), last.memory)[0].value
    stored = dataclasses.replace(stored, final_value=jnp.where(stored.truncated, value, 0.0))
    return after, stored, finished, jax.tree.map(jnp.mean, terms)


def _begin(env: Any, params: Any, key: PRNGKeyArray, n_envs: int) -> Any:
    return jax.vmap(env.begin, (0, None))(env.draw_reset(key, (n_envs,), params), params)


def _see(driver: Driver, params: Any, env_state: Any, noise: Any) -> Any:
    return driver.see(jax.vmap(driver.env.observe, (0, 0, None))(env_state, noise, params), env_state)


def _choose(condition: Bool[Array, "env"], new: Any, old: Any) -> Any:
    """Returns one of two trees for each environment."""
    return jax.tree.map(lambda a, b: jnp.where(condition.reshape(-1, *[1] * (b.ndim - 1)), a, b), new, old)
