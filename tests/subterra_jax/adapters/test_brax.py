"""Brax's wrappers run on the adapter, and each episode is drawn afresh, which Brax's own reset cannot do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import base
from brax.envs.wrappers import training

from subterra_jax.adapters.brax import RescaleAction, SubterraBraxEnv, jax_for_brax, wrap

pytestmark = pytest.mark.door

LENGTH, N_STEPS = 26, 60
# In [-1, 1]: two drive straight on to the horizon, two round in a circle that touches the wall before it.
ACTION = jnp.array([[0.0, 0.0], [0.0, 0.0], [1.0, 1.0], [1.0, 1.0]])
KEYS = jax.random.split(jax.random.PRNGKey(0), 4)


@pytest.fixture(scope="module")
def env():
    return SubterraBraxEnv("Subterra/TraverseShort-v1", horizon=LENGTH)


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


def test_what_a_wrapper_keeps_among_the_metrics_stays_there(env):
    """Brax's evaluation keeps the reward there; its trainers scan over steps, so no entry may come or go."""
    watched = training.EvalWrapper(wrap(RescaleAction(env)))
    state = jax.eval_shape(watched.reset, KEYS)
    stepped = jax.eval_shape(watched.step, state, ACTION)
    assert "reward" in stepped.metrics
    assert jax.tree.structure(state) == jax.tree.structure(stepped)


def test_a_randomisation_that_would_leave_out_wrappers_is_refused(env):
    with pytest.raises(ValueError, match=r"subterra_jax\.randomize"):
        wrap(env, randomization_fn=lambda params, rng: (params, None))


def test_what_jax_no_longer_has_is_lent_for_the_block_alone():
    had = hasattr(jax, "device_put_replicated")
    with jax_for_brax(), jax_for_brax():
        copies = jax.device_put_replicated({"a": jnp.arange(3.0), "b": 2}, jax.local_devices())
        doubled = jax.pmap(lambda tree: jax.tree.map(lambda leaf: 2 * leaf, tree))(copies)
    assert hasattr(jax, "device_put_replicated") == had
    n = jax.local_device_count()
    np.testing.assert_array_equal(doubled["a"], [[0.0, 2.0, 4.0]] * n)
    np.testing.assert_array_equal(doubled["b"], [4] * n)


def test_what_was_lent_is_taken_back_after_an_error():
    had = hasattr(jax, "device_put_replicated")
    with pytest.raises(ValueError, match="trainer"), jax_for_brax():
        raise ValueError("the trainer failed")
    assert hasattr(jax, "device_put_replicated") == had


def test_a_jax_that_has_it_is_left_alone(monkeypatch):
    monkeypatch.setattr(jax, "device_put_replicated", "its own", raising=False)
    with jax_for_brax():
        assert jax.device_put_replicated == "its own"
    assert jax.device_put_replicated == "its own"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_braxs_own_trainers_run_and_report_the_tasks_metrics(env, name):
    from brax.training.agents.ppo import train as ppo
    from brax.training.agents.sac import train as sac

    settings = {"unroll_length": 8, "batch_size": 8, "num_minibatches": 2} if name == "ppo" else {"min_replay_size": 32}
    rescaled = RescaleAction(env)
    with jax_for_brax():
        make_policy, weights, metrics = {"ppo": ppo, "sac": sac}[name].train(
            environment=rescaled,
            wrap_env_fn=wrap,
            episode_length=LENGTH,
            num_timesteps=256,
            num_envs=4,
            num_eval_envs=4,
            normalize_observations=True,
            **settings,
        )
    assert metrics["eval/episode_reward_jerk"] < 0.0
    assert 0.0 <= metrics["eval/episode_success"] <= 1.0
    assert 1 <= metrics["eval/avg_episode_length"] <= LENGTH
    action, _ = make_policy(weights, deterministic=True)(jnp.zeros((3, 18)), jax.random.PRNGKey(0))
    assert action.shape == (3, 2)
    assert (jnp.abs(action) <= 1.0).all()
