"""Advantages, running statistics and discounted returns against slow definitions."""

import dataclasses
import os
import subprocess
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.train.conftest import TASK, call
from train import __main__ as navigate
from train import devices, learning, localiser, map_target
from train.config import TrainConfig


def slow_advantages(reward, value, last_value, final_value, terminated, truncated, discount, gae_lambda):
    """Straight from the definition: the discounted sum of one-step errors up to the end of the episode."""
    n_steps, n_envs = reward.shape
    result = np.zeros((n_steps, n_envs))
    for env in range(n_envs):
        for begin in range(n_steps):
            weight = 1.0
            for t in range(begin, n_steps):
                if terminated[t, env]:
                    following = 0.0
                elif truncated[t, env]:
                    following = final_value[t, env]
                else:
                    following = value[t + 1, env] if t + 1 < n_steps else last_value[env]
                result[begin, env] += weight * (reward[t, env] + discount * following - value[t, env])
                weight *= discount * gae_lambda
                if terminated[t, env] or truncated[t, env]:
                    break
    return result


def random_rollout(rng, n_steps=40, n_envs=7):
    normal = lambda *shape: rng.standard_normal(shape).astype(np.float32)  # noqa: E731
    terminated, truncated = rng.random((n_steps, n_envs)) < 0.1, rng.random((n_steps, n_envs)) < 0.1
    assert (terminated & truncated).any()
    assert (truncated & ~terminated).any()
    shapes = ((n_steps, n_envs), (n_steps, n_envs), (n_envs,), (n_steps, n_envs))
    return *(normal(*shape) for shape in shapes), terminated, truncated


def test_advantages_equal_the_definition_with_both_ends_of_an_episode():
    for seed in range(3):
        data = random_rollout(np.random.default_rng(seed))
        fast = learning.advantages(*(jnp.asarray(x) for x in data), discount=0.97, gae_lambda=0.9)
        np.testing.assert_allclose(fast, slow_advantages(*data, 0.97, 0.9), rtol=1e-4, atol=1e-5)


def test_advantages_have_no_mean_and_unit_spread_over_all_parts():
    values = jnp.asarray(np.random.default_rng(0).normal(3.0, 5.0, (4, 8, 3)), jnp.float32)
    alike = jax.vmap(lambda part: devices.normalised(part, ("part",)), axis_name="part")(values)
    np.testing.assert_allclose(alike, devices.normalised(values, ()), atol=1e-5)
    assert float(jnp.mean(alike)) == pytest.approx(0.0, abs=1e-5)
    assert float(jnp.std(alike)) == pytest.approx(1.0, abs=1e-4)


def test_the_auxiliary_loss_is_the_negative_log_likelihood_of_laplace():
    estimate, error = jnp.array([[1.0, 0.7], [2.0, -0.4]]), jnp.array([[1.5], [0.0]])
    expected = np.mean([0.5 * np.exp(-0.7) + 0.7, 2.0 * np.exp(0.4) - 0.4])
    assert float(learning.auxiliary_loss(estimate, error)) == pytest.approx(expected, rel=1e-6)


