"""Slip and wandering errors: the stated statistics, and nothing where nothing moves."""

import jax
import jax.numpy as jnp
import numpy as np

from subterra_jax.parts import odometer as odometry
from subterra_jax.parts import slip, wander

N = 20_000
PARAMS = wander.WanderParams(sigma=0.02, length=30.0)


def test_a_wandering_error_keeps_its_spread_and_loses_its_memory_over_its_length():
    first, *later = jax.random.normal(jax.random.key(0), (151, N))
    value = start = jax.vmap(wander.start_wander, (0, None))(first, PARAMS)
    advance = jax.jit(jax.vmap(wander.advance_wander, (0, None, 0, None)))
    for noise in later:
        value = advance(value, jnp.float32(0.2), noise, PARAMS)
    start, value = np.asarray(start, np.float64), np.asarray(value, np.float64)
    # Standard error of a standard deviation: sigma / sqrt(2 n); of a correlation: (1 - r²) / sqrt(n).
    for sample in (start, value):
        assert abs(sample.std() - 0.02) < 3 * 0.02 / np.sqrt(2 * N)
    expected = np.exp(-1.0)
    assert abs(np.corrcoef(start, value)[0, 1] - expected) < 3 * (1 - expected**2) / np.sqrt(N)


def test_the_size_of_the_steps_does_not_matter_to_a_wandering_error():
    one = wander.advance_wander(jnp.float32(0.02), jnp.float32(30.0), jnp.float32(0.0), PARAMS)
    np.testing.assert_allclose(one, 0.02 * np.exp(-1.0), rtol=1e-5)
    many = jnp.float32(0.02)
    for _ in range(10):
        many = wander.advance_wander(many, jnp.float32(-3.0), jnp.float32(0.0), PARAMS)
    np.testing.assert_allclose(many, one, rtol=1e-5)
    assert wander.advance_wander(jnp.float32(0.02), jnp.float32(0.0), jnp.float32(5.0), PARAMS) == jnp.float32(0.02)


def test_slip_acts_on_the_motion_with_the_stated_spread():
    noise = jax.random.normal(jax.random.key(1), (N, 3))
    states = jax.vmap(slip.start_slip, (0, None))(noise, slip.SlipParams())
    motion = np.asarray(jax.vmap(slip.true_motion, (None, 0))(jnp.array([2.0, 0.1]), states), np.float64)
    expected = 2.0 * np.hypot(0.02, 0.02)
    assert abs(motion[:, 0].std() - expected) < 3 * expected / np.sqrt(2 * N)
    assert abs(motion[:, 1].std() - 0.002) < 3 * 0.002 / np.sqrt(2 * N)
    assert abs(motion[:, 0].mean() - 2.0) < 3 * expected / np.sqrt(N)
    # Each error has a draw of its own: 4.5 standard errors of a correlation of independent numbers.
    errors = np.corrcoef([states.gain, states.yaw, states.wander])
    np.testing.assert_allclose(errors, np.eye(3), atol=4.5 / np.sqrt(N))


def test_a_robot_told_to_stand_stands():
    state = slip.start_slip(jnp.array([3.0, 3.0, 3.0]), slip.SlipParams())
    np.testing.assert_array_equal(slip.true_motion(jnp.zeros(2), state), np.zeros(2))


def test_odometry_measures_the_motion_with_a_scale_that_wanders():
    params = odometry.OdometryParams(0.0, 0.0, 0.0, 0.0, wander=wander.WanderParams(sigma=0.01))
    noise = jax.random.normal(jax.random.key(2), (N, params.n_reset_noise))
    state = jax.vmap(odometry.start_odometry, (0, None))(noise, params)
    advance = jax.vmap(odometry.advance_odometry, (0, None, None, 0, None))
    step_noise = jax.random.normal(jax.random.key(3), (N, params.n_step_noise))
    state = advance(state, jnp.array([1.0, 0.0]), jnp.float32(0.1), step_noise, params)
    distance = np.asarray(state.distance, np.float64)
    assert abs(distance.std() - 0.001) < 3 * 0.001 / np.sqrt(2 * N)


def test_a_bias_of_one_direction_does_not_cancel_out_and_back():
    params = odometry.OdometryParams(0.0, 0.0, 0.0, 0.0, backward_bias_sigma=0.02)
    noise = jax.random.normal(jax.random.key(2), (N, params.n_reset_noise))
    start = jax.vmap(odometry.start_odometry, (0, None))(noise, params)
    advance = jax.vmap(odometry.advance_odometry, (0, None, None, None, None, None))
    step = lambda backward: advance(  # noqa: E731
        start, jnp.array([1.0, 0.0]), jnp.float32(1.0), jnp.zeros(2), params, backward
    )
    np.testing.assert_array_equal(step(False).distance, np.ones(N, np.float32))
    assert abs(np.asarray(step(True).distance, np.float64).std() - 0.02) < 3 * 0.02 / np.sqrt(2 * N)
