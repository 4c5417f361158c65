"""The released gait on its legs, in MJX."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from subterra_jax.b2 import gait as gaits
from subterra_jax.policies import load


@pytest.fixture(scope="module")
def gait():
    return gaits.load_policy()


def test_the_released_gait_is_what_the_package_loads_by_name(gait, walking):
    policy, facts = load(gaits.RELEASED)
    assert policy.tensors.keys() == gait[0].tensors.keys()
    for name, tensor in policy.tensors.items():
        np.testing.assert_array_equal(tensor, gait[0].tensors[name])
    assert facts["task"] == "Subterra/B2Walk-v1"
    gaits.check_fits(policy, walking.env.observation_size(walking.params), gaits.RELEASED)


def test_its_facts_say_that_it_meets_its_goals_on_a_thousand_robots(gait):
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
