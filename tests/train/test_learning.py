"""Results of training, and the finished episodes of a run: their order, their window, the policy that is kept."""

import dataclasses
import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.rules import GoalParams
from tests.subterra_jax.tunnels import write_corridor
from tests.train.conftest import weights_of
from train import curve
from train.config import TrainConfig
from train.driver import Driver, Policy
from train.evaluate import evaluate
from train.log import read_log
from train.policies import make_agent
from train.ppo import train
from train.report import Finished, Report, fetch, in_a_row, report
from train.rollout import begin, collect
from train.setup import make_layout, make_learner
from train.snapshot import Best, EpisodeWindow
from train.world import World

TASK = "Subterra/StopAtShort-v1"
LEAST = 0.5  # of 100 episodes without exploration noise
TINY = TrainConfig(steps=2048, n_envs=16, unroll=16, minibatches=2, hidden=(8,))


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """Goals 4 to 12 m away in a corridor; a metre off is still there, and fifteen seconds are enough."""
    plan = write_corridor(tmp_path_factory.mktemp("tunnel") / "corridor.npz", length=40.0)
    goal = GoalParams(low=4.0, high=12.0, margin=6.0, tolerance=1.0)
    env, params = st.make(TASK, tunnel=str(plan), goal=goal, horizon=150)
    return World(TASK, env, params, {})


def test_a_policy_learns_to_stop_at_its_goal_and_drives_as_it_was_trained(world):
    """Advantages of the wrong sign, or a start that training reads 40 m off, leave it below a tenth."""
    config = TrainConfig(
        steps=250_000, n_envs=64, unroll=32, hidden=(32, 32), learning_rate=1e-3, discount=0.99, last_std=0.1
    )
    learner = make_learner(world, config)
    last = train(learner, world.params)
    assert evaluate(world, make_agent(learner.driver, last.policy), 100)["success"] >= LEAST
    np.testing.assert_array_less(np.exp(last.state.student.weights["log_std"]), 0.1001)


