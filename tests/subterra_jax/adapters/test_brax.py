"""Brax's wrappers run on the adapter, and each episode is drawn afresh, which Brax's own reset cannot do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import base
from brax.envs.wrappers import training

from subterra_jax.adapters.brax import RescaleAction, SubterraBraxEnv, wrap

LENGTH, N_STEPS = 26, 60
# In [-1, 1]: two drive straight on to the horizon, two round in a circle that touches the wall before it.
ACTION = jnp.array([[0.0, 0.0], [0.0, 0.0], [1.0, 1.0], [1.0, 1.0]])
KEYS = jax.random.split(jax.random.PRNGKey(0), 4)


@pytest.fixture(scope="module")
def env():
    return SubterraBraxEnv("Subterra/TraverseShort-v0", horizon=LENGTH)


class Drive:
    """A wrapped environment, compiled once, and what happens in it."""

    def __init__(self, wrapped):
        self.reset, self.step = jax.jit(wrapped.reset), jax.jit(wrapped.step)

    def __call__(self, keys, n_steps=N_STEPS):
        states = [self.reset(keys)]
        for _ in range(n_steps):
            states.append(self.step(states[-1], ACTION))
        return jax.tree.map(lambda *leaves: np.stack(leaves), *states)


@pytest.fixture(scope="module")
def ours(env):
    return Drive(wrap(RescaleAction(env)))


@pytest.fixture(scope="module")
def states(ours):
    return ours(KEYS)


def test_it_is_a_brax_environment(env):
    assert isinstance(env, base.Env)
    assert (env.observation_size, env.action_size, env.backend) == (18, 2, "subterra")
    state = jax.eval_shape(env.reset, jax.random.key(0))
    stepped = jax.eval_shape(env.step, state, jnp.zeros(2))
    assert jax.tree.structure(state) == jax.tree.structure(stepped)
    same = jax.tree.map(lambda a, b: (a.shape, a.dtype) == (b.shape, b.dtype), state, stepped)
    assert all(jax.tree.leaves(same))


def test_every_episode_is_drawn_afresh_where_brax_repeats_the_first(env, states):
    theirs = Drive(training.wrap(RescaleAction(env), LENGTH))(KEYS, LENGTH)
    begins = [0, LENGTH]
    for run in (states, theirs):
        np.testing.assert_array_equal(run.done[LENGTH, :2], 1.0)
        np.testing.assert_array_equal(run.obs[begins, :2, 16:], 0.0)
    np.testing.assert_array_equal(theirs.obs[0, :2], theirs.obs[LENGTH, :2])
    assert (states.obs[0, :2, :16] != states.obs[LENGTH, :2, :16]).any(axis=-1).all()
    bias = states.pipeline_state.odometry.distance_bias
    assert len(np.unique(bias[[0, LENGTH, 2 * LENGTH], :2])) == 6
    assert len(np.unique(bias[:LENGTH, :2])) == 2


def test_the_horizon_is_a_truncation_and_contact_is_none(states):
    done, truncation = states.done.astype(bool), states.info["truncation"].astype(bool)
    np.testing.assert_array_equal(np.flatnonzero(done[:, 0]), [LENGTH, 2 * LENGTH])
    assert truncation[[LENGTH, 2 * LENGTH], :2].all()
    assert done[:, 2:].sum(axis=0).min() >= 2
    assert not truncation[:, 2:].any()
    np.testing.assert_array_equal(states.metrics["contact"][:, 2:], done[:, 2:])


def test_the_last_observation_of_an_episode_is_kept(states):
    np.testing.assert_array_equal(states.obs[LENGTH, :2, 16], 0.0)
    assert np.abs(states.info["final_observation"][LENGTH, :2, 16] - 0.1 * LENGTH).max() < 0.4


def test_the_same_keys_give_the_same_bits_and_keys_of_either_kind_are_taken(ours, states):
    again = ours(KEYS, 3)
    for one, other in zip(jax.tree.leaves(again), jax.tree.leaves(states), strict=True):
        np.testing.assert_array_equal(one, other[:4])
    typed, raw = (jax.eval_shape(ours.reset, keys) for keys in (jax.random.wrap_key_data(KEYS), KEYS))
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), typed) == jax.tree.map(
        lambda leaf: (leaf.shape, leaf.dtype), raw
    )


def test_actions_between_minus_and_plus_one_span_the_bounds(env, states):
    low, high = env.action_bounds
    np.testing.assert_allclose(states.pipeline_state.command[1, 0], 0.5 * (low + high), atol=1e-6)
    np.testing.assert_allclose(states.pipeline_state.command[1, 2], high, atol=1e-6)
