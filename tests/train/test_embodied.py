"""Navigation for the B2: what is learnt on, what is refused before anything is compiled, and the trial on legs."""

import json

import numpy as np
import pytest

from subterra_jax.b2 import tasks
from subterra_jax.b2.transfer import Lag, LaggedWheels
from subterra_jax.policies import PolicyError
from train import __main__ as navigate
from train.__main__ import read_command
from train.b2 import embodied
from train.config import ConfigError, Legs

SHORT = "Subterra/TraverseShort-v1"
NO_TRIAL = Legs(robots=0)


@pytest.fixture(scope="module")
def world():
    return embodied.open_world(SHORT, None, None, NO_TRIAL)


def test_the_stand_in_is_told_what_the_legs_are_told_and_obeys_as_late(world):
    mission, params = tasks.make_mission(policy="trot")
    assert isinstance(world.env.motion, LaggedWheels)
    assert world.env.motion.lag == Lag()
    assert world.facts["embodiment"] == "b2"
    bounds, legs = world.env.action_space(world.params), mission.action_space(params)
    np.testing.assert_array_equal(bounds.high, legs.high)
    assert world.env.observation_size(world.params) == mission.observation_size(params)
    assert float(world.params.vehicle.period) == float(params.vehicle.period)
    assert float(world.params.start.station) == float(params.start.station)


def test_the_scout_is_who_drives_unless_told_otherwise():
    assert read_command(["--out", "x"]).embodiment == "scout"
    asked = read_command(["--out", "x", "--embodiment", "b2", "--legs.gait", "trot", "--legs.robots", "3"])
    assert asked.embodiment == "b2"
    assert asked.legs == Legs(gait="trot", robots=3)


@pytest.mark.parametrize(
    ("task", "tunnel", "legs", "error", "said"),
    [
        ("Subterra/StopAt-v1", None, NO_TRIAL, ConfigError, "does not do 'Subterra/StopAt-v1'"),
        (SHORT, None, Legs(gait="nobody"), PolicyError, "nobody: no such policy"),
        (SHORT, None, Legs(robots=-1), ConfigError, "robots must not be negative, got -1"),
        (SHORT, "open:train:0-1", NO_TRIAL, ConfigError, "the B2 walks one"),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(task, tunnel, legs, error, said):
    with pytest.raises(error, match=said):
        embodied.open_world(task, tunnel, None, legs)


@pytest.mark.slow
def test_a_policy_learnt_on_the_stand_in_drives_robots_on_legs(tmp_path):
    out = tmp_path / "run"
    words = ["--out", str(out), "--embodiment", "b2", "--task", SHORT, "--steps", "600000"]
    asked = read_command([*words, "--legs.robots", "4", "--legs.engine", "mujoco", "--evaluation-episodes", "50"])
    assert navigate.command(asked) == 0
    told = json.loads((out / embodied.ON_LEGS).read_text())
    assert told["robots"] == 4
    assert told["success_percent"] == 100.0
    assert told["fall_percent"] == 0.0
