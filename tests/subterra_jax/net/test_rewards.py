"""Rewards: docs/tasks.md, "Reward"; the task design has the weights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.subterra_jax.net.robots import FEW, advanced, begun, made, placed, stand


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


@pytest.mark.parametrize("id", ["Subterra/StopAt-v1", "Subterra/StopAtShort-v1"])
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
    id = "Subterra/StopAt-v1"
    error = np.linspace(0.0, 40.0, FEW)
    state = begun(id, FEW)
    state = placed(id, state.replace(goal=state.goal.replace(station=jnp.full(FEW, 100.0))), 100.0 + error)
    _, gain, _, _ = stand(id, state, 10)
    assert (np.diff(gain) < 0.0).all()
    assert gain[0] == pytest.approx(8.0, abs=0.01)
    assert gain[-1] == pytest.approx(-0.05 * 40.0, abs=0.01)


def test_the_terms_of_eq_1_are_those_that_are_written_down():
    id = "Subterra/Traverse-v1"
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
    """Cases of T0: on the way, and where nine tenths are covered."""
    n, length = FEW, float(made(id)[1].tunnel.length)
    command = np.tile([1.5, 0.2], (n, 1))
    for station in (100.0, 0.9 * length):
        state = placed(id, begun(id, n), np.random.default_rng(0).uniform(station - 0.3, station + 0.3, n))
        state = state.replace(furthest=jnp.full(n, station - 0.1))
        state, *_ = advanced(id, state, command)
        yield state, command, np.tile([0.7, -0.3], (n, 1))


def test_ground_covered_before_earns_nothing():
    env, params, *_ = made("Subterra/TraverseShort-v1")
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
