"""The benchmark as it behaves, against the figures that its design states.

Every number that is expected here is written down a second time and read from no code: from docs/tasks.md and the task
design behind it. Robots are drawn and driven by the thousand without scans, so that a figure that is off by half lies
many standard errors away; comparisons allow four. Analytic answers are exact but for float32.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.baselines import registry
from subterra_jax.evaluation import Episodes, evaluate
from subterra_jax.recorder import RecorderConfig, record
from subterra_jax.tunnel import at_station
from subterra_jax.viewer import library
from tests.subterra_jax import tunnels
from tests.subterra_jax.probes import PROBES

SPEED, PERIOD = 2.0, 0.1
MANY, FEW = 3000, 400  # robots; two sizes only, or each would be compiled anew
WITH_GOAL = tuple(name for name in st.TASKS if "Traverse" not in name and name.endswith("-v0"))


@functools.cache
def made(id):
    """A task, its functions for batches of robots compiled once."""
    env, params = st.make(id)
    begin = jax.jit(
        lambda key, n: jax.vmap(env.begin, (0, None))(env.draw_reset(key, (n,), params), params), static_argnums=1
    )
    advance = jax.jit(jax.vmap(env.advance, (0, 0, 0, None)))
    observe = jax.jit(jax.vmap(env.observe, (0, 0, None)))
    return env, params, begin, advance, observe


def begun(id, n, key=0):
    """States of n robots at the start of their episodes."""
    return made(id)[2](jax.random.key(key), n)


def advanced(id, state, action, key=0):
    """States, rewards, flags and infos of all robots after one step of an action, or of one action each."""
    env, params, _, advance, _ = made(id)
    n = len(state.station)
    numbers = jnp.zeros((n, env.action_size)).at[:, : np.shape(action)[-1]].set(jnp.asarray(action))
    return advance(state, numbers, env.draw_step(jax.random.key(key), (n,), params), params)


def observed(id, state, key=0):
    """What all robots observe, by name."""
    env, params, *_, observe = made(id)
    flat = np.asarray(observe(state, env.draw_step(jax.random.key(key), (len(state.station),), params), params))
    return {name: flat[:, part] for name, part in env.fields(params).items()}


def placed(id, state, station, lateral=0.0, backward=False):
    """The robots put down elsewhere, along the axis."""
    station = jnp.broadcast_to(jnp.asarray(station, jnp.float32), state.station.shape)
    lateral = jnp.broadcast_to(jnp.asarray(lateral, jnp.float32), state.station.shape)
    x, y, along, across, _ = jax.vmap(at_station, (None, 0), 1)(made(id)[1].tunnel, station)
    heading = jnp.arctan2(-across, -along) if backward else jnp.arctan2(across, along)
    position = jnp.stack([x - lateral * across, y + lateral * along], axis=-1)
    return state.replace(position=position, heading=heading, station=station, lateral=lateral)


@functools.partial(jax.jit, static_argnums=0)
def _driven_10_metres(env, params, state, key):
    """Fifty steps, and what happened in each."""

    def step(state, key):
        known = jax.vmap(env.privileged, (0, None))(state, params)
        side = jnp.sign(known["heading_cos"])
        yaw_rate = -side * (0.25 * known["lateral"] + 1.4 * known["heading_sin"])
        action = jnp.zeros((len(side), env.action_size)).at[:, 0].set(SPEED).at[:, 1].set(jnp.clip(yaw_rate, -0.7, 0.7))
        draws = env.draw_step(key, (len(side),), params)
        after, _, terminated, _, info = jax.vmap(env.advance, (0, 0, 0, None))(state, action, draws, params)
        row = {
            "moved": jnp.sqrt(jnp.sum((after.position - state.position) ** 2, axis=-1)),
            "counted": after.odometry.distance - state.odometry.distance,
            "turned": (after.heading - state.heading + jnp.pi) % (2.0 * jnp.pi) - jnp.pi,
            "asked": after.command[:, 1] * PERIOD,
            "station": state.station,
            "contact": info["contact"],
            "success": info["success"],
            "terminated": terminated,
        }
        return after, row

    return jax.lax.scan(step, state, jax.random.split(key, 50))


def driven(id, state, n_steps, key=1):
    """The robots after a drive at full speed along the axis, and series `(n_steps, n)`; contact does not stop them."""
    env, params, *_ = made(id)
    parts = []
    for k in range(n_steps // 50):
        state, part = _driven_10_metres(env, params, state, jax.random.key(1000 * key + k))
        parts.append(jax.device_get(part))
    return state, {name: np.concatenate([part[name] for part in parts]).astype(np.float64) for name in parts[0]}


def assert_mean(sample, expected):
    """The mean of independent numbers is the expected one, within four standard errors."""
    sample = np.asarray(sample, np.float64)
    error = sample.std(ddof=1) / np.sqrt(len(sample))
    assert abs(sample.mean() - expected) < 4.0 * error, f"{sample.mean():.6g}, expected {expected:.6g} ± {error:.2g}"


def assert_covariance(a, b, expected):
    """The covariance of two samples of mean 0 is the expected one, within four standard errors."""
    assert_mean(np.asarray(a, np.float64) * np.asarray(b, np.float64), expected)


def wandering(lag, sigma):
    """Covariance of an Ornstein-Uhlenbeck error of 30 m, averaged over two stretches of 10 m, this far apart."""
    half = 0.5 * 10.0 / 30.0
    return sigma**2 * np.exp(-lag / 30.0) * (np.sinh(half) / half) ** 2


def stretches(series):
    """Sums over stretches of 50 steps, which are 10 m at full speed, `(stretches, n)`."""
    return series.reshape(-1, 50, series.shape[1]).sum(axis=1)


# --- Drift: docs/tasks.md, "What drifts"


def test_in_t0_the_plant_is_exact_and_the_odometer_has_a_scale_of_2_percent_and_noise_of_1_cm():
    _, series = driven("Subterra/Traverse-v0", begun("Subterra/Traverse-v0", MANY), 100)
    np.testing.assert_allclose(series["moved"], 0.2, rtol=2e-3)
    np.testing.assert_allclose(series["turned"], series["asked"], atol=2e-5)
    first, second = stretches(series["counted"]) - 10.0
    assert_mean(first, 0.0)
    # What two stretches share is the bias; what they do not is the noise of their 50 steps each.
    assert_covariance(first, second, (0.02 * 10.0) ** 2)
    assert_covariance(first - second, first - second, 2 * 50 * 0.01**2)


@pytest.mark.parametrize("id", ["Subterra/Traverse-v0", "Subterra/Return-v0"])
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
    slip, _, yaw = drive_of_100_metres("Subterra/StopAt-v0", False)
    assert_mean(slip[0], 0.0)
    for lag in (1, 3, 9):
        assert_covariance(slip[0], slip[lag], 0.02**2 + wandering(10.0 * lag, 0.02))
    assert_covariance(slip[0], slip[1] - slip[9], wandering(10.0, 0.02) - wandering(90.0, 0.02))
    assert_covariance(yaw, yaw, 0.002**2)


def test_from_t1_on_the_odometer_errs_by_2_percent_an_episode_and_1_percent_that_wanders_over_30_metres():
    _, scale, _ = drive_of_100_metres("Subterra/StopAt-v0", False)
    assert_mean(scale[0], 0.0)
    for lag in (1, 3, 9):
        assert_covariance(scale[0], scale[lag], 0.02**2 + wandering(10.0 * lag, 0.01))
    assert_covariance(scale[0], scale[1] - scale[9], wandering(10.0, 0.01) - wandering(90.0, 0.01))


def test_facing_falling_stations_adds_another_2_percent_to_the_odometers_scale():
    _, scale, _ = drive_of_100_metres("Subterra/Return-v0", True)
    assert_covariance(scale[0], scale[9], 0.02**2 + 0.02**2 + wandering(90.0, 0.01))


def test_the_error_of_the_way_back_is_not_that_of_the_way_out():
    id = "Subterra/Return-v0"
    state, out = driven(id, placed(id, begun(id, MANY), 100.0), 150)
    _, back = driven(id, placed(id, state, 130.0, backward=True), 150, key=2)
    out, back = ((stretches(s["counted"]) / stretches(s["moved"]) - 1.0) for s in (out, back))
    # Between the first stretch out and the last back lie 50 m.
    assert_covariance(out[0], back[2], 0.02**2 + wandering(50.0, 0.01))
    assert_covariance(back[0], back[2], 0.02**2 + 0.02**2 + wandering(20.0, 0.01))


def test_ranges_have_5_cm_of_noise_and_end_at_30_metres():
    id = "Subterra/StopAt-v0"
    state = placed(id, begun(id, FEW), np.linspace(20.0, 330.0, FEW))
    one, two = (observed(id, state, key)["ranges"] for key in (1, 2))
    wall = (one < 29.0) & (two < 29.0)
    assert wall.mean() > 0.8
    difference = (one - two)[wall]
    assert_covariance(difference, difference, 2 * 0.05**2)
    assert max(one.max(), two.max()) == 30.0
    assert (one == 30.0).any()


# --- Starts and goals: docs/tasks.md, the table of tasks


@pytest.mark.parametrize(
    ("id", "low", "high"),
    [
        ("Subterra/StopAt-v0", 60.0, 320.0),
        ("Subterra/StopAtOffset-v0", 60.0, 320.0),
        ("Subterra/Return-v0", 60.0, 320.0),
        ("Subterra/Obstructed-v0", 60.0, 320.0),
        ("Subterra/Faulted-v0", 60.0, 320.0),
        ("Subterra/StopAtShort-v0", 10.0, 60.0),
        ("Subterra/StopAtOffsetShort-v0", 20.0, 60.0),
        ("Subterra/ReturnShort-v0", 10.0, 60.0),
        ("Subterra/ObstructedShort-v0", 10.0, 60.0),
        ("Subterra/FaultedShort-v0", 10.0, 60.0),
    ],
)
def test_goals_lie_anywhere_in_their_range(id, low, high):
    goal = np.asarray(begun(id, MANY).goal.station, np.float64)
    assert low <= goal.min() < low + 0.01 * (high - low)
    assert high - 0.01 * (high - low) < goal.max() <= high
    assert_mean(goal, 0.5 * (low + high))
    share = np.histogram(goal, 10, (low, high))[0] / len(goal)
    assert np.abs(share - 0.1).max() < 4.0 * np.sqrt(0.1 * 0.9 / len(goal))


@pytest.mark.parametrize(
    ("id", "station", "sigma"),
    [("Subterra/StopAt-v0", 0.0, 0.0), ("Subterra/Return-v0", 5.0, 0.0), ("Subterra/StopAtOffset-v0", 9.0, 3.0)],
)
def test_robots_start_where_the_task_says(id, station, sigma):
    state = begun(id, MANY)
    start, lateral = (np.asarray(values, np.float64) for values in (state.station, state.lateral))
    if sigma == 0.0:
        assert (start == station).all()
    else:
        assert_mean(start, station)
        assert np.std(start) == pytest.approx(sigma, rel=0.06)
    # Uniform to either side: 0.5 m and 0.1 rad.
    off_axis = np.arcsin(np.asarray(jax.vmap(made(id)[0].privileged, (0, None))(state, made(id)[1])["heading_sin"]))
    for values, largest in ((lateral, 0.5), (off_axis, 0.1)):
        assert np.abs(values).max() < largest + 1e-5
        assert_covariance(values, values, largest**2 / 3.0)


# --- Success: docs/tasks.md, "success" and "Stop"


def stand(id, state, steps, report=None):
    """The robots after they were told to stand, and the info of the last step."""
    n = len(state.station)
    action = (
        np.zeros((n, 2))
        if report is None
        else np.stack([*np.zeros((2, n)), report, *np.tile([0.0, 1.0], (n, 1)).T], -1)
    )
    for k in range(steps):
        state, gain, terminated, _, info = advanced(id, state, action, key=100 + k)
    return state, np.asarray(gain), np.asarray(terminated), {name: np.asarray(value) for name, value in info.items()}


def errors_about(tolerance, n):
    """Errors just inside and just outside of a tolerance, to either side, and which are inside."""
    error = np.tile([-tolerance - 0.02, -tolerance + 0.02, tolerance - 0.02, tolerance + 0.02], n // 4)
    return error, np.abs(error) < tolerance


@pytest.mark.parametrize("id", WITH_GOAL)
def test_a_stop_counts_within_1_metre_and_within_25_centimetres_in_the_short_tasks(id):
    tolerance = 0.25 if "Short" in id else 1.0
    state, report = begun(id, FEW), None
    error, inside = errors_about(tolerance, FEW)
    if "Relocalise" in id:
        state = placed(id, state, state.station)
        report = np.asarray(state.station) + error
    else:
        target = state.goal.station
        if "Return" in id:
            state, target = advanced(id, placed(id, state, target), np.zeros(2))[0], 5.0
        state = placed(id, state, target + error)
    _, _, early, before = stand(id, state, 9 if "Return" not in id else 8, report)
    assert not before["stopped"].any()
    assert not (early & ~before["contact"]).any()
    _, _, ended, info = stand(id, state, 10, report)
    free = ~info["contact"]
    assert free.mean() > (0.8 if "Obstructed" in id else 0.999)
    assert ended.all()
    assert info["stopped"][free].all()
    np.testing.assert_array_equal(info["success"], inside & free)


def test_a_report_of_the_wrong_direction_is_no_success():
    id = "Subterra/Relocalise-v0"
    state = begun(id, FEW)
    state = placed(id, state, state.station, backward=True)
    _, _, ended, info = stand(id, state, 10, np.asarray(state.station))
    assert ended.all()
    assert not info["success"].any()


def test_the_flag_is_raised_within_2_metres_of_the_goal():
    id = "Subterra/Return-v0"
    state = begun(id, FEW)
    error, inside = errors_about(2.0, FEW)
    _, _, _, info = stand(id, placed(id, state, state.goal.station + error), 1)
    np.testing.assert_array_equal(info["flag"], inside)


@pytest.mark.parametrize(
    ("command", "stands"), [((0.043, 0.0), True), ((0.058, 0.0), False), ((0.0, 0.48), True), ((0.0, 0.52), False)]
)
def test_below_5_centimetres_and_half_a_radian_a_second_is_standing(command, stands):
    id = "Subterra/StopAt-v0"
    state = placed(id, begun(id, FEW), 100.0)
    for k in range(10):
        state, _, _, _, info = advanced(id, state, command, key=k)
    # The speed that counts is the true one: it slips by 3 %.
    assert np.mean(info["stopped"]) == (1.0 if stands else 0.0)


@pytest.mark.parametrize(("id", "limit"), [("Subterra/Relocalise-v0", 120.0), ("Subterra/RelocaliseShort-v0", 40.0)])
def test_a_robot_that_has_not_reported_within_120_metres_has_failed(id, limit):
    state, travelled, ended = begun(id, FEW), np.zeros(FEW), np.zeros(FEW, bool)
    # Back and forth over 20 m: the limit is of the distance, wherever it is driven.
    for k in range(round(limit / 20.0) + 1):
        state, series = driven(id, placed(id, state, 20.0), 100, key=k)
        for moved, terminated in zip(series["moved"], series["terminated"], strict=True):
            travelled = np.where(ended, travelled, travelled + moved)
            ended |= terminated > 0.0
        assert not series["success"].any()
    assert ended.all()
    # The step that ends an episode is the one that leads beyond the limit.
    assert travelled.min() > limit - 0.01
    assert travelled.max() < limit + 0.25


# --- Rewards: docs/tasks.md, "Reward"; the task design has the weights


def reward_cases(id):
    """States before and after single steps: on the way, at a stop and at a contact, with commands and infos."""
    n = FEW
    start = placed(id, begun(id, n), np.random.default_rng(0).uniform(20.0, 55.0, n))
    rng = np.random.default_rng(1)
    first = np.stack([rng.uniform(0.0, 2.0, n), rng.uniform(-1.0, 1.0, n)], -1)
    second = np.stack([rng.uniform(0.0, 2.0, n), rng.uniform(-1.0, 1.0, n)], -1)
    moving, *_ = advanced(id, start, first)
    yield moving, first, second
    halt = start
    for k in range(9):
        halt, *_ = advanced(id, halt, np.zeros(2), key=k)
    yield halt, np.zeros((n, 2)), np.zeros((n, 2))
    yield placed(id, moving, 30.0, 2.6), first, second


@pytest.mark.parametrize("id", ["Subterra/StopAt-v0", "Subterra/StopAtShort-v0"])
def test_the_terms_of_the_reward_of_a_goal_are_those_that_are_written_down(id):
    tolerance, stops, contacts = (0.25 if "Short" in id else 1.0), 0, 0
    for before, previous, command in reward_cases(id):
        after, gain, _, _, info = advanced(id, before, command)
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
    id = "Subterra/StopAt-v0"
    error = np.linspace(0.0, 40.0, FEW)
    state = begun(id, FEW)
    state = placed(id, state.replace(goal=state.goal.replace(station=jnp.full(FEW, 100.0))), 100.0 + error)
    _, gain, _, _ = stand(id, state, 10)
    assert (np.diff(gain) < 0.0).all()
    assert gain[0] == pytest.approx(8.0, abs=0.01)
    assert gain[-1] == pytest.approx(-0.05 * 40.0, abs=0.01)


def test_the_terms_of_eq_1_are_those_that_are_written_down():
    id = "Subterra/Traverse-v0"
    length = float(made(id)[1].tunnel.length)
    for before, previous, command in reward_cases_of_t0(id):
        _, gain, _, _, info = advanced(id, before, command)
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
    """The same of T0, on the way and where nine tenths are covered."""
    n, length = FEW, float(made(id)[1].tunnel.length)
    command = np.tile([1.5, 0.2], (n, 1))
    for station in (100.0, 0.9 * length):
        state = placed(id, begun(id, n), np.random.default_rng(0).uniform(station - 0.3, station + 0.3, n))
        state = state.replace(furthest=jnp.full(n, station - 0.1))
        state, *_ = advanced(id, state, command)
        yield state, command, np.tile([0.7, -0.3], (n, 1))


# --- Contact: docs/tasks.md, "Contact"


def test_nine_tenths_covered_in_contact_with_a_wall_are_no_success():
    id = "Subterra/Traverse-v0"
    _, params, *_ = made(id)
    threshold, n = 0.9 * float(params.tunnel.length), FEW
    lateral = np.where(np.arange(n) < n // 2, 0.0, 2.6)  # the walls are 2.8 m away, the robot's radius is 0.4 m
    state = placed(id, begun(id, n), threshold - 0.1, lateral).replace(furthest=jnp.full(n, threshold - 0.1))
    _, _, terminated, truncated, info = advanced(id, state, np.array([2.0, 0.0]))
    info = {name: np.asarray(value) for name, value in info.items()}
    np.testing.assert_array_equal(info["contact"], lateral > 0.0)
    assert (info["coverage"] >= 0.9).all()
    np.testing.assert_array_equal(info["success"], lateral == 0.0)
    np.testing.assert_array_equal(info["reward_terminal"], 1.0 * (lateral == 0.0))
    assert np.asarray(terminated).all()
    assert not np.asarray(truncated).any()


@pytest.fixture(scope="module")
def blocked(plan_of):
    """A straight tunnel of 60 m with a wall across it: who covers nine tenths touches it in that very step."""
    arrays = tunnels.tunnel_arrays(tunnels.straight(60.0))
    across = np.array([[54.39, -2.8, 54.39, 2.8]])
    return plan_of(arrays | {"furniture_smooth": across, "furniture_pockets": across})


@pytest.mark.parametrize("name", ["command-integrator"])
def test_neither_evaluation_nor_viewer_counts_coverage_in_contact_as_success(blocked, name):
    env, params = st.make("Subterra/Traverse-v0", tunnel=blocked, lining="smooth")
    one = np.zeros(4, np.int32)
    episodes = Episodes(np.arange(4, dtype=np.uint32), one, one, one)
    records = evaluate(env, params, registry.make_agent(name, params), episodes)
    assert (records.coverage >= 0.9).any()
    assert records.contact.all()
    assert not records.success.any()
    *_, whole = library.drive_episode(blocked, "0", "blocked", "smooth", "Subterra/Traverse-v0", name, 0)
    assert (whole.contact, whole.success) == (1.0, 0.0)


def test_where_a_beam_ends_on_a_box_the_robot_would_touch_it():
    id, plain = "Subterra/Obstructed-v0", "Subterra/StopAt-v0"
    station = np.random.default_rng(0).uniform(20.0, 300.0, FEW)
    state, empty = (placed(name, begun(name, FEW), station) for name in (id, plain))
    seen, walls = (observed(name, there)["ranges"] for name, there in ((id, state), (plain, empty)))
    robot, beam = np.nonzero((seen < walls - 0.5) & (seen < 6.0))
    assert len(robot) > 200
    robot, beam = np.resize(robot, FEW), np.resize(beam, FEW)
    heading = np.asarray(state.heading)[robot] + beam * (2.0 * np.pi / 16.0)
    reach = seen[robot, beam][:, None]
    hit = np.asarray(state.position)[robot] + reach * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    along = station[robot] + reach[:, 0] * np.cos(beam * (2.0 * np.pi / 16.0))

    def standing_there(name, state):
        there = jax.tree.map(lambda leaf: leaf[robot], state)
        there = there.replace(position=jnp.asarray(hit), station=jnp.asarray(along, jnp.float32))
        _, _, terminated, _, info = advanced(name, there, np.zeros(2))
        return np.asarray(terminated), {key: np.asarray(value) for key, value in info.items()}

    terminated, info = standing_there(id, state)
    # The beam is noisy by 5 cm.
    assert info["clearance"].max() < 0.25
    assert info["contact"].all()
    assert terminated.all()
    assert not info["success"].any()
    # It is the boxes that are touched: most of these places are free without them.
    assert standing_there(plain, empty)[1]["contact"].mean() < 0.3


def test_a_robot_that_drives_blindly_among_boxes_runs_into_them():
    contacts = {}
    for id in ("Subterra/StopAtShort-v0", "Subterra/ObstructedShort-v0"):
        _, series = driven(id, placed(id, begun(id, MANY), 10.0), 150)
        contacts[id] = series["contact"].any(axis=0).mean()
    assert contacts["Subterra/StopAtShort-v0"] == 0.0
    assert 0.3 < contacts["Subterra/ObstructedShort-v0"] < 0.99


def test_boxes_are_as_many_and_as_large_as_stated():
    id, points = "Subterra/Obstructed-v0", 150
    _, params, *_ = made(id)
    state, rng, inside = begun(id, MANY), np.random.default_rng(0), np.zeros(MANY)
    for k in range(points):
        there = placed(id, state, rng.uniform(30.0, 315.0, MANY), rng.uniform(-3.0, 3.0, MANY))
        inside += np.asarray(advanced(id, there, np.zeros(2), key=k)[4]["clearance"]) == 0.0
    # One thing in every 15 m: a box of sides U(0.3, 0.8) m, or, in one of the 22 places after the first, the trolley of
    # 2.4 m by 1.2 m. A point within 3 m of the axis lies inside of it with this chance:
    n_places = float(params.tunnel.length) // 15.0 - 1.0
    assert n_places == 22.0
    area = 0.55**2 + (2.4 * 1.2 - 0.55**2) / n_places
    assert_mean(inside / points, area / (15.0 * 6.0))


# --- Faults: docs/tasks.md, "Faults (T4)"


@pytest.fixture(scope="module")
def faulted():
    """States of 3,000 robots under faults after 35 s, severities, and series of the whole drive."""
    id = "Subterra/Faulted-v0"
    start = begun(id, MANY)
    severity = np.asarray(advanced(id, start, np.zeros(2))[4]["severity"])
    state, series = driven(id, start, 350)
    return state, severity, series


def test_every_severity_is_drawn_alike(faulted):
    share = np.bincount(faulted[1].astype(int), minlength=5) / MANY
    assert len(share) == 5
    assert np.abs(share - 0.2).max() < 4.0 * np.sqrt(0.2 * 0.8 / MANY)


def test_30_percent_of_the_patches_are_wet_at_severity_4_and_take_30_percent_of_the_speed(faulted):
    _, severity, series = faulted
    ratio, patch = series["moved"] / 0.2, np.floor(series["station"] / 10.0).astype(int)
    losses = []
    for level in range(5):
        wet = []
        # At the end of the drive everybody has left the first four patches.
        for k in range(4):
            there = (patch == k)[:, severity == level]
            slow = (ratio[:, severity == level] < 0.85) & there
            share = slow.sum(axis=0) / there.sum(axis=0)
            # A patch is wet or dry as a whole.
            assert set(np.unique(share)) <= {0.0, 1.0}
            wet.append(share)
            losses.extend(ratio[:, severity == level][slow][::7])
        expected, wet = 0.3 * level / 4, np.concatenate(wet)
        assert abs(wet.mean() - expected) <= 4.0 * np.sqrt(expected * (1.0 - expected) / len(wet)), level
    assert np.mean(losses) == pytest.approx(0.7, abs=0.003)
    # The odometer turns with the wheels: it does not notice.
    slow = (ratio < 0.85) & (series["counted"] != 0.0)
    assert np.mean(series["counted"][slow]) == pytest.approx(0.2, abs=0.003)


def test_the_odometer_freezes_1_percent_of_the_steps_for_up_to_3_seconds_at_severity_4(faulted):
    _, severity, series = faulted
    for level in range(5):
        frozen = series["counted"][:, severity == level] == 0.0
        begins = frozen[1:] & ~frozen[:-1]
        chances, rate = (~frozen[:-1]).sum(), 0.01 * level / 4
        assert abs(begins.sum() - rate * chances) <= 4.0 * np.sqrt(rate * chances), level
        if level == 4:
            # Runs that begin in time to end within the drive: whole steps, as often 1 as 30.
            begin = [(k, i) for k, i in zip(*np.nonzero(begins), strict=True) if k < 300]
            lengths = [np.argmin(np.append(frozen[k + 1 :, i], False)) for k, i in begin]
            assert max(lengths) == 30
            assert_mean(lengths, 15.5)


def test_observations_are_as_many_steps_old_as_the_severity(faulted):
    state, severity, series = faulted
    distance = np.cumsum(series["counted"], axis=0)
    late = distance[-1 - severity.astype(int), np.arange(MANY)]
    np.testing.assert_allclose(observed("Subterra/Faulted-v0", state)["odometry"][:, 0], late, atol=1e-3)


def test_dust_takes_15_percent_of_the_beams_at_severity_4_somewhere_before_the_wall(faulted):
    state, severity, _ = faulted
    scans = np.stack([observed("Subterra/Faulted-v0", state, key)["ranges"] for key in range(9)])
    wall = np.median(scans, axis=0)
    # Only beams that are there, and whose median is the wall even where a few of the nine meet dust.
    clear = (wall < 25.0) & (wall > 1.0)
    short = scans < wall - 0.25
    for level in range(5):
        mine = clear & (severity == level)[:, None]
        share = np.where(mine, short.mean(axis=0) / (1.0 - 0.25 / np.maximum(wall, 1.0)), 0.0).sum(axis=1) / mine.sum(
            axis=1
        ).clip(1)
        share = share[(severity == level) & (mine.sum(axis=1) > 0)]
        if level == 0:
            assert not share.any()
        else:
            assert np.mean(share) == pytest.approx(0.15 * level / 4, rel=0.06), level


def test_sectors_of_up_to_12_beams_drop_out_for_up_to_4_seconds(faulted):
    state, severity, _ = faulted
    id = "Subterra/Faulted-v0"
    plain = placed("Subterra/StopAt-v0", begun("Subterra/StopAt-v0", MANY), 0.0)
    out, beams = np.zeros((MANY, 16)), np.zeros((MANY, 16))
    largest = 0
    for k in range(3):
        state, _ = driven(id, state, 50, key=10 + k)
        # Where the delayed scan is taken differs from where the robot is by less than a metre.
        there = plain.replace(position=state.position, heading=state.heading, station=state.station)
        hits = observed("Subterra/StopAt-v0", there)["ranges"] < 20.0
        gone = (observed(id, state)["ranges"] == 30.0) & hits
        out, beams = out + gone, beams + hits
        largest = max(largest, gone.sum(axis=1).max())
    assert 10 <= largest <= 12
    for level in range(5):
        mine = severity == level
        share = out[mine].sum(axis=1) / beams[mine].sum(axis=1)
        if level == 0:
            assert not share.any()
            continue
        # Out for 1 to 40 steps and back until the next time; 1 to 12 of 16 beams.
        rate = 0.02 * level / 4
        assert_mean(share, 20.5 / (20.5 + 1.0 / rate) * 6.5 / 16.0)


# --- Truth: docs/tasks.md, "No absolute pose is in it"; an agent receives only the inputs that it declares


def probe(name):
    """Name under which a probe can be asked for."""
    if f"probe {name}" not in registry.names():
        registry.register(f"probe {name}", lambda params: PROBES[name][0])
    return f"probe {name}"


@pytest.mark.parametrize("name", PROBES)
def test_the_evaluation_gives_an_agent_what_it_declares_and_no_more(name):
    agent, speed = PROBES[name]
    env, params = st.make("Subterra/TraverseShort-v0", horizon=3)
    one = np.zeros(2, np.int32)
    records = evaluate(env, params, agent, Episodes(np.arange(2, dtype=np.uint32), one, one, one))
    np.testing.assert_allclose(records.travelled / records.time, speed, rtol=1e-4)


@pytest.mark.parametrize("name", ["nothing", "truth"])
def test_the_recorder_gives_an_agent_what_it_declares_and_no_more(name, tmp_path):
    trace = record(RecorderConfig(out=tmp_path / "one", task="TraverseShort", agent=probe(name), steps=3))
    np.testing.assert_allclose(trace.command[:, 0], PROBES[name][1], rtol=1e-4)


@pytest.mark.parametrize("name", ["nothing", "truth"])
def test_the_viewer_gives_an_agent_what_it_declares_and_no_more(name):
    plan = st.load_tunnel()
    parts = library.drive_episode(plan, "0", "t", "smooth", "Subterra/TraverseShort-v0", probe(name), 0)
    next(parts)
    np.testing.assert_allclose(next(parts).command[1:, 0], PROBES[name][1], rtol=1e-4)


def test_the_truth_that_is_handed_out_is_the_truth():
    id = "Subterra/StopAt-v0"
    env, params, *_ = made(id)
    state, _ = driven(id, begun(id, 50), 50)
    known = jax.vmap(env.privileged, (0, None))(state, params)
    np.testing.assert_array_equal(known["station"], state.station)
    np.testing.assert_allclose(known["to_goal"], state.goal.station - state.station, atol=1e-4)
    assert set(env.fields(params)) == {"ranges", "odometry", "goal", "ring_pitch"}
