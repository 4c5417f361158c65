"""The IMU reads gravity at rest, gives the motion back when it is integrated, and is as noisy as it says."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.parts import ImuParams
from subterra_jax.parts.imu import GRAVITY
from subterra_jax.parts.unicycle import VehicleParams

TASK, GRADE = "Subterra/TraverseShort-v1", 0.04
IDEAL = ImuParams(*[0.0] * 6)
# Written down a second time, from the calibration of the Avia's BMI088 in GEODE; the first biases are ours.
STATED = {
    "accel_density": 5.574e-3,  # m/s²/√Hz
    "gyro_density": 5.144e-3,  # rad/s/√Hz
    "accel_walk": 1.208e-4,  # m/s²/√s
    "gyro_walk": 1.088e-4,  # rad/s/√s
    "accel_bias": 0.02,  # m/s²
    "gyro_bias": 0.003,  # rad/s
    "samples": 20,
}


def made(imu, grade=GRADE, **overrides):
    """A task in a bend of 40 m radius that climbs; its LiDAR in three dimensions brings the ground along."""
    station = np.linspace(0.0, 60.0, 121)
    xy = 40.0 * np.stack([np.sin(station / 40.0), 1.0 - np.cos(station / 40.0)], axis=-1)
    plan = st.tunnel.from_centreline(xy, 2.8, elevation=grade * station)
    return st.make(TASK, tunnel=plan, sensor=np.array([[1.0, 0.0, 0.0]]), imu=imu, **overrides)


def drive(env, params, actions, key=0):
    """Samples `(steps, n, 6)` and states of a drive."""
    _, state = env.reset(jax.random.key(key), params)

    def one(state, now):
        action, key = now
        state, *_ = env.advance(state, action, env.draw_step(key, (), params), params)
        return state, state

    keys = jax.random.split(jax.random.key(key + 1), len(actions))
    _, states = jax.jit(lambda s: jax.lax.scan(one, s, (jnp.asarray(actions, jnp.float32), keys)))(state)
    return state, states


def rotation(vector):
    """The rotation matrix of a rotation vector, in float64."""
    angle = np.linalg.norm(vector)
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


@pytest.mark.slow
@pytest.mark.parametrize("rate", [100, 200, 400])
def test_ten_seconds_integrated_give_the_motion_to_a_millimetre_and_a_hundredth_of_a_degree(rate):
    env, params = made(dataclasses.replace(IDEAL, samples=rate // 10))
    rng = np.random.default_rng(rate)
    actions = np.stack([rng.uniform(0.5, 1.6, 100), 0.03 + rng.uniform(-0.1, 0.1, 100)], axis=-1)
    first, states = drive(env, params, actions)
    samples = np.asarray(states.imu.samples, np.float64).reshape(-1, 6)
    assert len(samples) == 10 * rate
    turned = np.asarray(first.imu.axes, np.float64).T
    place = np.array([*np.asarray(first.position, np.float64), GRADE * float(first.station)])
    velocity = np.zeros(3)
    for sample in samples:
        velocity = velocity + (turned @ sample[:3] - [0.0, 0.0, GRAVITY]) / rate
        place = place + velocity / rate
        turned = turned @ rotation(sample[3:] / rate)
    end = [*np.asarray(states.position[-1], np.float64), GRADE * float(states.station[-1])]
    assert np.linalg.norm(place - end) < 1e-3
    assert float(states.station[-1] - first.station) > 8.0
    ahead = np.asarray(states.imu.axes[-1, 0])
    heading = float(states.heading[-1])
    assert np.arctan2(ahead[1], ahead[0]) == pytest.approx(heading, abs=1e-4)
    away = np.arccos(np.clip((np.trace(turned @ np.asarray(states.imu.axes[-1])) - 1.0) / 2.0, -1.0, 1.0))
    assert np.rad2deg(away) < 0.01


def allan(values, rate, tau):
    """Allan deviation at one averaging time, overlapping."""
    n = round(tau * rate)
    total = np.concatenate([[0.0], np.cumsum(values)]) / rate
    second = total[2 * n :] - 2.0 * total[n:-n] + total[: -2 * n]
    return np.sqrt(np.mean(second**2) / 2.0) / tau


def check_densities(n_steps, taus):
    """Compare the noise at rest with the stated sizes, in each axis: those of `STATED`, whatever the params say."""
    env, params = made(ImuParams(samples=10), grade=0.0)
    _, states = drive(env, params, np.zeros((n_steps, 2)))
    samples = np.asarray(states.imu.samples, np.float64).reshape(-1, 6)
    bias = np.asarray(states.imu.bias, np.float64)
    deviation = {tau: np.array([allan(values, 100, tau) for values in samples.T]) for tau in taus}
    for name, axes in (("accel", slice(0, 3)), ("gyro", slice(3, 6))):
        density, walk = STATED[f"{name}_density"], STATED[f"{name}_walk"]
        for tau, found in deviation.items():
            expected = np.hypot(density / np.sqrt(tau), walk * np.sqrt(tau / 3.0))
            if tau <= 30.0:  # an hour has few longer intervals, so of those the three axes together alone
                np.testing.assert_allclose(found[axes], expected, rtol=0.15)
            intervals = 3 * len(samples) / (100.0 * tau)
            within = min(4.0 / np.sqrt(2.0 * intervals), 0.15)  # four standard errors
            assert np.sqrt(np.mean(found[axes] ** 2)) == pytest.approx(expected, rel=within)
        assert np.std(np.diff(bias[:, axes], axis=0)) == pytest.approx(walk * np.sqrt(0.1), rel=0.05)


def test_the_noise_of_a_minute_and_a_half_has_the_stated_densities():
    check_densities(900, (0.05, 0.5))


@pytest.mark.slow
def test_the_allan_deviation_of_an_hour_at_rest_has_the_stated_densities_and_walks():
    """At 60 s the white noise alone gives four fifths of it: without the walk of the biases this fails."""
    check_densities(36_000, (0.05, 1.0, 10.0, 30.0, 60.0))


def test_sizes_are_those_stated():
    assert {field.name: getattr(ImuParams(), field.name) for field in dataclasses.fields(ImuParams)} == STATED


def test_without_heights_the_ground_is_level():
    env, params = st.make(TASK, "control", imu=dataclasses.replace(IDEAL, samples=1))
    samples = env.reset(jax.random.key(0), params)[1].imu.samples
    np.testing.assert_allclose(samples, [[0.0, 0.0, GRAVITY, 0.0, 0.0, 0.0]], atol=1e-6)


def test_no_sample_at_all_is_refused():
    with pytest.raises(ValueError, match="one sample a step or more, got samples=0"):
        made(ImuParams(samples=0))


@pytest.mark.parametrize("period", [0.1, 0.05])
def test_a_start_a_turn_and_a_bend_are_measured_with_their_size_and_sign_at_any_control_period(period):
    env, params = made(dataclasses.replace(IDEAL, samples=10), grade=0.0, vehicle=VehicleParams(period=period))
    speed, yaw_rate = 1.25, 0.4
    first, states = drive(env, params, np.tile([speed, yaw_rate], (2, 1)))
    interval = period / 10
    start, later = np.asarray(states.imu.samples, np.float64)
    assert start[:, 0].sum() * interval == pytest.approx(speed, abs=2e-3), "from standing to its speed"
    np.testing.assert_allclose(start[:, 5], yaw_rate, rtol=1e-3)  # to the left is positive
    np.testing.assert_allclose(later[:, 5], yaw_rate, rtol=1e-3)
    np.testing.assert_allclose(later[:, 1], speed * yaw_rate, atol=5e-3)  # inwards, to the left
    np.testing.assert_allclose(later[:, 2], GRAVITY, rtol=1e-4)
    assert float(states.heading[-1] - first.heading) == pytest.approx(2 * period * yaw_rate, rel=1e-3)
