"""The view with Gymnax's methods; Gymnax's own wrappers run on it where Gymnax is installed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from subterra_jax.adapters.gymnax import SubterraGymnax

HORIZON = 5


@pytest.fixture(scope="module")
def env():
    return SubterraGymnax("Subterra/TraverseShort-v0", horizon=HORIZON)


def episode(step, key, state, n_steps):
    outs = []
    for k in range(n_steps):
        outs.append(step(jax.random.fold_in(key, k), state))
        state = outs[-1][1]
    return outs


def test_it_begins_anew_with_a_fresh_draw_and_keeps_the_last_observation(env):
    """Under vmap, and with the default params."""
    obs, state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 3))
    ahead = jnp.tile(jnp.array([1.0, 0.0]), (3, 1))
    step = lambda key, state: jax.vmap(env.step)(jax.random.split(key, 3), state, ahead)  # noqa: E731
    outs = episode(step, jax.random.key(1), state, 2 * HORIZON)
    done = np.stack([out[3] | out[4] for out in outs])
    np.testing.assert_array_equal(done.T, [[(k + 1) % HORIZON == 0 for k in range(2 * HORIZON)]] * 3)
    np.testing.assert_array_equal(done, [out[5]["done"] for out in outs])
    assert not np.stack([out[3] for out in outs]).any()
    begun, info = outs[HORIZON - 1][0], outs[HORIZON - 1][5]
    np.testing.assert_array_equal(begun[:, 16], 0.0)
    assert np.abs(info["final_observation"][:, 16] - 0.5).max() < 0.2
    assert (obs[:, :16] != begun[:, :16]).any(axis=1).all()
    bias = np.stack([state.odometry.distance_bias, *(out[1].odometry.distance_bias for out in outs)])
    assert len(np.unique(bias)) == 9
    np.testing.assert_array_equal(outs[0][0], outs[0][5]["final_observation"])


def test_params_are_an_argument_as_in_gymnax(env):
    key, params = jax.random.key(2), env.default_params
    obs, state = jax.eval_shape(env.reset, key, params)
    out = jax.eval_shape(env.step, key, state, jnp.zeros(2), params)
    assert (out[0].shape, out[0].dtype) == (obs.shape, obs.dtype) == ((18,), jnp.float32)
    assert jax.tree.structure(out[1]) == jax.tree.structure(state)


def test_spaces_hold_what_is_drawn_from_them_and_what_is_observed(env):
    obs, _ = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 3))
    for space in (env.observation_space(env.default_params), env.action_space()):
        drawn = jax.jit(jax.vmap(space.sample))(jax.random.split(jax.random.key(4), 50))
        assert drawn.shape == (50, *space.shape)
        assert drawn.dtype == space.dtype
        assert np.isfinite(drawn).all()
        assert (drawn.std(axis=0) > 0.0).all()
        assert jax.vmap(space.contains)(drawn).all()
    assert env.observation_space().contains(obs[0])
    assert not env.action_space().contains(jnp.array([3.0, 0.0]))
    assert not env.action_space().contains(jnp.array([jnp.nan, 0.0]))


def test_gymnax_wrappers_run_on_it(env):
    pytest.importorskip("gymnax", reason="Gymnax 1.0 asks for an older Gymnasium; pip install --no-deps gymnax")
    from gymnax.wrappers.compat import LegacyStepAPIWrapper
    from gymnax.wrappers.purerl import LogWrapper

    params = env.default_params
    logged = LogWrapper(env)
    _, state = logged.reset(jax.random.key(5), params)
    outs = episode(lambda key, state: logged.step(key, state, jnp.ones(2), params), jax.random.key(6), state, HORIZON)
    info = outs[-1][5]
    assert info["returned_episode_lengths"] == HORIZON
    assert info["returned_episode_returns"] == pytest.approx(sum(float(out[2]) for out in outs), abs=1e-5)
    legacy = LegacyStepAPIWrapper(env)
    _, state = legacy.reset(jax.random.key(5), params)
    assert len(legacy.step(jax.random.key(6), state, jnp.zeros(2), params)) == 5
