"""Both forms of Gymnax's methods; Gymnax's own wrappers and rejax run on them where they are installed."""

import sys
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from subterra_jax.adapters.gymnax import SubterraGymnax, SubterraGymnax5

pytestmark = pytest.mark.door

TASK, HORIZON = "Subterra/TraverseShort-v1", 5


@pytest.fixture(scope="module")
def env():
    return SubterraGymnax(TASK, horizon=HORIZON)


@pytest.fixture(scope="module")
def older():
    return SubterraGymnax5(TASK, horizon=HORIZON)


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
    step = jax.jit(lambda key, state: jax.vmap(env.step)(jax.random.split(key, 3), state, ahead))
    outs = episode(step, jax.random.key(1), state, 2 * HORIZON)
    done = np.stack([out[3] | out[4] for out in outs])
    np.testing.assert_array_equal(done.T, [[(k + 1) % HORIZON == 0 for k in range(2 * HORIZON)]] * 3)
    np.testing.assert_array_equal(done, [out[5]["done"] for out in outs])
    assert not np.stack([out[3] for out in outs]).any()
    fresh, info = outs[HORIZON - 1][0], outs[HORIZON - 1][5]
    np.testing.assert_array_equal(fresh[:, 16], 0.0)
    assert np.abs(info["final_observation"][:, 16] - 0.5).max() < 0.2
    assert (obs[:, :16] != fresh[:, :16]).any(axis=1).all()
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


def test_the_older_form_returns_five_and_tells_the_horizon_from_an_end(env, older):
    """Straight on to the horizon, then into the wall; the six say the same of the same keys."""
    _, state = older.reset(jax.random.key(0))
    for action, n_steps in ((jnp.array([1.0, 0.0]), HORIZON), (jnp.array([2.0, 1.5]), 60)):
        params = env.default_params.replace(max_steps_in_episode=n_steps)
        for k in range(n_steps):
            key = jax.random.fold_in(jax.random.key(1), k)
            obs, after, reward, done, info = older.step(key, state, action, params)
            six = env.step(key, state, action, params)
            np.testing.assert_allclose(obs, six[0], atol=1e-3)  # another program rounds in another order
            assert reward == pytest.approx(float(six[2]), abs=1e-5)
            assert done == six[3] | six[4]
            assert (info["terminated"], info["truncated"], info["discount"]) == (six[3], six[4], 1.0 - six[3])
            state = after
            if done:
                break
        if n_steps == HORIZON:
            assert (k + 1, bool(info["truncated"]), float(info["discount"])) == (HORIZON, True, 1.0)
        else:
            assert (bool(info["contact"]), float(info["discount"])) == (True, 0.0)


def test_the_horizon_goes_by_gymnaxs_name(env):
    params = env.default_params
    assert params.max_steps_in_episode == params.horizon == HORIZON
    shorter = params.replace(max_steps_in_episode=2)
    assert (shorter.horizon.dtype, int(shorter.max_steps_in_episode)) == (jnp.int32, 2)
    assert jax.tree.structure(shorter) == jax.tree.structure(params)
    with pytest.raises(ValueError, match="wheels"):
        params.replace(wheels=2)


def test_spaces_can_be_asked_for_inside_a_jitted_loop(older):
    params = older.default_params

    @jax.jit
    def act(key):
        space = older.action_space(params)
        return jnp.clip(space.sample(key), space.low, space.high), jnp.zeros(older.observation_space(params).shape)

    action, blank = act(jax.random.key(0))
    np.testing.assert_allclose(action, older.action_space().sample(jax.random.key(0)), rtol=1e-6)
    assert blank.shape == (18,)


def test_a_caller_who_has_gymnax_gets_spaces_of_its_class(env, monkeypatch):
    """Wrappers of purejaxrl and stoix ask for the class; the bounds of an odometer are open, the draws finite."""

    class TheirBox:
        def __init__(self, low, high, shape, dtype):
            self.low, self.high, self.shape, self.dtype = low, high, shape, dtype

    theirs = ModuleType("gymnax.environments.spaces")
    theirs.Box = TheirBox
    monkeypatch.setitem(sys.modules, "gymnax.environments.spaces", theirs)
    for space in (env.action_space(env.default_params), env.observation_space(env.default_params)):
        assert isinstance(space, TheirBox)
        drawn = space.sample(jax.random.key(0))
        assert (drawn.shape, drawn.dtype) == (space.shape, space.dtype)
        assert np.isfinite(drawn).all()
        assert space.contains(drawn)


def test_gymnax_wrappers_run_on_it(env, older):
    pytest.importorskip("gymnax", reason="Gymnax asks for an older Gymnasium; pip install --no-deps gymnax six")
    from gymnax.environments import spaces
    from gymnax.wrappers.purerl import FlattenObservationWrapper, LogWrapper

    try:
        from gymnax.wrappers.compat import LegacyStepAPIWrapper
    except ImportError:  # before 1.0
        form, n_returned = older, 5
    else:
        form, n_returned = env, 6
        legacy = LegacyStepAPIWrapper(env)
        _, state = legacy.reset(jax.random.key(5), env.default_params)
        assert len(legacy.step(jax.random.key(6), state, jnp.zeros(2), env.default_params)) == 5
    params = form.default_params
    logged = LogWrapper(FlattenObservationWrapper(form))
    assert isinstance(logged.observation_space(params), spaces.Box)
    _, state = logged.reset(jax.random.key(5), params)
    outs = episode(lambda key, state: logged.step(key, state, jnp.ones(2), params), jax.random.key(6), state, HORIZON)
    assert len(outs[-1]) == n_returned
    info = outs[-1][-1]
    assert info["returned_episode_lengths"] == HORIZON
    assert info["returned_episode_returns"] == pytest.approx(sum(float(out[2]) for out in outs), abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["PPO", "SAC"])
def test_rejax_trains_on_the_older_form(older, name):
    rejax = pytest.importorskip("rejax", reason="pip install --no-deps rejax 'gymnax<1' distrax")
    many = {"num_envs": 4, "num_steps": 16, "num_minibatches": 2}
    one = {"fill_buffer": 64, "batch_size": 16, "buffer_size": 256}
    settings = many if name == "PPO" else one
    trainer = getattr(rejax, name).create(
        env=older, env_params=older.default_params, total_timesteps=256, eval_freq=128, **settings
    )
    _, (lengths, returns) = jax.jit(trainer.train)(jax.random.PRNGKey(0))
    assert lengths.shape == returns.shape == (3, 128)
    assert (lengths == HORIZON).all()
    assert np.isfinite(returns).all()
