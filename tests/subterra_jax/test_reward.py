"""Eq. 1 of the paper, term by term."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.rules.traverse import RewardParams, reward_terms

TASK = "Subterra/TraverseShort-v1"


def terms(**changes):
    values = {
        "success": jnp.array(False),
        "newly_covered": jnp.float32(0.0),
        "length": jnp.float32(351.0),
        "lateral": jnp.float32(0.0),
        "half_width": jnp.float32(2.8),
        "command": jnp.zeros(2),
        "previous": jnp.zeros(2),
        "params": RewardParams(),
    }
    return {name: float(value) for name, value in reward_terms(**{**values, **changes}).items()}


def test_each_term_has_its_published_form_and_its_weight():
    assert all(value == 0.0 for value in terms().values())
    assert terms(success=jnp.array(True))["reward_terminal"] == 1.0
    assert terms(newly_covered=jnp.float32(0.2))["reward_coverage"] == pytest.approx(100 * 0.2 / 351)
    assert terms(lateral=jnp.float32(-1.4))["reward_lateral"] == pytest.approx(-0.1 * 0.5)
    jerk = terms(command=jnp.array([2.0, -1.0]), previous=jnp.array([1.5, 0.5]))["reward_jerk"]
    assert jerk == pytest.approx(-0.01 * (0.5 + 1.5))


def test_weights_are_those_of_the_params():
    heavy = RewardParams(terminal=7.0, coverage=0.0, lateral=0.0, jerk=1.0)
    assert terms(success=jnp.array(True), params=heavy)["reward_terminal"] == 7.0
    assert terms(newly_covered=jnp.float32(9.0), params=heavy)["reward_coverage"] == 0.0


def test_ground_covered_before_earns_nothing():
    env, params = st.make(TASK)
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
