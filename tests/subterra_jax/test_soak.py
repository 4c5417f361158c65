"""Random and extreme actions over all tasks: observation, reward and state stay finite and inside their spaces."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental import checkify
from jaxtyping import Array, Float, Int, PRNGKeyArray

import subterra_jax as st

_EXTREMES = (np.nan, np.inf, -np.inf, 3e38, -3e38, 0.0, -0.0, 1e-38)
_CHUNK = 100
_CHECKED_ENVS, _CHECKED_STEPS = 8, 50


def wild_actions(key: PRNGKeyArray, n_envs: int, low: np.ndarray, high: np.ndarray) -> Float[Array, "n_envs n_action"]:
    """Draws actions: a third inside the box, a third up to ten times outside it, a third extreme.

    In every eighth environment all actions lie inside, so that some episodes last long.
    """
    shape = (n_envs, len(low))
    inside_key, outside_key, kind_key, which_key = jax.random.split(key, 4)
    inside = low + (high - low) * jax.random.uniform(inside_key, shape)
    outside = 10.0 * np.maximum(np.abs(low), np.abs(high)) * jax.random.uniform(outside_key, shape, minval=-1.0)
    extreme = jnp.asarray(_EXTREMES, jnp.float32)[jax.random.randint(which_key, shape, 0, len(_EXTREMES))]
    kind = jnp.where((jnp.arange(n_envs) % 8 == 0)[:, None], 0, jax.random.randint(kind_key, shape, 0, 3))
    return jnp.where(kind == 0, inside, jnp.where(kind == 1, outside, extreme))


def _violations(
    state: Any, obs: Float[Array, "n_envs n_obs"], reward: Float[Array, "n_envs"], low: np.ndarray, high: np.ndarray
) -> dict[str, Int[Array, ""]]:
    """Counts wrong numbers by name."""
    leaves = jax.tree_util.tree_flatten_with_path(state)[0]
    counts = {
        f"state{jax.tree_util.keystr(path)} not finite": jnp.sum(~jnp.isfinite(leaf))
        for path, leaf in leaves
        if jnp.issubdtype(leaf.dtype, jnp.floating)
    }
    # Written so that a NaN counts as outside.
    counts["observation outside its space"] = jnp.sum(~((obs >= low) & (obs <= high)))
    counts["observation not finite"] = jnp.sum(~jnp.isfinite(obs))
    counts["reward not finite"] = jnp.sum(~jnp.isfinite(reward))
    return counts


def soak(env: st.TunnelEnv, params: st.EnvParams, n_envs: int, n_steps: int, seed: int) -> dict[str, int]:
    """Counts violations by name in at least `n_steps` environment steps; empty where there are none."""
    batch, space, actions = st.AutoReset(env), env.observation_space(params), env.action_space(params)

    @jax.jit
    def chunk(key: PRNGKeyArray, state: Any, params: st.EnvParams) -> tuple[Any, dict[str, Int[Array, ""]]]:
        def step(state: Any, key: PRNGKeyArray) -> tuple[Any, dict[str, Int[Array, ""]]]:
            action_key, step_key = jax.random.split(key)
            action = wild_actions(action_key, n_envs, actions.low, actions.high)
            obs, state, reward, _, _, info = batch.step(step_key, state, action, params)
            both = jnp.concatenate([obs, info["final_observation"]])
            return state, _violations(state, both, reward, space.low, space.high)

        state, counts = jax.lax.scan(step, state, jax.random.split(key, _CHUNK))
        return state, jax.tree.map(jnp.sum, counts)

    key = jax.random.key(seed)
    state = jax.jit(lambda key, params: batch.reset(key, params, n_envs)[1])(key, params)
    total: dict[str, int] = {}
    for i in range(-(-n_steps // (n_envs * _CHUNK))):
        state, counts = chunk(jax.random.fold_in(key, i + 1), state, params)
        for name, count in jax.device_get(counts).items():
            total[name] = total.get(name, 0) + int(count)
    return {name: count for name, count in total.items() if count}


def first_complaint(env: st.TunnelEnv, params: st.EnvParams, seed: int) -> str | None:
    """Returns checkify's first complaint about a reset and some steps: NaN, division by 0 or index out of range."""
    actions = env.action_space(params)

    def drive(key: PRNGKeyArray, params: st.EnvParams) -> Array:
        obs, state = jax.vmap(env.reset, (0, None))(jax.random.split(key, _CHECKED_ENVS), params)

        def step(carry: tuple[Any, Array], key: PRNGKeyArray) -> tuple[tuple[Any, Array], None]:
            action_key, step_key = jax.random.split(key)
            action = wild_actions(action_key, _CHECKED_ENVS, actions.low, actions.high)
            keys = jax.random.split(step_key, _CHECKED_ENVS)
            obs, state, *_ = jax.vmap(env.step, (0, 0, 0, None))(keys, carry[0], action, params)
            return (state, obs), None

        return jax.lax.scan(step, (state, obs), jax.random.split(key, _CHECKED_STEPS))[0][1]

    errors = checkify.float_checks | checkify.index_checks
    error, _ = jax.jit(checkify.checkify(drive, errors=errors))(jax.random.key(seed), params)
    return error.get()


@pytest.mark.slow
@pytest.mark.parametrize("task", st.TASKS)
def test_every_task_is_clean_under_wild_actions_and_checkify(task):
    env, params = st.make(task, estimates=True)
    assert first_complaint(env, params, seed=0) is None
    assert soak(env, params, 1000, 200_000, seed=1) == {}
