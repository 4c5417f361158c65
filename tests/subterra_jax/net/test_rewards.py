"""Rewards and drift: docs/tasks.md, the terms of the reward, what the odometer and the plant err by."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.subterra_jax.net import robots
from tests.subterra_jax.net.robots import FEW, MANY, PERIOD


def reward_cases(id):
    """States before and after single steps: on the way, at a stop and at a contact, with commands and infos."""
    n = FEW
    start = robots.placed(id, robots.fresh(id, n), np.random.default_rng(0).uniform(20.0, 55.0, n))
    rng = np.random.default_rng(1)
    first = np.stack([rng.uniform(0.0, 2.0, n), rng.uniform(-1.0, 1.0, n)], -1)
    second = np.stack([rng.uniform(0.0, 2.0, n), rng.uniform(-1.0, 1.0, n)], -1)
    moving, *_ = robots.advanced(id, start, first)
    yield moving, first, second
    halt = start
    for k in range(9):
        halt, *_ = robots.advanced(id, halt, np.zeros(2), key=k)
    yield halt, np.zeros((n, 2)), np.zeros((n, 2))
    yield robots.placed(id, moving, 30.0, 2.6), first, second


@pytest.mark.parametrize("id", ["Subterra/StopAt-v1", "Subterra/StopAtShort-v1"])
def test_the_terms_of_the_reward_of_a_goal_are_those_that_are_written_down(id):
    tolerance, stops, contacts = (0.25 if "Short" in id else 1.0), 0, 0
    for before, previous, command in reward_cases(id):
        after, gain, _, _, info = robots.advanced(id, before, command)
        info = {name: np.asarray(value, np.float64) for name, value in info.items()}
        goal = np.asarray(before.goal.station, np.float64)
        error, error_before = np.abs(info["station"] - goal), np.abs(np.asarray(before.station) - goal)
        stop, contact = info["stopped"], info["contact"]
        expected = {
            "progress": 0.05 * (error_before - error),
            "terminal": 4.0 * (stop * (error <= tolerance)),
            "precision": 4.0 * stop * np.exp(-error / tolerance),
            "miss": -0.05 * error * np.maximum(stop, contact),
            "crash": -1.0 * contact,
            "time": np.full(len(goal), -0.002),
            "lateral": -0.01 * np.abs(info["lateral"]) / info["half_width"],
            "jerk": -0.003 * np.abs(command - previous).sum(axis=1),
        }
        for name, values in expected.items():
            np.testing.assert_allclose(info[f"reward_{name}"], values, atol=3e-5, err_msg=name)
        np.testing.assert_allclose(gain, sum(expected.values()), atol=1e-4)
        np.testing.assert_array_equal(info["station"], after.station)
        stops, contacts = stops + stop.sum(), contacts + contact.sum()
    assert stops == FEW
    assert contacts >= 0.9 * FEW


def test_a_stop_pays_less_the_further_it_is_from_the_goal_and_a_far_one_costs():
    id = "Subterra/StopAt-v1"
    error = np.linspace(0.0, 40.0, FEW)
    state = robots.fresh(id, FEW)
    state = robots.placed(id, state.replace(goal=state.goal.replace(station=jnp.full(FEW, 100.0))), 100.0 + error)
    _, gain, _, _ = robots.stand(id, state, 10)
    assert (np.diff(gain) < 0.0).all()
    assert gain[0] == pytest.approx(8.0, abs=0.01)
    assert gain[-1] == pytest.approx(-0.05 * 40.0, abs=0.01)


def test_the_terms_of_eq_1_are_those_that_are_written_down():
    id = "Subterra/Traverse-v1"
    length = float(robots.made(id)[1].tunnel.length)
    for before, previous, command in reward_cases_of_t0(id):
        _, gain, _, _, info = robots.advanced(id, before, command)
        info = {name: np.asarray(value, np.float64) for name, value in info.items()}
        furthest = np.asarray(before.furthest, np.float64)
        new = np.maximum(info["station"] - furthest, 0.0)
        covered = np.maximum(info["station"], furthest) >= 0.9 * length
        expected = {
            "terminal": 1.0 * (covered & (info["contact"] == 0.0)),
            "coverage": 100.0 * new / length,
            "lateral": -0.1 * np.abs(info["lateral"]) / info["half_width"],
            "jerk": -0.01 * np.abs(command - previous).sum(axis=1),
        }
        for name, values in expected.items():
            np.testing.assert_allclose(info[f"reward_{name}"], values, atol=3e-5, err_msg=name)
        np.testing.assert_allclose(gain, sum(expected.values()), atol=1e-4)


def reward_cases_of_t0(id):
    """Cases of T0: on the way, and where nine tenths are covered."""
    n, length = FEW, float(robots.made(id)[1].tunnel.length)
    command = np.tile([1.5, 0.2], (n, 1))
    for station in (100.0, 0.9 * length):
        state = robots.placed(
            id, robots.fresh(id, n), np.random.default_rng(0).uniform(station - 0.3, station + 0.3, n)
        )
        state = state.replace(furthest=jnp.full(n, station - 0.1))
        state, *_ = robots.advanced(id, state, command)
        yield state, command, np.tile([0.7, -0.3], (n, 1))


def test_ground_covered_before_earns_nothing():
    env, params, *_ = robots.made("Subterra/TraverseShort-v1")
    _, state = jax.jit(env.reset)(jax.random.key(0), params)
    step, rewards, stations = jax.jit(env.step), [], []
    # Ahead, around on the spot, back, around, and ahead again beyond where it turned.
    plan = [(2.0, 0.0)] * 15 + [(0.0, np.pi / 2.1)] * 21 + [(1.0, 0.0)] * 10
    plan += [(0.0, np.pi / 2.1)] * 21 + [(2.0, 0.0)] * 15
    for k, action in enumerate(plan):
        _, state, reward, terminated, _, info = step(jax.random.key(k), state, jnp.array(action), params)
        assert not terminated
        rewards.append(float(info["reward_coverage"]))
        stations.append(float(info["station"]))
        parts = sum(float(value) for name, value in info.items() if name.startswith("reward_"))
        assert float(reward) == pytest.approx(parts, abs=1e-6)
    assert min(rewards) == 0.0
    assert stations[45] < max(stations[:20]) - 0.5
    assert sum(rewards[36:46]) == 0.0
    assert sum(rewards) == pytest.approx(100 * max(stations) / 60.0, rel=1e-4)


def wandering(lag, sigma):
    """Covariance of an Ornstein-Uhlenbeck error of 30 m, averaged over two stretches of 10 m, this far apart."""
    half = 0.5 * 10.0 / 30.0
    return sigma**2 * np.exp(-lag / 30.0) * (np.sinh(half) / half) ** 2


def stretches(series):
    """Sums over stretches of 50 steps, which are 10 m at full speed, `(stretches, n)`."""
    return series.reshape(-1, 50, series.shape[1]).sum(axis=1)


def test_in_t0_the_plant_is_exact_and_the_odometer_has_a_scale_of_2_percent_and_noise_of_1_cm():
    _, series = robots.driven("Subterra/Traverse-v1", robots.fresh("Subterra/Traverse-v1", MANY), 100)
    np.testing.assert_allclose(series["moved"], 0.2, rtol=2e-3)
    np.testing.assert_allclose(series["turned"], series["asked"], atol=2e-5)
    first, second = stretches(series["counted"]) - 10.0
    robots.assert_mean(first, 0.0)
    # What two stretches share is the bias; what they do not is the noise of their 50 steps each.
    robots.assert_covariance(first, second, (0.02 * 10.0) ** 2)
    robots.assert_covariance(first - second, first - second, 2 * 50 * 0.01**2)


@pytest.mark.parametrize("id", ["Subterra/Traverse-v1", "Subterra/Return-v1"])
def test_the_odometers_yaw_rate_is_off_by_2_mrad_a_second(id):
    start = robots.fresh(id, MANY)
    middle, _ = robots.driven(id, start, 50)
    end, _ = robots.driven(id, middle, 50, key=2)
    errors = []
    for before, after in ((start, middle), (middle, end)):
        reckoned = [robots.observed(id, state)["odometry"][:, 1] for state in (before, after)]
        true = np.asarray(after.heading) - np.asarray(before.heading)
        errors.append((reckoned[1] - reckoned[0] - true + np.pi) % (2.0 * np.pi) - np.pi)
    robots.assert_mean(errors[0], 0.0)
    robots.assert_covariance(*errors, (0.002 * 5.0) ** 2)
    robots.assert_covariance(errors[0] - errors[1], errors[0] - errors[1], 2 * 50 * 0.001**2)


@functools.cache
def drive_of_100_metres(id, backward):
    """Relative errors of the plant and of the odometer in ten stretches of 10 m, and of the yaw rate, rad/s."""
    state = robots.fresh(id, MANY)
    state = robots.placed(id, state, 200.0 if backward else 20.0, backward=backward)
    _, series = robots.driven(id, state, 500)
    true, counted = stretches(series["moved"]), stretches(series["counted"])
    return true / 10.0 - 1.0, counted / true - 1.0, (series["turned"] - series["asked"]).mean(axis=0) / PERIOD


def test_from_t1_on_the_plant_slips_by_2_percent_an_episode_and_2_percent_that_wander_over_30_metres():
    slip, _, yaw = drive_of_100_metres("Subterra/StopAt-v1", False)
    robots.assert_mean(slip[0], 0.0)
    for lag in (1, 3, 9):
        robots.assert_covariance(slip[0], slip[lag], 0.02**2 + wandering(10.0 * lag, 0.02))
    robots.assert_covariance(slip[0], slip[1] - slip[9], wandering(10.0, 0.02) - wandering(90.0, 0.02))
    robots.assert_covariance(yaw, yaw, 0.002**2)
    robots.assert_covariance(yaw, slip[0], 0.0)  # each has a draw of its own


def test_from_t1_on_the_odometer_errs_by_2_percent_an_episode_and_1_percent_that_wanders_over_30_metres():
    _, scale, _ = drive_of_100_metres("Subterra/StopAt-v1", False)
    robots.assert_mean(scale[0], 0.0)
    for lag in (1, 3, 9):
        robots.assert_covariance(scale[0], scale[lag], 0.02**2 + wandering(10.0 * lag, 0.01))
    robots.assert_covariance(scale[0], scale[1] - scale[9], wandering(10.0, 0.01) - wandering(90.0, 0.01))


def test_facing_falling_stations_adds_another_2_percent_to_the_odometers_scale():
    _, scale, _ = drive_of_100_metres("Subterra/Return-v1", True)
    robots.assert_covariance(scale[0], scale[9], 0.02**2 + 0.02**2 + wandering(90.0, 0.01))


def test_the_error_of_the_way_back_is_not_that_of_the_way_out():
    id = "Subterra/Return-v1"
    state, out = robots.driven(id, robots.placed(id, robots.fresh(id, MANY), 100.0), 150)
    _, back = robots.driven(id, robots.placed(id, state, 130.0, backward=True), 150, key=2)
    out, back = ((stretches(s["counted"]) / stretches(s["moved"]) - 1.0) for s in (out, back))
    # Between the first stretch out and the last back lie 50 m.
    robots.assert_covariance(out[0], back[2], 0.02**2 + wandering(50.0, 0.01))
    robots.assert_covariance(back[0], back[2], 0.02**2 + 0.02**2 + wandering(20.0, 0.01))


def test_ranges_have_5_cm_of_noise_and_end_at_30_metres():
    id = "Subterra/StopAt-v1"
    state = robots.placed(id, robots.fresh(id, FEW), np.linspace(20.0, 330.0, FEW))
    one, two = (robots.observed(id, state, key)["ranges"] for key in (1, 2))
    wall = (one < 29.0) & (two < 29.0)
    assert wall.mean() > 0.8
    difference = (one - two)[wall]
    robots.assert_covariance(difference, difference, 2 * 0.05**2)
    assert max(one.max(), two.max()) == 30.0
    assert (one == 30.0).any()
