"""Drift: docs/tasks.md, "What drifts"."""

import functools

import numpy as np
import pytest

from tests.subterra_jax.net.robots import (
    FEW,
    MANY,
    PERIOD,
    assert_covariance,
    assert_mean,
    begun,
    driven,
    observed,
    placed,
)


def wandering(lag, sigma):
    """Covariance of an Ornstein-Uhlenbeck error of 30 m, averaged over two stretches of 10 m, this far apart."""
    half = 0.5 * 10.0 / 30.0
    return sigma**2 * np.exp(-lag / 30.0) * (np.sinh(half) / half) ** 2


def stretches(series):
    """Sums over stretches of 50 steps, which are 10 m at full speed, `(stretches, n)`."""
    return series.reshape(-1, 50, series.shape[1]).sum(axis=1)


def test_in_t0_the_plant_is_exact_and_the_odometer_has_a_scale_of_2_percent_and_noise_of_1_cm():
    _, series = driven("Subterra/Traverse-v1", begun("Subterra/Traverse-v1", MANY), 100)
    np.testing.assert_allclose(series["moved"], 0.2, rtol=2e-3)
    np.testing.assert_allclose(series["turned"], series["asked"], atol=2e-5)
    first, second = stretches(series["counted"]) - 10.0
    assert_mean(first, 0.0)
    # What two stretches share is the bias; what they do not is the noise of their 50 steps each.
    assert_covariance(first, second, (0.02 * 10.0) ** 2)
    assert_covariance(first - second, first - second, 2 * 50 * 0.01**2)


@pytest.mark.parametrize("id", ["Subterra/Traverse-v1", "Subterra/Return-v1"])
def test_the_odometers_yaw_rate_is_off_by_2_mrad_a_second(id):
    start = begun(id, MANY)
    middle, _ = driven(id, start, 50)
    end, _ = driven(id, middle, 50, key=2)
    errors = []
    for before, after in ((start, middle), (middle, end)):
        reckoned = [observed(id, state)["odometry"][:, 1] for state in (before, after)]
        true = np.asarray(after.heading) - np.asarray(before.heading)
        errors.append((reckoned[1] - reckoned[0] - true + np.pi) % (2.0 * np.pi) - np.pi)
    assert_mean(errors[0], 0.0)
    assert_covariance(*errors, (0.002 * 5.0) ** 2)
    assert_covariance(errors[0] - errors[1], errors[0] - errors[1], 2 * 50 * 0.001**2)


@functools.cache
def drive_of_100_metres(id, backward):
    """Relative errors of the plant and of the odometer in ten stretches of 10 m, and of the yaw rate, rad/s."""
    state = begun(id, MANY)
    state = placed(id, state, 200.0 if backward else 20.0, backward=backward)
    _, series = driven(id, state, 500)
    true, counted = stretches(series["moved"]), stretches(series["counted"])
    return true / 10.0 - 1.0, counted / true - 1.0, (series["turned"] - series["asked"]).mean(axis=0) / PERIOD


def test_from_t1_on_the_plant_slips_by_2_percent_an_episode_and_2_percent_that_wander_over_30_metres():
    slip, _, yaw = drive_of_100_metres("Subterra/StopAt-v1", False)
    assert_mean(slip[0], 0.0)
    for lag in (1, 3, 9):
        assert_covariance(slip[0], slip[lag], 0.02**2 + wandering(10.0 * lag, 0.02))
    assert_covariance(slip[0], slip[1] - slip[9], wandering(10.0, 0.02) - wandering(90.0, 0.02))
    assert_covariance(yaw, yaw, 0.002**2)


def test_from_t1_on_the_odometer_errs_by_2_percent_an_episode_and_1_percent_that_wanders_over_30_metres():
    _, scale, _ = drive_of_100_metres("Subterra/StopAt-v1", False)
    assert_mean(scale[0], 0.0)
    for lag in (1, 3, 9):
        assert_covariance(scale[0], scale[lag], 0.02**2 + wandering(10.0 * lag, 0.01))
    assert_covariance(scale[0], scale[1] - scale[9], wandering(10.0, 0.01) - wandering(90.0, 0.01))


def test_facing_falling_stations_adds_another_2_percent_to_the_odometers_scale():
    _, scale, _ = drive_of_100_metres("Subterra/Return-v1", True)
    assert_covariance(scale[0], scale[9], 0.02**2 + 0.02**2 + wandering(90.0, 0.01))


def test_the_error_of_the_way_back_is_not_that_of_the_way_out():
    id = "Subterra/Return-v1"
    state, out = driven(id, placed(id, begun(id, MANY), 100.0), 150)
    _, back = driven(id, placed(id, state, 130.0, backward=True), 150, key=2)
    out, back = ((stretches(s["counted"]) / stretches(s["moved"]) - 1.0) for s in (out, back))
    # Between the first stretch out and the last back lie 50 m.
    assert_covariance(out[0], back[2], 0.02**2 + wandering(50.0, 0.01))
    assert_covariance(back[0], back[2], 0.02**2 + 0.02**2 + wandering(20.0, 0.01))


def test_ranges_have_5_cm_of_noise_and_end_at_30_metres():
    id = "Subterra/StopAt-v1"
    state = placed(id, begun(id, FEW), np.linspace(20.0, 330.0, FEW))
    one, two = (observed(id, state, key)["ranges"] for key in (1, 2))
    wall = (one < 29.0) & (two < 29.0)
    assert wall.mean() > 0.8
    difference = (one - two)[wall]
    assert_covariance(difference, difference, 2 * 0.05**2)
    assert max(one.max(), two.max()) == 30.0
    assert (one == 30.0).any()
