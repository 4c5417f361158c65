"""Batches that reset themselves: fresh draws, exact final observations; environments that differ in their params."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax import lidar
from subterra_jax.lidar import LidarParams
from subterra_jax.randomization import LogUniform, randomize

TASK = "Subterra/TraverseShort-v1"
N, FEW = 128, 8  # every other size is another program


def batch_of(**overrides):
    env, params = st.make(TASK, **overrides)
    return st.AutoReset(env), params


def actions(seed: int, n: int = N) -> jax.Array:
    return jax.random.uniform(jax.random.key(seed), (n, 2), minval=jnp.array([0.0, -1.5]), maxval=jnp.array([2.0, 1.5]))


# Eager code would compile every operation by itself.
reset_jit = jax.jit(lambda batch, key, params, n: batch.reset(key, params, n), static_argnums=(0, 3))
step_jit = jax.jit(lambda batch, *arguments: batch.step(*arguments), static_argnums=0)


def run(batch, params, n: int, steps: int, action=None):
    obs, state = reset_jit(batch, jax.random.key(0), params, n)
    outs = []
    for k in range(steps):
        chosen = actions(k, N)[:n] if action is None else jnp.broadcast_to(jnp.array(action), (n, 2))
        outs.append((state, step_jit(batch, jax.random.key(100 + k), state, chosen, params)))
        state = outs[-1][1][1]
    return obs, outs


def test_a_batch_steps_like_its_environments_alone():
    batch, params = batch_of(horizon=1000)
    env = batch.env
    _, state = reset_jit(batch, jax.random.key(0), params, FEW)
    action = actions(0, FEW)
    obs, after, reward, terminated, truncated, info = step_jit(batch, jax.random.key(1), state, action, params)
    assert not (terminated | truncated).any()
    noise = env.draw_step(jax.random.split(jax.random.key(1))[0], (FEW,), params)
    advance, observe = jax.jit(env.advance), jax.jit(env.observe)
    for i in range(FEW):
        one, mine = jax.tree.map(lambda x, i=i: x[i], (state, noise))
        new, gain, *_ = advance(one, action[i], mine, params)
        np.testing.assert_allclose(observe(new, mine, params), obs[i], atol=2e-4)
        np.testing.assert_allclose(gain, reward[i], atol=1e-6)
        np.testing.assert_allclose(new.position, after.position[i], atol=1e-5)
    np.testing.assert_array_equal(info["final_observation"], obs)


@pytest.mark.parametrize(("horizon", "n_done"), [(4, "all of them"), (1000, "a few of them")])
def test_the_final_observation_is_that_of_the_state_before_the_reset(horizon, n_done):
    batch, params = batch_of(horizon=horizon, lidar=LidarParams(range_sigma=0.0))
    scan = jax.jit(jax.vmap(partial(lidar.scan, params=params.lidar), (None, 0, 0, 0)))
    counts = []
    _, outs = run(batch, params, N, 45)
    advance = jax.jit(jax.vmap(batch.env.advance, (0, 0, 0, None)))
    for k, (before, out) in enumerate(outs):
        obs, after, _, terminated, truncated, info = out
        done = np.asarray(terminated | truncated)
        counts.append(done.sum())
        noise = batch.env.draw_step(jax.random.split(jax.random.key(100 + k))[0], (N,), params)
        stepped, *_ = advance(before, actions(k), noise, params)
        final = np.asarray(info["final_observation"])
        truth = np.asarray(scan(params.tunnel, stepped.position, stepped.heading, stepped.station))
        np.testing.assert_allclose(final[:, :16], truth, atol=2e-3)
        np.testing.assert_allclose(final[:, 16], stepped.odometry.distance, atol=1e-5)
        np.testing.assert_array_equal(final[~done], np.asarray(obs)[~done])
        # Where an episode ended the observation is the first of the next one.
        assert (np.asarray(obs)[done, 16:] == 0.0).all()
        assert (np.asarray(after.steps)[done] == 0).all()
        assert (np.asarray(after.station)[done] == 0.0).all()
    few = max(1, N // 32)
    assert max(counts) == N if n_done == "all of them" else any(0 < count <= few for count in counts)


def test_each_episode_of_one_environment_has_its_own_bias_and_start():
    batch, params = batch_of(horizon=3)
    _, outs = run(batch, params, FEW, 12, action=(1.0, 0.0))
    states = [after for _, (_, after, *_) in outs][2::3]
    for name in ("distance_bias", "heading_bias"):
        values = np.stack([np.asarray(getattr(state.odometry, name)) for state in states])
        assert len(np.unique(values)) == values.size
    starts = np.stack([np.asarray(state.lateral) for state in states])
    assert len(np.unique(starts)) == starts.size


def test_params_of_every_environment_may_be_stacked_whole():
    shared, params = batch_of(horizon=2)
    stacked = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (FEW, *leaf.shape)), params)
    batch = st.AutoReset(shared.env, params_axes=0)
    obs, state = reset_jit(batch, jax.random.key(0), stacked, FEW)
    same, _ = reset_jit(shared, jax.random.key(0), params, FEW)
    np.testing.assert_allclose(obs, same, atol=2e-4)
    for k in range(2):
        obs, state, *_, info = step_jit(batch, jax.random.key(k), state, actions(k, FEW), stacked)
    assert (np.asarray(info["final_observation"])[:, 16] != 0.0).all()


def test_a_rollout_in_one_scan_equals_the_steps_one_by_one():
    batch, params = batch_of(horizon=4)

    def policy(key, obs):
        return jnp.stack([1.0 + 0.0 * obs[:, 0], jax.random.uniform(key, obs.shape[:1], minval=-0.3, maxval=0.3)], -1)

    obs, state = reset_jit(batch, jax.random.key(0), params, FEW)
    last, _, record = jax.jit(lambda o, s: st.rollout(batch, policy, jax.random.key(5), o, s, params, 9))(obs, state)
    for k, key in enumerate(jax.random.split(jax.random.key(5), 9)):
        policy_key, env_key = jax.random.split(key)
        np.testing.assert_allclose(record["obs"][k], obs, atol=2e-4)
        obs, state, reward, *_ = step_jit(batch, env_key, state, policy(policy_key, obs), params)
        np.testing.assert_allclose(record["reward"][k], reward, atol=1e-5)
    np.testing.assert_allclose(last, obs, atol=2e-4)
    assert record["info"]["final_observation"].shape == (9, FEW, 18)


RANGES = {"lidar.range_sigma": (0.0, 0.1), "vehicle.speed_max": (1.0, 2.0), "lidar.range_max": (10.0, 30.0)}


@pytest.fixture(scope="module")
def made():
    return st.make(TASK)


def drawn(params, ranges, n=4000, seed=0):
    return randomize(jax.random.key(seed), params, ranges, n)[0]


def test_draws_fill_their_ranges_evenly(made):
    params = drawn(made[1], {"lidar.range_sigma": (0.02, 0.1), "reward.lateral": LogUniform(1e-3, 1e-1)})
    sigma = np.asarray(params.lidar.range_sigma)
    assert sigma.min() >= 0.02
    assert sigma.max() <= 0.1
    assert sigma.mean() == pytest.approx(0.06, abs=4 * 0.08 / 12**0.5 / 4000**0.5)
    log = np.log10(np.asarray(params.reward.lateral))
    assert log.mean() == pytest.approx(-2.0, abs=4 * 2.0 / 12**0.5 / 4000**0.5)
    assert log.min() < -2.99
    assert log.max() > -1.01


def test_whole_numbers_are_drawn_with_both_ends(made):
    horizon = drawn(made[1], {"horizon": (100, 103)}).horizon
    assert sorted(set(np.asarray(horizon).tolist())) == [100, 101, 102, 103]
    assert horizon.dtype == jnp.int32


def test_a_draw_depends_neither_on_the_other_names_nor_on_their_order(made):
    alone = drawn(made[1], {"lidar.range_sigma": (0.0, 0.1)}, 50)
    among = drawn(made[1], dict(reversed(RANGES.items())), 50)
    np.testing.assert_array_equal(alone.lidar.range_sigma, among.lidar.range_sigma)
    assert not np.array_equal(alone.lidar.range_sigma, drawn(made[1], RANGES, 50, seed=1).lidar.range_sigma)


def test_a_randomised_batch_sees_and_moves_as_each_of_its_environments_should(made):
    env, shared = made
    params, axes = randomize(jax.random.key(3), shared, RANGES, 6)
    batch = st.AutoReset(env, params_axes=axes)
    hash(batch)
    obs, state = jax.jit(lambda key, params: batch.reset(key, params, 6))(jax.random.key(0), params)
    for ranges, longest in zip(np.asarray(obs)[:, :16], np.asarray(params.lidar.range_max), strict=True):
        assert ranges.max() == longest
    noise = env.draw_step(jax.random.key(1), (6,), params)
    action = jnp.tile(jnp.array([2.0, 0.1]), (6, 1))
    after = jax.jit(jax.vmap(env.advance, (0, 0, 0, axes)))(state, action, noise, params)[0]
    moved = np.linalg.norm(after.position - state.position, axis=1)
    np.testing.assert_allclose(moved, 0.1 * np.asarray(params.vehicle.speed_max), atol=1e-4)


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        ({"lidar.sigma": (0.0, 1.0)}, r"no 'lidar.sigma'.*lidar has range_max, range_sigma"),
        ({"radar.sigma": (0.0, 1.0)}, r"no 'radar.sigma'.*the params has tunnel, horizon"),
        ({"lidar": (0.0, 1.0)}, "'lidar' is no number"),
        ({"lidar.n_beams": (8, 16)}, r"'lidar.n_beams' cannot.*static"),
        ({"tunnel.length": (100.0, 200.0)}, r"'tunnel.length' cannot.*stack several"),
        ({"slip.scale": (0.0, 1.0)}, r"no 'slip.scale'.*the params has tunnel, horizon"),
        ({"lidar.range_sigma": (0.2, 0.1)}, r"'lidar.range_sigma' must be finite and not empty, got 0.2 to 0.1"),
        ({"lidar.range_sigma": (0.0, np.nan)}, "must be finite"),
        ({"lidar.range_sigma": LogUniform(0.0, 0.1)}, "must be above 0"),
        ({"horizon": (10.5, 20.0)}, "whole numbers"),
        ({"lidar.range_max": (10.0, 31.0)}, r"'lidar.range_max' goes up to 31 m.*30 m"),
        ({"vehicle.speed_max": (1.0, 2.5)}, r"less one step of 2.5 m/s"),
    ],
)
def test_what_cannot_be_randomised_is_refused_by_name(made, ranges, message):
    with pytest.raises(ValueError, match=message):
        randomize(jax.random.key(0), made[1], ranges, 4)


def test_an_empty_batch_is_refused_and_the_shared_params_stay(made):
    with pytest.raises(ValueError, match="at least 1, got 0"):
        randomize(jax.random.key(0), made[1], {}, 0)
    before = jax.tree.map(np.asarray, made[1])
    drawn(made[1], RANGES, 10)
    jax.tree.map(np.testing.assert_array_equal, before, jax.tree.map(np.asarray, made[1]))
    assert dataclasses.is_dataclass(before)
