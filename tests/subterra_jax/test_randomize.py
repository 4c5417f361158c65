"""Environments that differ: each draws within its ranges, and a batch of them steps like each alone."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.randomization import LogUniform, randomize

TASK = "Subterra/TraverseShort-v1"
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
