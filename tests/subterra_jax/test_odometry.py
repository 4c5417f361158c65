"""Odometer, slip and vehicle: exact arcs where nothing drifts, errors with draws of their own, contact, the foot."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.baselines import stations
from subterra_jax.parts import odometer as odometry
from subterra_jax.parts import slip
from subterra_jax.parts import unicycle as vehicle
from subterra_jax.parts.slip import WanderParams
from subterra_jax.tunnel import Tunnel, foot
from tests.subterra_jax import tunnels

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


def fresh(part, noise, **params):
    """State of a part at the start of an episode, from its draw."""
    env, made = st.make("Subterra/StopAtShort-v1", tunnel="control")
    state = jax.eval_shape(env.reset, jax.random.key(0), made)[1]
    return part.begin(noise, state, made.replace(**params))


def test_every_error_of_an_episode_has_a_draw_of_its_own():
    params = odometry.OdometryParams(0.0, 0.02, 0.0, 0.002, WanderParams(sigma=0.01), backward_bias_sigma=0.02)
    noise = jax.random.normal(jax.random.key(4), (N, params.n_reset_noise))
    state = jax.vmap(lambda row: fresh(odometry.Odometer(), row, odometry=params))(noise)
    errors = np.corrcoef([state.distance_bias, state.heading_bias, state.wander, state.backward_bias])
    np.testing.assert_allclose(errors, np.eye(4), atol=4.5 / np.sqrt(N))  # of independent numbers: 1 / sqrt(N)


def test_the_size_of_the_steps_does_not_matter_to_a_wandering_error():
    one = slip.advance_wander(jnp.float32(0.02), jnp.float32(30.0), jnp.float32(0.0), PARAMS)
    np.testing.assert_allclose(one, 0.02 * np.exp(-1.0), rtol=1e-5)
    many = jnp.float32(0.02)
    for _ in range(10):
        many = slip.advance_wander(many, jnp.float32(-3.0), jnp.float32(0.0), PARAMS)
    np.testing.assert_allclose(many, one, rtol=1e-5)
    assert slip.advance_wander(jnp.float32(0.02), jnp.float32(0.0), jnp.float32(5.0), PARAMS) == jnp.float32(0.02)
    assert np.isfinite(jax.grad(slip.advance_wander, 1)(jnp.float32(0.02), jnp.float32(0.0), jnp.float32(5.0), PARAMS))
    # As the filters have it: after a long way nothing is left of it, and its size is what it was.
    np.testing.assert_allclose(stations._process(PARAMS, jnp.float32(1e6)), [0.0, 4e-4], rtol=1e-6)


def test_a_robot_told_to_stand_stands():
    state = fresh(slip.Slip(), jnp.array([3.0, 3.0, 3.0]), slip=slip.SlipParams())
    np.testing.assert_array_equal(slip.true_motion(jnp.zeros(2), state), np.zeros(2))


VEHICLE = jax.tree.map(jnp.asarray, vehicle.VehicleParams())
clearance, foot_of_each = jax.jit(vehicle.clearance), jax.jit(jax.vmap(foot, (None, 0, 0)))


def touching(tunnel, position, station):
    """True where a robot at a place is in contact."""
    clear = clearance(tunnel, jnp.array(position, jnp.float32), jnp.float32(station))
    return bool(vehicle.in_contact(tunnel, clear, jnp.float32(station), VEHICLE))


@pytest.mark.parametrize("command", [(2.0, 0.0), (1.0, 1.5), (2.0, -0.3), (0.0, 1.0), (1.7, 1e-4)])
def test_a_constant_command_is_followed_along_its_exact_arc(command):
    v, w = command
    position, heading = jnp.array([3.0, -1.0]), jnp.float32(0.5)
    for _ in range(10):
        position, heading = vehicle.follow_arc(position, heading, jnp.array(command), VEHICLE.period)
    if w == 0.0:
        expected = np.array([3.0, -1.0]) + v * np.array([np.cos(0.5), np.sin(0.5)])
    else:
        expected = np.array([3.0, -1.0]) + v / w * np.array(
            [np.sin(0.5 + w) - np.sin(0.5), np.cos(0.5) - np.cos(0.5 + w)]
        )
    np.testing.assert_allclose(position, expected, atol=2e-5)
    assert float(heading) == pytest.approx(0.5 + w, abs=1e-5)


@pytest.mark.parametrize("rate", [1.5, -1.5])
def test_headings_stay_within_half_a_turn(rate):
    heading = jnp.float32(0.0)
    for _ in range(100):
        _, heading = vehicle.follow_arc(jnp.zeros(2), heading, jnp.array([0.0, rate]), VEHICLE.period)
        assert abs(float(heading)) <= np.float32(np.pi)
    assert float(heading) == pytest.approx((10.0 * rate + np.pi) % (2 * np.pi) - np.pi, abs=1e-4)


@pytest.mark.parametrize(
    ("action", "obeyed"),
    [
        ((1.0, 0.5), (1.0, 0.5)),
        ((9.0, -9.0), (2.0, -1.5)),
        ((-1.0, 1.4), (0.0, 1.4)),
        ((np.nan, 1.0), (0.0, 1.0)),
        ((np.inf, -np.inf), (2.0, -1.5)),
        ((-np.inf, np.nan), (0.0, 0.0)),
    ],
)
def test_actions_are_clipped_and_never_rejected(action, obeyed):
    np.testing.assert_array_equal(vehicle.clip_action(jnp.array(action), VEHICLE), np.float32(obeyed))


@pytest.mark.parametrize(("lateral", "touches"), [(2.424, False), (2.426, True), (-2.424, False), (-2.426, True)])
def test_contact_begins_where_the_footprint_meets_the_wall(plan_of, lateral, touches):
    tunnel = Tunnel.from_plan(plan_of(tunnels.tunnel_arrays(tunnels.straight(20.0))), "smooth")
    assert touching(tunnel, [10.1, lateral], 10.1) is touches


@pytest.mark.parametrize(("station", "touches"), [(-0.39, False), (-0.41, True), (20.39, False), (20.41, True)])
def test_a_robot_wholly_outside_a_mouth_is_in_contact(plan_of, station, touches):
    tunnel = Tunnel.from_plan(plan_of(tunnels.tunnel_arrays(tunnels.straight(20.0))), "smooth")
    assert touching(tunnel, [station, 0.0], station) is touches


@pytest.mark.parametrize("radius", [60.0, 300.0])
def test_the_foot_on_the_centreline_is_found_from_the_previous_station(plan_of, radius):
    pieces = tunnels.s_bend(150.0, radius)
    tunnel = Tunnel.from_plan(plan_of(tunnels.tunnel_arrays(pieces)), "smooth")
    truth, rng = tunnels.Plan(pieces), np.random.default_rng(0)
    station, lateral = rng.uniform(0.0, 150.0, 1000), rng.uniform(-2.4, 2.4, 1000)
    near = station + rng.uniform(-0.2, 0.2, 1000)
    found = foot_of_each(tunnel, np.float32(truth.point(station, lateral)), np.float32(near))
    np.testing.assert_allclose(found.station, station, atol=1.5e-3)
    np.testing.assert_allclose(found.lateral, lateral, atol=1.5e-3)
    np.testing.assert_allclose(found.half_width, 2.825, atol=1e-5)
