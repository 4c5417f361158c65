"""Finished episodes of a run: their order, the window of a hundred, the policy that is kept."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from train import curve
from train.driver import Policy
from train.report import Finished, Report, fetch, in_a_row, report
from train.snapshot import Best, EpisodeWindow


def finished(done, coverage, success, episode_return, length):
    return Finished(*(jnp.asarray(x) for x in (done, coverage, success, ~success, episode_return, length)))


def add(window, unroll, step):
    ((ended, _),) = fetch(report(unroll, {}, None))
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


def test_a_window_without_episodes_has_no_mean():
    assert EpisodeWindow().mean("coverage") is None


def test_a_window_survives_json_exactly():
    window = EpisodeWindow()
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
