"""Pendulum of gymnax: no sensor and no map, so that it shows what launches and the loop itself allow.

Source: Lange, gymnax (2022); package `gymnax`, environment `Pendulum-v1`.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

from benchmarks.throughput.timing import Carry, Loop, digest

PACKAGE = "gymnax"
ABOUT = "gymnax Pendulum: no sensor, its own auto-reset"
N_BEAMS = 0


def loop(n_envs: int) -> Loop:
    """Pendulum with default parameters.

    Raises:
        ImportError: `gymnax` is not installed, or lacks a package that it needs.
    """
    import gymnax

    env, params = gymnax.make("Pendulum-v1")
    space = env.action_space(params)

    def reset(key: PRNGKeyArray, params: gymnax.EnvParams) -> Carry:
        return jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(key, n_envs), params)

    def step(key: PRNGKeyArray, carry: Carry, params: gymnax.EnvParams) -> tuple[Carry, Array, Array]:
        action_key, env_key = jax.random.split(key)
        action = jax.random.uniform(action_key, (n_envs, *space.shape), minval=space.low, maxval=space.high)
        keys = jax.random.split(env_key, n_envs)
        obs, state, reward, terminated, truncated, info = jax.vmap(env.step, in_axes=(0, 0, 0, None))(
            keys, carry[1], action, params
        )
        rest = digest((reward, info["final_observation"]))
        return (obs, state), rest, jnp.mean(terminated | truncated, dtype=jnp.float32)

    return Loop(reset, step, params)
