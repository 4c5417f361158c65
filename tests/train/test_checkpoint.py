import dataclasses
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from train.feedforward import networks
from train.feedforward.learner import Learner

from train import checkpoint, folder, learning, policies
from train.checkpoint import CheckpointError
from train.config import TrainConfig
from train.ppo import begin
from train.world import open_world

LAYOUT = networks.Layout(18, (0.0, -1.5), (2.0, 1.5), 4, (16,), init_std=0.5, min_std=0.01)
FACTS = {"layout": LAYOUT.__dict__, "task": "Subterra/TraverseShort-v1"}


def policy_of(seed):
    nets = networks.Networks(LAYOUT)
    data = jax.random.normal(jax.random.PRNGKey(seed), (50, 18)) * 3.0 + 1.0
    weights = nets.init(jax.random.PRNGKey(seed))["policy"]
    return nets, networks.Policy(weights, learning.update_statistics(learning.start_statistics((18,)), data))


@pytest.fixture
def saved(tmp_path):
    checkpoint.save_checkpoint(tmp_path / "run", 7, {"policy": policy_of(0)[1]}, FACTS)
    return tmp_path / "run"


def test_a_policy_read_back_acts_the_same_to_the_bit(saved):
    nets, policy = policy_of(0)
    again, restored, facts = policies.load_policy(saved)
    stack = jnp.asarray(np.random.default_rng(0).normal(0.0, 9.0, (64, 4, 18)), jnp.float32)
    np.testing.assert_array_equal(again.act(restored, stack), nets.act(policy, stack))
    assert facts["task"] == "Subterra/TraverseShort-v1"


def test_a_checkpoint_can_be_named_by_its_run_its_folder_or_itself(saved):
    for place in (saved, saved / "checkpoint", saved / "checkpoint" / "00000007"):
        assert checkpoint.load_checkpoint(place).path.name == "00000007"


def test_the_last_two_checkpoints_are_kept_and_the_newest_is_read(saved):
    for iteration in (8, 20, 100):
        checkpoint.save_checkpoint(saved, iteration, {"policy": policy_of(iteration)[1]}, FACTS)
    assert sorted(path.name for path in (saved / "checkpoint").iterdir()) == ["00000020", "00000100"]
    assert checkpoint.load_checkpoint(saved).path.name == "00000100"


def test_what_a_kill_leaves_behind_is_never_read(saved):
    shutil.copytree(saved / "checkpoint" / "00000007", saved / "checkpoint" / ".00000009.partial")
    assert checkpoint.load_checkpoint(saved).path.name == "00000007"
    checkpoint.save_checkpoint(saved, 9, {"policy": policy_of(1)[1]}, FACTS)
    assert checkpoint.load_checkpoint(saved).path.name == "00000009"


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # a thread of the storage library's
def test_a_truncated_checkpoint_is_a_clear_error_whichever_file_it_is(saved, tmp_path):
    place = saved / "checkpoint" / "00000007"
    files = [path for path in place.rglob("*") if path.is_file() and path.stat().st_size > 0]
    assert len(files) > 2
    refused = 0
    for path in files:
        copy = tmp_path / "copy"
        shutil.copytree(place, copy)
        victim = copy / path.relative_to(place)
        victim.write_bytes(victim.read_bytes()[: victim.stat().st_size // 2])
        try:
            restored, message = policies.load_policy(copy)[1], None
        except CheckpointError as error:
            restored, message = None, str(error)
        if message is None:  # a file that holds nothing needed
            jax.tree.map(np.testing.assert_array_equal, restored, policy_of(0)[1])
        else:
            assert str(copy) in message
            assert "damaged checkpoint" in message
            refused += 1
        shutil.rmtree(copy)
    assert refused >= 2


def test_an_array_that_was_changed_is_refused(saved, tmp_path):
    other = tmp_path / "other"
    checkpoint.save_checkpoint(other, 7, {"policy": policy_of(1)[1]}, FACTS)
    arrays = saved / "checkpoint" / "00000007" / "arrays"
    shutil.rmtree(arrays)
    shutil.copytree(other / "checkpoint" / "00000007" / "arrays", arrays)
    with pytest.raises(CheckpointError, match="not those that were written"):
        checkpoint.load_checkpoint(saved)


def test_a_missing_checkpoint_is_a_clear_error(tmp_path):
    with pytest.raises(CheckpointError, match="no such folder"):
        checkpoint.load_checkpoint(tmp_path / "nowhere")
    with pytest.raises(CheckpointError, match="holds no checkpoint"):
        checkpoint.load_checkpoint(tmp_path)


def test_the_checkpoint_of_another_network_is_refused_with_both_shapes(saved):
    facts = saved / "checkpoint" / "00000007" / checkpoint.FACTS
    values = json.loads(facts.read_text())
    values["layout"]["hidden"] = [24]
    facts.write_text(json.dumps(values))
    with pytest.raises(CheckpointError, match=r"another network: .*\[16\].*\[24\]"):
        policies.load_policy(saved)


def test_a_file_of_another_schema_is_refused_by_field(saved):
    facts = saved / "checkpoint" / "00000007" / checkpoint.FACTS
    facts.write_text('{"schema": "subterra.tunnel/1"}')
    with pytest.raises(CheckpointError, match="'schema'"):
        policies.load_policy(saved)


def test_a_resumed_run_knows_for_how_long_the_goal_has_held(tunnel, tmp_path):
    world = open_world("Subterra/TraverseShort-v1", tunnel)
    learner = Learner(world.env, world.params, TrainConfig(n_envs=4, unroll=8, minibatches=2, hidden=(8,)))
    run = folder.RunFolder(tmp_path / "run", world, learner)
    run.start()
    run.save(dataclasses.replace(begin(learner, world.params), iteration=9, solved_for=3))
    assert (run.resume().iteration, run.resume().solved_for) == (9, 3)
