"""Navigation for the B2: what is learnt on, what is refused before anything is compiled, and the trial on legs."""

import numpy as np
import pytest

from benchmarks import b2_traverse
from benchmarks.records import read_records
from subterra_jax.b2 import tasks
from subterra_jax.b2.transfer import Lag, LaggedWheels
from train import __main__ as navigate
from train.__main__ import read_command
from train.b2 import embodied
from train.config import ConfigError

SHORT = "Subterra/TraverseShort-v1"


@pytest.fixture(scope="module")
def world():
    return embodied.open_world(SHORT, None, None)


def test_the_stand_in_is_told_what_the_legs_are_told_and_obeys_as_late(world):
    mission, params = tasks.make_mission(policy="trot")
    assert isinstance(world.env.motion, LaggedWheels)
    assert world.env.motion.lag == Lag()
    assert world.facts["motion"] == "b2"
    bounds, legs = world.env.action_space(world.params), mission.action_space(params)
    np.testing.assert_array_equal(bounds.high, legs.high)
    assert world.env.observation_size(world.params) == mission.observation_size(params)
    assert float(world.params.vehicle.period) == float(params.vehicle.period)
    assert float(world.params.start.station) == float(params.start.station)


@pytest.mark.parametrize(
    ("task", "tunnel", "said"),
    [
        ("Subterra/StopAt-v1", None, "does not do 'Subterra/StopAt-v1'"),
        (SHORT, "open:train:0-1", "the B2 walks one"),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(task, tunnel, said):
    with pytest.raises(ConfigError, match=said):
        embodied.open_world(task, tunnel, None)


@pytest.mark.slow
def test_a_policy_learnt_on_the_stand_in_drives_robots_on_legs(tmp_path):
    out, words = tmp_path / "run", ["--motion", "b2", "--task", SHORT, "--steps", "600000"]
    assert navigate.command(read_command(["--out", str(out), *words, "--evaluation-episodes", "50"])) == 0
    asked = b2_traverse.Command(robots=4, agent=str(out), engine="mujoco", length=60.0, out=tmp_path / "legs.json")
    b2_traverse.command(asked)
    told = {record.id.rpartition("/")[2]: record.value for record in read_records(asked.out)}
    assert (told["success"], told["fall"], told["robots"]) == (100.0, 0.0, 4.0)
