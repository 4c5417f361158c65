"""The planar robot that obeys late: its lag is what it was asked to be."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.b2 import tasks
from subterra_jax.b2.transfer import Lag, Nod, stand_in

LAG = Lag(speed=0.6, yaw_rate=0.25, speed_gain=0.9, yaw_rate_gain=0.8)


@pytest.fixture(scope="module")
def run():
    env, params = st.make("Subterra/TraverseShort-v1", vehicle=tasks.VEHICLE, start=tasks.START)
    late = stand_in(env, LAG)
    actions = jnp.asarray(np.repeat(np.random.default_rng(0).uniform([0.0, -0.3], [0.8, 0.3], (8, 2)), 6, axis=0))

    @jax.jit
    def drive(key):
        _, state = late.reset(key, params)

        def step(state, action):
            _, state, *_ = late.step(key, state, action.astype(jnp.float32), params)
            return state, jnp.concatenate([state.command, state.position, state.heading[None]])

        return jax.lax.scan(step, state, actions)[1]

    return np.asarray(actions), np.asarray(drive(jax.random.key(0)))


def test_a_step_of_the_command_is_followed_exponentially(run):
    actions, told = run
    expected = LAG.speed_gain * actions[0, 0] * (1.0 - np.exp(-0.2 * np.arange(1, 7) / LAG.speed))
    np.testing.assert_allclose(told[:6, 0], expected, rtol=1e-4)


def test_the_robot_moves_as_fast_as_its_lagged_command_says(run):
    _, told = run
    moved = np.hypot(*np.diff(told[:, 2:4], axis=0).T)
    np.testing.assert_allclose(moved, 0.2 * told[1:, 0], rtol=1e-2)


def test_beams_that_point_down_end_on_the_ballast_and_no_others_change():
    env, params = st.make("Subterra/TraverseShort-v1", vehicle=tasks.VEHICLE, start=tasks.START)
    level = stand_in(env, nod=Nod(0.0, 0.0, 0.0))
    nose_down = stand_in(env, nod=Nod(0.1, 0.0, 0.0, height=0.75))
    key = jax.random.key(0)
    (flat, _), (bent, _) = (jax.jit(one.reset)(key, params) for one in (level, nose_down))
    assert float(bent[0]) == pytest.approx(0.75 / np.sin(0.1), rel=1e-5)
    assert float(flat[0]) > float(bent[0])
    np.testing.assert_array_equal(bent[4:13], flat[4:13])  # to the sides and behind
