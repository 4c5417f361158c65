"""PPO learns to stop at a goal without memory, up to what dead reckoning is worth; what breaks it is noticed."""

import dataclasses

import jax
import numpy as np
import pytest

from subterra_jax.policies import inputs
from train import learner as learners
from train.config import make_config
from train.ppo import train
from train.setup import make_learner
from train.world import open_world

TASK = "Subterra/StopAtShort-v1"
LEAST = 0.12  # of the last hundred training episodes, exploration noise included; runs have 0.2 to 0.3


@pytest.fixture(scope="module")
def world():
    return open_world(TASK, "open:train:0-3")


def success(world, steps=1_000_000) -> float:
    """Share of the last hundred episodes of a training that stopped at their goal."""
    config = dataclasses.replace(make_config(TASK, "cpu"), steps=steps)
    found = []
    train(make_learner(world, config), world.params, log=lambda line: found.append(line["success_mean_100"]))
    return float(np.mean([share or 0.0 for share in found[-20:]]))


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_a_policy_learns_to_stop_at_its_goal_in_a_million_steps(world):
    assert success(world) >= LEAST


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_a_start_reported_40_m_off_in_training_alone_is_not_learnt(world, monkeypatch):
    honest = inputs.way_to_go
    shifted = lambda now, obs, params: honest(now, obs, params) + 40.0  # noqa: E731
    monkeypatch.setattr(inputs, "way_to_go", shifted)
    assert success(world) < LEAST


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_advantages_of_the_wrong_sign_do_not_teach(world, monkeypatch):
    honest = learners.devices.normalised
    monkeypatch.setattr(learners.devices, "normalised", lambda values, parts: -honest(values, parts))
    assert success(world, 400_000) < LEAST


def test_one_seed_gives_one_result(world):
    config = dataclasses.replace(make_config(TASK, "cpu"), steps=2048, n_envs=16, unroll=32, hidden=(8,))
    one, other = (train(make_learner(world, config), world.params) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, one.state.student.weights, other.state.student.weights)
