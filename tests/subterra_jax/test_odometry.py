"""Odometer and slip: the truth where nothing drifts, and errors with draws of their own; `net` has their sizes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.parts import odometer as odometry
from subterra_jax.parts import slip
from subterra_jax.parts.slip import WanderParams

TASK = "Subterra/TraverseShort-v1"
N, T = 20_000, 50
PARAMS = WanderParams(sigma=0.02, length=30.0)


def test_without_errors_the_observed_odometry_is_the_path_driven():
    env, params = st.make(TASK, odometry=odometry.OdometryParams(0.0, 0.0, 0.0, 0.0))
    _, state = jax.jit(env.reset)(jax.random.key(0), params)
    start = float(state.heading)
    step = jax.jit(env.step)
    for k in range(30):
        obs, state, *_ = step(jax.random.key(k), state, jnp.array([1.5, 0.02]), params)
    assert float(obs[16]) == pytest.approx(30 * 0.15, rel=1e-5)
    assert float(obs[17]) == pytest.approx(float(state.heading) - start, abs=1e-5)


def begun(part, noise, **params):
    """State of a part at the start of an episode, from its draw."""
    env, made = st.make("Subterra/StopAtShort-v1", tunnel="control")
    state = jax.eval_shape(env.reset, jax.random.key(0), made)[1]
    return part.begin(noise, state, made.replace(**params))


def test_every_error_of_an_episode_has_a_draw_of_its_own():
    params = odometry.OdometryParams(0.0, 0.02, 0.0, 0.002, WanderParams(sigma=0.01), backward_bias_sigma=0.02)
    noise = jax.random.normal(jax.random.key(4), (N, params.n_reset_noise))
    state = jax.vmap(lambda row: begun(odometry.Odometer(), row, odometry=params))(noise)
    errors = np.corrcoef([state.distance_bias, state.heading_bias, state.wander, state.backward_bias])
    np.testing.assert_allclose(errors, np.eye(4), atol=4.5 / np.sqrt(N))  # of independent numbers: 1 / sqrt(N)


def test_distance_and_heading_have_noise_of_their_own():
    params = odometry.OdometryParams(0.01, 0.0, 0.001, 0.0)
    state = begun(odometry.Odometer(), jnp.zeros(2), odometry=params)
    after = [odometry.advance_odometry(state, jnp.zeros(2), jnp.float32(0.1), row, params) for row in jnp.eye(2)]
    np.testing.assert_allclose([[one.distance, one.heading] for one in after], [[0.01, 0.0], [0.0, 0.001]], rtol=1e-6)


def test_dead_reckoned_headings_stay_within_half_a_turn():
    state = begun(odometry.Odometer(), jnp.zeros(2), odometry=odometry.OdometryParams())
    for _ in range(60):
        state = odometry.advance_odometry(
            state, jnp.array([0.0, 1.5]), jnp.float32(0.1), jnp.zeros(2), odometry.OdometryParams()
        )
        assert abs(float(state.heading)) <= np.float32(np.pi)


def test_a_wandering_error_keeps_its_spread_and_loses_its_memory_over_its_length():
    first, *later = jax.random.normal(jax.random.key(0), (151, N))
    value = start = PARAMS.sigma * first
    advance = jax.jit(jax.vmap(slip.advance_wander, (0, None, 0, None)))
    for noise in later:
        value = advance(value, jnp.float32(0.2), noise, PARAMS)
    start, value = np.asarray(start, np.float64), np.asarray(value, np.float64)
    # Standard error of a standard deviation: sigma / sqrt(2 n); of a correlation: (1 - r²) / sqrt(n).
    for sample in (start, value):
        assert abs(sample.std() - 0.02) < 3 * 0.02 / np.sqrt(2 * N)
    expected = np.exp(-1.0)
    assert abs(np.corrcoef(start, value)[0, 1] - expected) < 3 * (1 - expected**2) / np.sqrt(N)


def test_the_size_of_the_steps_does_not_matter_to_a_wandering_error():
    one = slip.advance_wander(jnp.float32(0.02), jnp.float32(30.0), jnp.float32(0.0), PARAMS)
    np.testing.assert_allclose(one, 0.02 * np.exp(-1.0), rtol=1e-5)
    many = jnp.float32(0.02)
    for _ in range(10):
        many = slip.advance_wander(many, jnp.float32(-3.0), jnp.float32(0.0), PARAMS)
    np.testing.assert_allclose(many, one, rtol=1e-5)
    assert slip.advance_wander(jnp.float32(0.02), jnp.float32(0.0), jnp.float32(5.0), PARAMS) == jnp.float32(0.02)


def test_slips_have_the_stated_spread_and_each_a_draw_of_its_own():
    noise = jax.random.normal(jax.random.key(1), (N, 3))
    states = jax.vmap(lambda row: begun(slip.Slip(), row, slip=slip.SlipParams()))(noise)
    motion = np.asarray(jax.vmap(slip.true_motion, (None, 0))(jnp.array([2.0, 0.1]), states), np.float64)
    for channel, expected in enumerate((2.0 * np.hypot(0.02, 0.02), 0.002)):
        assert abs(motion[:, channel].std() - expected) < 3 * expected / np.sqrt(2 * N)
    errors = np.corrcoef([states.gain, states.yaw, states.wander])
    np.testing.assert_allclose(errors, np.eye(3), atol=4.5 / np.sqrt(N))  # of independent numbers: 1 / sqrt(N)


def test_a_robot_told_to_stand_stands():
    state = begun(slip.Slip(), jnp.array([3.0, 3.0, 3.0]), slip=slip.SlipParams())
    np.testing.assert_array_equal(slip.true_motion(jnp.zeros(2), state), np.zeros(2))
