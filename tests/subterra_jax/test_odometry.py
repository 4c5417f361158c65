"""Dead reckoning: the truth when nothing drifts, and the stated statistics when it does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.parts import odometer as odometry
from subterra_jax.parts.wander import WanderParams

TASK = "Subterra/TraverseShort-v1"
N, T = 4000, 50


def drift(params: odometry.OdometryParams, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Dead-reckoned distance and heading, `(N, T)`, of N episodes at 1 m/s and 0.01 rad/s."""
    distance, heading = _drift(jax.tree.map(jnp.float32, params), seed)
    return np.asarray(distance).T, np.asarray(heading).T


@jax.jit
def _drift(params: odometry.OdometryParams, seed: int) -> tuple[jax.Array, jax.Array]:
    """Series `(T, N)`."""
    bias_key, noise_key = jax.random.split(jax.random.key(seed))
    state = jax.vmap(odometry.start_odometry, (0, None))(jax.random.normal(bias_key, (N, 2)), params)

    def step(state, noise):
        advance = jax.vmap(odometry.advance_odometry, (0, None, None, 0, None))
        state = advance(state, jnp.array([1.0, 0.01]), jnp.float32(0.1), noise, params)
        return state, (state.distance, state.heading)

    return jax.lax.scan(step, state, jax.random.normal(noise_key, (T, N, 2)))[1]


def test_without_errors_dead_reckoning_is_the_truth():
    distance, heading = drift(odometry.OdometryParams(0.0, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(distance, np.broadcast_to(0.1 * np.arange(1, T + 1), (N, T)), rtol=1e-5)
    np.testing.assert_allclose(heading, np.broadcast_to(0.001 * np.arange(1, T + 1), (N, T)), rtol=1e-5)


def test_without_errors_the_observed_odometry_is_the_path_driven():
    env, params = st.make(TASK, odometry=odometry.OdometryParams(0.0, 0.0, 0.0, 0.0))
    _, state = jax.jit(env.reset)(jax.random.key(0), params)
    start = float(state.heading)
    step = jax.jit(env.step)
    for k in range(30):
        obs, state, *_ = step(jax.random.key(k), state, jnp.array([1.5, 0.02]), params)
    assert float(obs[16]) == pytest.approx(30 * 0.15, rel=1e-5)
    assert float(obs[17]) == pytest.approx(float(state.heading) - start, abs=1e-5)


@pytest.mark.parametrize("channel", [0, 1], ids=["distance", "heading"])
def test_noise_and_bias_are_recovered_within_three_standard_errors(channel):
    params = odometry.OdometryParams(0.01, 0.02, 0.001, 0.002)
    steps = np.diff(drift(params)[channel], axis=1)
    motion, noise_sigma, bias_sigma = [(0.1, 0.01, 0.02 * 0.1), (0.001, 0.001, 0.002 * 0.1)][channel]
    # Within an episode the bias is constant, so that the spread of its steps is the noise.
    noise = np.sqrt(np.mean(np.var(steps, axis=1, ddof=1)))
    assert noise == pytest.approx(noise_sigma, abs=3 * noise_sigma / np.sqrt(2 * N * (T - 2)))
    of_means = np.var(steps.mean(axis=1), ddof=1)
    expected = bias_sigma**2 + noise_sigma**2 / (T - 1)
    assert of_means == pytest.approx(expected, abs=3 * expected * np.sqrt(2 / N))
    assert steps.mean() == pytest.approx(motion, abs=3 * np.sqrt(expected / N))


def test_every_error_of_an_episode_has_a_draw_of_its_own():
    params = odometry.OdometryParams(0.0, 0.02, 0.0, 0.002, WanderParams(sigma=0.01), backward_bias_sigma=0.02)
    noise = jax.random.normal(jax.random.key(4), (N, params.n_reset_noise))
    state = jax.vmap(odometry.start_odometry, (0, None))(noise, params)
    errors = np.corrcoef([state.distance_bias, state.heading_bias, state.wander, state.backward_bias])
    np.testing.assert_allclose(errors, np.eye(4), atol=4.5 / np.sqrt(N))  # of independent numbers: 1 / sqrt(N)


def test_dead_reckoned_headings_stay_within_half_a_turn():
    state = odometry.start_odometry(jnp.zeros(2), odometry.OdometryParams())
    for _ in range(60):
        state = odometry.advance_odometry(
            state, jnp.array([0.0, 1.5]), jnp.float32(0.1), jnp.zeros(2), odometry.OdometryParams()
        )
        assert abs(float(state.heading)) <= np.float32(np.pi)