def test_robots_whose_truth_alone_differs_read_and_do_the_same_and_are_asked_for_something_else(world):
    env, params = world.env, world.params
    driver = Driver(env, make_layout(env, params, TrainConfig(hidden=(8,), memory="gru", cell=8, auxiliary=True)))
    policy = Policy(weights_of(driver, 0))
    drive = begin(env, driver, policy, params, jax.random.PRNGKey(1), 2)
    further = dataclasses.replace(drive.env_state, station=drive.env_state.station + 5.0)
    unroll = jax.jit(lambda drive: collect(env, driver, policy, params, drive, jax.random.PRNGKey(2), 1)[1])
    one, other = unroll(drive), unroll(dataclasses.replace(drive, env_state=further))
    for name in ("inputs", "raw", "log_prob", "value"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    np.testing.assert_allclose(one.error - other.error, 5.0, atol=1e-3)
    out = driver.unroll(policy.network, one.inputs, drive.memory, one.first)
    np.testing.assert_allclose(driver.log_prob(out, one.raw), one.log_prob, atol=1e-5)
    assert one.error.shape == (1, 2, 1)
    assert jnp.abs(one.error).max() < 1.0  # at the start nothing is off but the odometer


def test_ppo_learns_to_drive_through_a_corridor(trained):
    last = read_log(trained)[-1]
    assert last["coverage_mean_100"] >= 0.9
    assert last["success_mean_100"] == 1.0
    assert last["timing"]["seconds"] < 60.0


def test_training_stops_once_the_goal_has_held_for_long_enough(trained):
    log, config = read_log(trained), json.loads((trained / "config.json").read_text())["config"]
    assert log[-1]["step"] < config["steps"]
    held = [line["coverage_mean_100"] >= 0.9 and line["success_mean_100"] == 1.0 for line in log]
    assert all(held[-config["stop_patience"] :])


def test_the_rolling_means_of_the_log_are_those_of_the_episodes_file(trained):
    rows = np.genfromtxt(trained / "episodes.csv", delimiter=",", names=True)
    for line in read_log(trained):
        so_far = rows[: line["episodes"]][-100:]
        if len(so_far):
            assert line["coverage_mean_100"] == pytest.approx(so_far["coverage"].mean(), abs=1e-7)
            assert line["success_mean_100"] == so_far["success"].mean()
    assert (np.diff(rows["step"]) >= 0).all()
    np.testing.assert_array_equal(rows["episode"], np.arange(1, len(rows) + 1))


def finished(done, coverage, success, episode_return, length):
    return Finished(*(jnp.asarray(x) for x in (done, coverage, success, ~success, episode_return, length)))


reported = jax.jit(lambda unroll: report(unroll, {}, None))


def add(window, unroll, step):
    ((ended, _),) = fetch(reported(unroll))
    return window.add(ended, step, unroll.done.shape[1])


def random_unroll(rng, n_steps=20, n_envs=9, p_done=0.1):
    shape = (n_steps, n_envs)
    return finished(
        done=rng.random(shape) < p_done,
        coverage=rng.random(shape, np.float32),
        success=rng.random(shape) < 0.5,
        episode_return=rng.random(shape, np.float32),
        length=rng.integers(1, 500, shape, np.int32),
    )


def test_episodes_are_ordered_by_step_and_then_by_environment():
    done = np.array([[False, True, True], [True, False, True]])
    coverage = np.array([[9, 0.1, 0.2], [0.3, 9, 0.4]], np.float32)
    rows = add(EpisodeWindow(), finished(done, coverage, done, coverage, np.full((2, 3), 7, np.int32)), step=60)
    np.testing.assert_array_equal(rows["coverage"], np.array([0.1, 0.2, 0.3, 0.4], np.float32))
    np.testing.assert_array_equal(rows["episode"], [1, 2, 3, 4])
    np.testing.assert_array_equal(rows["step"], [63, 63, 66, 66])


def test_the_window_holds_exactly_the_last_hundred_episodes():
    rng, window, every = np.random.default_rng(0), EpisodeWindow(), []
    for unroll in range(20):
        every.extend(add(window, random_unroll(rng), step=180 * unroll).tolist())
        coverage = [row[2] for row in every][-100:]
        assert window.mean("coverage") == np.float32(coverage).mean(dtype=np.float64)
    assert window.full
    assert window.count == len(every) > 200


@partial(jax.jit, static_argnums=1)
def in_parts(unroll, n_parts):
    """The report of an unroll whose environments are shared out over devices."""
    if n_parts == 1:
        return Report(unroll, in_a_row(unroll), {}, None)
    parts = jax.tree.map(lambda x: jnp.stack(jnp.split(x, n_parts, axis=1)), unroll)
    return Report(parts, jax.vmap(in_a_row)(parts), {}, None)


@pytest.mark.parametrize("n_parts", [1, 2])
def test_more_episodes_than_there_is_room_for_are_fetched_all_the_same(n_parts):
    unroll = random_unroll(np.random.default_rng(3), n_steps=64, n_envs=40, p_done=0.5)
    given = in_parts(unroll, n_parts)
    assert (np.asarray(given.ended.count) > given.ended.index.shape[-1]).all()
    ((ended, _),) = fetch(given)
    time, env = np.nonzero(unroll.done)
    np.testing.assert_array_equal(ended.index, time * 40 + env)
    np.testing.assert_array_equal(ended.coverage, unroll.coverage[time, env])
    np.testing.assert_array_equal(ended.contact, ~np.asarray(unroll.success)[time, env])


@pytest.mark.parametrize("n_parts", [1, 2])
def test_few_episodes_are_the_same_rows_without_the_unroll(n_parts):
    unroll = random_unroll(np.random.default_rng(4), n_steps=64, n_envs=40, p_done=0.02)
    ((ended, _),) = fetch(in_parts(unroll, n_parts))
    time, env = np.nonzero(unroll.done)
    np.testing.assert_array_equal(ended.index, time * 40 + env)
    np.testing.assert_array_equal(ended.length, unroll.length[time, env])


def test_a_policy_that_is_not_to_be_kept_gives_way_to_a_later_one_that_does_worse():
    best = Best.of(None, full_window(0.9, 10.0), 1, named("first"), keep=False)
    assert Best.of(best, full_window(0.1, 1.0), 2, named("later"), keep=False).policy.network == "later"


def test_a_window_survives_json_exactly():
    window = EpisodeWindow()
    assert window.mean("coverage") is None  # without episodes
    add(window, random_unroll(np.random.default_rng(1)), step=0)
    again = EpisodeWindow.from_json(json.loads(json.dumps(window.to_json())))
    assert again.count == window.count
    np.testing.assert_array_equal(again.last, window.last)


def full_window(success, episode_return):
    ones = np.ones((1, 100), np.float32)
    succeeded = np.arange(100)[None] < 100 * success
    window = EpisodeWindow()
    add(window, finished(ones > 0, ones, succeeded, ones * episode_return, ones.astype(np.int32)), step=0)
    return window


def named(name):
    return Policy(name)


def test_the_policy_that_is_kept_is_the_last_that_did_no_worse_than_the_best_hundred():
    best = Best.of(None, full_window(0.9, 10.0), 1, named("first"))
    best = Best.of(best, full_window(0.6, 99.0), 2, named("worse by more than chance"))
    assert best.policy.network == "first"
    best = Best.of(best, full_window(0.85, 11.0), 3, named("as good"))
    best = Best.of(best, full_window(0.7, 11.0), 4, named("worse than the first, not than the third"))
    assert (best.policy.network, best.iteration, best.score[0]) == ("as good", 3, 0.9)
    assert Best.of(best, full_window(0.9, 11.0), 5, named("later")).iteration == 5


def test_no_policy_is_the_best_before_a_hundred_episodes_have_finished():
    best = Best.of(None, EpisodeWindow(), 0, named("untrained"))
    best = Best.of(best, EpisodeWindow(), 1, named("a little trained"))
    assert best.policy.network == "a little trained"
    assert Best.of(best, full_window(0.0, -5.0), 2, named("measured")).policy.network == "measured"


def test_the_rolling_mean_of_a_curve_is_that_of_the_last_hundred():
    values = np.random.default_rng(2).random(350)
    slow = [values[max(0, i - 99) : i + 1].mean() for i in range(350)]
    np.testing.assert_allclose(curve.rolling(values), slow, rtol=1e-12)
