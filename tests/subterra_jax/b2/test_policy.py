"""The gait that is released, the B2 in missions that walk as it does, and what its agents are given."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from benchmarks import b2_traverse
from subterra_jax.b2 import gait as gaits
from subterra_jax.b2 import tasks, transfer
from subterra_jax.b2.transfer import LaggedWheels, NoddingLidar, stand_in
from subterra_jax.evaluation import listed_episodes
from subterra_jax.policies import load
from tests.recorded import check
from tests.subterra_jax import placing


@pytest.fixture(scope="module")
def gait():
    return load(gaits.RELEASED)


def test_its_facts_say_that_it_meets_its_goals_on_a_thousand_robots(gait):
    assert gait[1]["task"] == "Subterra/B2Walk-v1"
    scores = gait[1]["scores"]["policy"]
    assert scores["robots"] >= 1000
    assert scores["falls"] <= 0.01
    assert scores["velocity_error"] <= 0.15
    assert scores["yaw_rate_error"] <= 0.15


@pytest.mark.parametrize("speed", [1.0, 0.5, -0.3])
def test_it_walks_as_told_over_sleepers_with_pushes_and_noise(gait, walking, speed):
    """Four seconds of eight robots; the facts are of a thousand robots for twenty."""
    low, high = jnp.array([speed, -0.3, -0.8]), jnp.array([speed, 0.3, 0.8])
    command = dataclasses.replace(walking.params.command, low=low, high=high, still=jnp.float32(0.0))
    params = dataclasses.replace(walking.params, command=command)
    act = jax.jit(gait[0].act)
    obs, state = walking.reset(3, params)
    errors, fallen = [], False
    for k in range(200):
        obs, state, _, terminated, _, info = walking.step(k, state, act(obs), params)
        errors.append(np.asarray(info["velocity"] - info["asked"]))
        fallen = fallen or bool(terminated.any())
    assert not fallen
    # Over whole strides of 25 steps: the trunk sways within one.
    strides = np.mean(np.reshape(errors[50:], (6, 25, -1, 3)), axis=1)
    assert np.hypot(strides[..., 0], strides[..., 1]).mean() < 0.1
    assert np.abs(strides[..., 2]).mean() < 0.1


LATE = LaggedWheels(lag=(0.6, 0.25), gain=(0.9, 0.8))


@pytest.fixture(scope="module")
def run():
    env, params = st.make("Subterra/TraverseShort-v1", vehicle=tasks.VEHICLE, start=tasks.START)
    late = stand_in(env, LATE)
    actions = jnp.asarray(np.repeat(np.random.default_rng(0).uniform([0.0, -0.3], [0.8, 0.3], (8, 2)), 6, axis=0))

    @jax.jit
    def drive(key):
        _, state = late.reset(key, params)

        def step(state, action):
            _, state, *_ = late.step(key, state, action.astype(jnp.float32), params)
            return state, jnp.concatenate([state.command, state.position, state.heading[None]])

        return jax.lax.scan(step, state, actions)[1]

    return np.asarray(actions), np.asarray(drive(jax.random.key(0)))


def test_a_step_of_the_command_is_followed_exponentially_and_the_robot_moves_as_fast(run):
    actions, outcome = run
    expected = LATE.gain[0] * actions[0, 0] * (1.0 - np.exp(-0.2 * np.arange(1, 7) / LATE.lag[0]))
    np.testing.assert_allclose(outcome[:6, 0], expected, rtol=1e-4)
    moved = np.hypot(*np.diff(outcome[:, 2:4], axis=0).T)
    np.testing.assert_allclose(moved, 0.2 * outcome[1:, 0], rtol=1e-2)


def test_beams_that_point_down_end_on_the_ballast_and_no_others_change():
    env, params = st.make("Subterra/TraverseShort-v1", vehicle=tasks.VEHICLE, start=tasks.START)
    level = stand_in(env, lidar=NoddingLidar((0.0, 0.0, 0.0)))
    nose_down = stand_in(env, lidar=NoddingLidar((0.1, 0.0, 0.0)))
    nodding = stand_in(env, LATE, NoddingLidar((0.02, 0.05, 0.01)))
    key = jax.random.key(0)
    (flat, _), (bent, _), (nodded, _) = (jax.jit(one.reset)(key, params) for one in (level, nose_down, nodding))
    check(__file__, "nodding", {"seen": nodded})
    assert float(bent[0]) == pytest.approx(0.75 / np.sin(0.1), rel=1e-5)
    assert float(flat[0]) > float(bent[0])
    np.testing.assert_array_equal(bent[4:13], flat[4:13])  # to the sides and behind


PARAMS = SimpleNamespace(vehicle=SimpleNamespace(period=0.2), tunnel=SimpleNamespace(length=np.array(100.0)))


def test_figures_of_four_robots_are_what_one_counts_by_hand():
    """Two arrive after 80 m in 100 s, one falls after 20 m in 50 s, one touches the wall where it stood."""
    state = SimpleNamespace(
        station=np.array([82.0, 82.0, 22.0, 2.0]),
        furthest=np.array([90.0, 90.0, 30.0, 10.0]),
        odometry=SimpleNamespace(distance=np.array([84.0, 76.0, 20.0, 0.0])),
        steps=np.array([500, 500, 250, 1]),
        tunnel=np.zeros(4, int),
    )
    walk = transfer.Walk(
        state=state,
        over=np.ones(4, bool),
        success=np.array([True, True, False, False]),
        contact=np.array([False, False, False, True]),
        fall=np.array([False, False, True, False]),
        start=np.full(4, 2.0),
    )
    rows = transfer.Row(
        lateral=np.array([[0.3, -0.4, np.nan, np.nan]]),
        command=np.array([[[1.0, 0.2], [1.0, 0.0], [np.nan] * 2, [np.nan] * 2]]),
        motion=np.array([[[0.8, 0.1], [0.6, 0.0], [np.nan] * 2, [np.nan] * 2]]),
        lean=np.array([[[0.1, 0.0], [-0.1, 0.0], [np.nan] * 2, [np.nan] * 2]]),
        sway=np.array([[[0.3], [-0.4], [np.nan], [np.nan]]]),
    )
    outcome = transfer.figures(walk, rows, PARAMS)
    check(__file__, "figures", outcome)
    assert outcome["robots"] == 4
    assert (outcome["success_percent"], outcome["fall_percent"], outcome["contact_percent"]) == (50.0, 25.0, 25.0)
    assert outcome["coverage_median_percent"] == pytest.approx(60.0)
    assert outcome["speed_mean"] == pytest.approx((0.8 + 0.8 + 0.4 + 0.0) / 4)
    assert outcome["lateral_rms"] == outcome["range_off_rms"] == pytest.approx(np.sqrt(0.125))
    assert outcome["odometer_error_percent"] == pytest.approx(0.0)
    assert outcome["odometer_error_sigma_percent"] == pytest.approx(100.0 * np.sqrt(2 * 0.05**2 / 4))
    assert (outcome["speed_obeyed_percent"], outcome["yaw_obeyed_percent"]) == pytest.approx((70.0, 50.0))
    assert outcome["pitch_sigma_deg"] == pytest.approx(np.rad2deg(0.1))


@pytest.mark.parametrize("name", ["nothing", "truth"])
def test_a_robot_is_driven_by_what_its_agent_declares_and_no_more(name):
    agent, speed = placing.PROBES[name]
    env, params = st.make("Subterra/TraverseShort-v1", horizon=3)
    walk, rows = transfer.walk_robots(env, params, agent, listed_episodes(env, params, 2))
    np.testing.assert_allclose(walk.state.command[:, 0], speed, rtol=1e-4)
    assert np.nanstd(rows.sway) == pytest.approx(0.05, rel=0.5)  # the noise of the LiDAR


def test_the_figures_are_records_with_intervals_after_wilson():
    asked = b2_traverse.Command(robot="rover", robots=100, agent="out/mine", task="StopAt-v1")
    records = {r.id: r for r in b2_traverse.records_of(asked, {"success_percent": 50.0, "speed_mean": 0.5})}
    success = records["b2/rover/StopAt-v1/mjx/mine/success"]
    assert (success.interval, success.n) == ((40.4, 59.6), 100)
    assert "--robot rover --task StopAt-v1 --agent out/mine" in success.command
    assert records["b2/rover/StopAt-v1/mjx/mine/speed-mean"].unit == "m/s"
