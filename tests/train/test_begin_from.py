import dataclasses

import jax
import numpy as np
import pytest

from subterra_jax import policies as released
from train.checkpoint import CheckpointError
from train.config import ConfigError
from train.policies import policy_tensors
from train.ppo import make_learner
from train.recurrent.config import DistillConfig, RecurrentConfig
from train.world import open_world

NAME = "StopAtShort-v0"
SIZE = {"n_envs": 2, "unroll": 4, "minibatches": 1}


@pytest.fixture(scope="module")
def world(tunnel):
    return open_world("Subterra/StopAtShort-v0", tunnel)


@pytest.fixture(scope="module")
def given():
    return released.load(NAME)


@pytest.mark.parametrize("config_type", [RecurrentConfig, DistillConfig])
def test_a_run_begins_with_the_weights_of_the_policy_that_it_is_told_to_begin_from(world, given, config_type):
    agent, facts = given
    layout = {name: facts["layout"][name] for name in ("hidden", "bins", "bin_width")}
    learner = make_learner(world, config_type(begin_from=NAME, **SIZE, **layout))
    state = jax.jit(learner.init)(jax.random.PRNGKey(0), world.params)
    begun = policy_tensors(learner.networks, learner.policy_of(state))
    assert set(begun) == set(agent.tensors)
    for name, tensor in begun.items():
        np.testing.assert_array_equal(tensor, agent.tensors[name])


def test_a_policy_of_another_size_and_one_that_there_is_not_are_refused_by_name(world, given):
    config = RecurrentConfig(begin_from=NAME, hidden=given[1]["layout"]["hidden"] + 1, **SIZE)
    with pytest.raises((ConfigError, CheckpointError), match=NAME):
        make_learner(world, config)
    with pytest.raises(ConfigError, match="begin_from = nobody: "):
        make_learner(world, dataclasses.replace(config, begin_from="nobody"))