def test_running_statistics_equal_those_of_all_the_data_at_once():
    rng = np.random.default_rng(0)
    data = (rng.standard_normal((6, 50, 20, 3)) * [1.0, 5.0, 0.1] + [0.0, 20.0, -3.0]).astype(np.float32)
    statistics = learning.start_statistics((3,))
    for batch in data:
        statistics = learning.update_statistics(statistics, jnp.asarray(batch))
    np.testing.assert_allclose(statistics.mean, data.mean(axis=(0, 1, 2)), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(statistics.std, data.std(axis=(0, 1, 2)), rtol=1e-4)


def test_normalized_observations_have_no_mean_and_unit_variance():
    data = jnp.asarray(np.random.default_rng(1).normal(7.0, 3.0, (1000, 2)), jnp.float32)
    statistics = learning.update_statistics(learning.start_statistics((2,)), data)
    normal = learning.normalize(data, statistics.mean, statistics.std)
    np.testing.assert_allclose(normal.mean(axis=0), 0.0, atol=1e-4)
    np.testing.assert_allclose(normal.std(axis=0), 1.0, rtol=1e-4)


def test_a_reading_that_never_moved_stays_finite_and_clipped():
    statistics = learning.update_statistics(learning.start_statistics((1,)), jnp.zeros((100, 1)))
    assert float(learning.normalize(jnp.array([5.0]), statistics.mean, statistics.std)[0]) == 10.0


def test_discounted_returns_begin_anew_with_every_episode_and_go_on_between_unrolls():
    reward = jnp.ones((4, 1))
    done = jnp.array([[False], [True], [False], [False]])
    after, returns = learning.discounted_returns(jnp.array([4.0]), reward, done, 0.5)
    np.testing.assert_allclose(returns[:, 0], [3.0, 2.5, 1.0, 1.5])
    np.testing.assert_allclose(after, [1.5])
    after, _ = learning.discounted_returns(after, reward[:1], jnp.array([[True]]), 0.5)
    np.testing.assert_allclose(after, [0.0])


ALONG = TrainConfig(memory="along", auxiliary=True, drives=2, steps=10 * 128 * 64)
ROVER = SimpleNamespace(vehicle=SimpleNamespace(period=0.1, speed_max=2.0))


def test_the_localiser_learns_ever_more_slowly_down_to_a_fiftieth(monkeypatch):
    learner = localiser.LocaliserLearner(None, ROVER, ALONG)
    up = lambda weights, part: ((jnp.zeros(()), {}), jax.tree.map(jnp.ones_like, weights))  # noqa: E731
    monkeypatch.setattr(learner, "_gradients", up)
    monkeypatch.setattr(localiser, "record_drives", lambda *_: jnp.zeros(2))
    before = dataclasses.replace(jax.jit(learner.init)(jax.random.PRNGKey(0)), steps=jnp.int32(1000))
    bias = lambda state: float(state.weights["out"]["bias"][0])  # noqa: E731
    learn = jax.jit(lambda iteration: learner.learn(before, None, ROVER, jax.random.PRNGKey(1), iteration)[0])
    moved = [bias(before) - bias(learn(iteration)) for iteration in (0, 5, 10)]
    np.testing.assert_allclose(moved, ALONG.localiser_rate * np.array([1.0, 0.51, 0.02]), rtol=1e-2)


def test_a_wrong_map_is_of_a_place_at_least_50_m_away():
    tunnel = SimpleNamespace(count=1, length=jnp.float32(300.0))
    drive = SimpleNamespace(start=jnp.linspace(0.0, 250.0, 4000), tunnel=jnp.zeros(4000, jnp.int32))
    given = jax.jit(lambda key: map_target.draw_cases(key, drive, SimpleNamespace(tunnel=tunnel)))(jax.random.key(0))
    wrong, away = ~np.asarray(given.right), np.abs(np.asarray(given.shift))
    assert np.mean(wrong) == pytest.approx(0.2, abs=0.02)
    assert np.mean(np.asarray(given.sigma) > 0.0) == pytest.approx(0.5, abs=0.03)
    assert np.minimum(away, 300.0 - away)[wrong].min() > 49.99
    assert (away[~wrong] == 0.0).all()


TWO_DEVICES = """
import dataclasses, sys
import jax, numpy as np
from train.config import TrainConfig
from train.devices import Spread
from train.setup import make_learner
from train.world import open_world

one, two = jax.devices()
world = open_world(sys.argv[1], sys.argv[2])
config = TrainConfig(n_envs=8, unroll=16, minibatches=2, epochs=1, hidden=(8,), parts=2, steps=256)
inner = make_learner(world, config).learner
runs = {}
for devices in ((one,), (one, two)):
    learner = Spread(inner, list(devices))
    assert learner.mesh.size == len(devices)
    params = learner.share(world.params)
    state = jax.jit(learner.init)(learner.share(jax.random.PRNGKey(0)), params)
    iterate = jax.jit(learner.iterate)
    for _ in range(2):
        middle, state = state, iterate(state, params)[0]
    runs[len(devices)] = learner, params, iterate, learner.gather(middle), learner.gather(state)
alike = lambda a, b: jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-5), a, b)
alike(runs[1][-1], runs[2][-1])
learner, params, iterate, *_ = runs[2]  # what one device left, two go on with
alike(learner.gather(iterate(learner.place(runs[1][-2]), params)[0]), runs[1][-1])
moved = jax.tree.map(lambda x, y: np.abs(x - y).max(), runs[1][-2].student.weights, runs[1][-1].student.weights)
assert max(jax.tree.leaves(moved)) > 1e-6
"""


def test_two_devices_come_to_what_one_does_and_go_on_from_its_state(tunnel):
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags}
    words = [sys.executable, "-c", TWO_DEVICES, TASK, str(tunnel)]
    ran = subprocess.run(words, env=environment, capture_output=True, text=True, check=False, timeout=200)
    assert ran.returncode == 0, ran.stderr


def test_parts_that_do_not_divide_the_environments_and_seeds_with_parts_are_refused(tmp_path, capsys):
    out = ("--task", TASK, "--out", str(tmp_path / "run"), "--preset=cpu")
    assert call(navigate.main, *out, "--parts=3") == 2
    assert "n_envs = 128 cannot be divided into parts = 3 of minibatches = 4" in capsys.readouterr().err
    assert call(navigate.main, *out, "--parts=2", "--seeds", "0", "1") == 2
    assert "parts = 2 cannot be trained for several seeds at once" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
