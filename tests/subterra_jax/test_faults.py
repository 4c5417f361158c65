"""Faults: none at severity 0, and each as often and as bad as its params say."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.parts import faults

N, BEAMS = 4000, 16
ZERO = faults.FaultParams(
    dropout_rate=0.0, dust_rate=0.0, freeze_rate=0.0, delay=0.0, wet_share=0.0, severity_low=4, severity_high=4
)


@functools.cache
def _begin():
    """Faults at the start of episodes; compiled, since eager code would compile every operation."""
    env, params = st.make("Subterra/Faulted-v1", tunnel="control")

    def begin(key, own):
        return env.begin(env.draw_reset(key, (), params), params.replace(faults=own)).faults

    return jax.jit(jax.vmap(begin, (0, None)))


def begun(params, n=N):
    return _begin()(jax.random.split(jax.random.key(0), n), params)


def run(params, steps, n=N):
    """States after each step, with the time as row of `seen`."""
    advance = jax.jit(jax.vmap(faults.advance_faults, (0, None, 0, None, None)), static_argnums=3)
    state, kept = begun(params, n), []
    for k in range(steps):
        draw = jax.random.uniform(jax.random.key(10 + k), (n, 5 + BEAMS))
        state = advance(state, jnp.full(6, k + 1.0), draw, BEAMS, params)
        kept.append(state)
    return kept


def each(function, axes):
    """A function of many robots, compiled as a whole."""
    return jax.jit(jax.vmap(function, axes))


def test_every_severity_is_drawn_alike():
    severity = np.asarray(begun(faults.FaultParams()).severity)
    counts = np.array([(severity == k).sum() for k in range(5)])
    assert counts.sum() == N
    assert np.abs(counts - N / 5).max() < 4 * np.sqrt(N * 0.2 * 0.8)


def test_at_severity_0_nothing_is_corrupted():
    params = faults.FaultParams(severity_low=0, severity_high=0)
    state = run(params, 30)[-1]
    draw = jax.random.uniform(jax.random.key(5), (N, 5 + BEAMS))
    ranges = jnp.full((N, BEAMS), 3.0)
    corrupted = each(faults.corrupt, (0, 0, 0, None, None))(ranges, state, draw, jnp.float32(30.0), params)
    np.testing.assert_array_equal(corrupted, ranges)
    assert not (state.freeze_left > 0.0).any()
    np.testing.assert_array_equal(each(faults.observed, (0, None))(state, params)[:, 0], 30.0)
    np.testing.assert_array_equal(each(faults.grip, (0, None, None))(state, np.float32(5.0), params), 1.0)


def test_dust_reflects_the_stated_share_of_beams_somewhere_before_the_wall():
    params = dataclasses.replace(ZERO, dust_rate=0.15)
    draw = jax.random.uniform(jax.random.key(5), (N, 5 + BEAMS))
    ranges = np.full((N, BEAMS), 3.0, np.float32)
    corrupted = each(faults.corrupt, (0, 0, 0, None, None))(ranges, begun(params), draw, np.float32(30.0), params)
    short = np.asarray(corrupted)[np.asarray(corrupted) < 3.0]
    assert abs(short.size / corrupted.size - 0.15) < 4 * np.sqrt(0.15 * 0.85 / corrupted.size)
    assert abs(short.mean() - 1.5) < 4 * 3.0 / np.sqrt(12 * short.size)


def test_dropped_beams_are_one_sector_that_reports_the_largest_range():
    params = dataclasses.replace(ZERO, dropout_rate=0.5, dropout_share=0.75)
    state = run(params, 5)[-1]
    draw = jnp.zeros(5 + BEAMS)
    corrupted = np.asarray(
        jax.jit(jax.vmap(faults.corrupt, (0, 0, None, None, None)))(
            jnp.full((N, BEAMS), 3.0), state, draw, jnp.float32(30.0), params
        )
    )
    out = corrupted == 30.0
    some = out.any(axis=1)
    assert some.mean() > 0.5
    assert (corrupted[~out] == 3.0).all()
    # One sector: round the turn, beams change from in to out exactly once.
    changes = (out[some] != np.roll(out[some], 1, axis=1)).sum(axis=1)
    assert (changes == 2).all()
    assert out[some].sum(axis=1).max() <= 12


@pytest.mark.parametrize(("name", "longest"), [("dropout", 40.0), ("freeze", 30.0)])
def test_a_fault_begins_as_often_as_its_rate_and_lasts_up_to_its_longest(name, longest):
    params = dataclasses.replace(ZERO, **{f"{name}_rate": 0.02, f"{name}_steps": longest}, spread=0.0)
    left = np.stack([np.asarray(getattr(state, f"{name}_left")) for state in run(params, 60)])
    idle, begins = left[:-1] <= 0.0, (left[:-1] <= 0.0) & (left[1:] > 0.0)
    assert abs(begins.sum() - 0.02 * idle.sum()) < 4 * np.sqrt(0.02 * idle.sum())
    np.testing.assert_array_equal(left[1:][~idle], left[:-1][~idle] - 1.0)
    lengths = left[1:][begins]
    assert (lengths.min(), lengths.max()) == (1.0, longest)
    assert abs(lengths.mean() - 0.5 * (longest + 1.0)) < 4 * lengths.std() / np.sqrt(lengths.size)


def test_observations_are_as_late_as_the_severity_says():
    params = dataclasses.replace(ZERO, delay=4.0)
    state = run(params, 8, n=3)[-1]
    observed = each(faults.observed, (0, None))
    np.testing.assert_array_equal(observed(state, params)[:, 0], 4.0)
    milder = dataclasses.replace(state, severity=jnp.full(3, 2.0))
    np.testing.assert_array_equal(observed(milder, params)[:, 0], 6.0)


def test_wet_rail_takes_the_stated_share_of_the_speed_in_whole_patches():
    params = dataclasses.replace(ZERO, wet_share=0.3)
    state = jax.tree.map(lambda leaf: leaf[0], begun(params, 1))
    places = np.arange(0.0, 20_000.0, 2.5, np.float32)
    grip = np.asarray(each(faults.grip, (None, 0, None))(state, places, params))
    assert set(np.unique(grip)) == {np.float32(0.7), np.float32(1.0)}
    patches = grip.reshape(-1, 4)
    assert (patches == patches[:, :1]).all()
    assert abs((patches[:, 0] < 1.0).mean() - 0.3) < 4 * np.sqrt(0.3 * 0.7 / len(patches))


def test_a_frozen_odometer_loses_what_is_driven_meanwhile():
    always = dataclasses.replace(ZERO, freeze_rate=1.0, freeze_steps=1000.0)
    env, params = st.make("Subterra/Faulted-v1", tunnel="control", faults=always)
    _, state = jax.jit(env.reset)(jax.random.key(0), params)
    start = float(state.station)
    step, readings = jax.jit(env.step), []
    for k in range(6):
        obs, state, *_ = step(jax.random.key(k), state, jnp.array([1.0, 0.0]), params)
        readings.append(float(obs[16]))
    assert readings[0] - float(state.faults.origin[0]) == pytest.approx(0.1, abs=0.05)
    assert np.abs(np.diff(readings)).max() < 0.05  # the noise of its steps alone
    assert float(state.station) - start == pytest.approx(0.6, abs=0.1)
