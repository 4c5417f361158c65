"""Checkpoints of the trainer: kept, damaged, changed, resumed from."""

import dataclasses
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from train import checkpoint, folder, snapshot
from train.checkpoint import CheckpointError
from train.config import TrainConfig
from train.driver import Driver, Policy
from train.report import Ended
from train.setup import make_layout, make_learner
from train.snapshot import Best, EpisodeWindow, Snapshot
from train.world import open_world

TASK = "Subterra/TraverseShort-v1"
FACTS = {"task": TASK}


def policy_of(seed, hidden=16):
    env, params = st.make(TASK)
    driver = Driver(env, make_layout(env, params, TrainConfig(hidden=(hidden,))))
    return Policy(driver.init(jax.random.PRNGKey(seed)))


def like(hidden=16):
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), policy_of(0, hidden))


@pytest.fixture
def saved(tmp_path):
    checkpoint.save_checkpoint(tmp_path / "run", 7, {"policy": policy_of(0)}, FACTS)
    return tmp_path / "run"


def test_a_policy_is_read_back_to_the_bit(saved):
    stored = checkpoint.load_checkpoint(saved)
    jax.tree.map(np.testing.assert_array_equal, stored.restore("policy", like()), policy_of(0))
    assert stored.facts["task"] == TASK


def test_a_checkpoint_can_be_named_by_its_run_its_folder_or_itself(saved):
    for place in (saved, saved / "checkpoint", saved / "checkpoint" / "00000007"):
        assert checkpoint.load_checkpoint(place).path.name == "00000007"


def test_the_last_two_checkpoints_are_kept_and_the_newest_is_read(saved):
    for iteration in (8, 20, 100):
        checkpoint.save_checkpoint(saved, iteration, {"policy": policy_of(iteration)}, FACTS)
    assert sorted(path.name for path in (saved / "checkpoint").iterdir()) == ["00000020", "00000100"]
    assert checkpoint.load_checkpoint(saved).path.name == "00000100"


def test_what_a_kill_leaves_behind_is_never_read(saved):
    shutil.copytree(saved / "checkpoint" / "00000007", saved / "checkpoint" / ".00000009.partial")
    assert checkpoint.load_checkpoint(saved).path.name == "00000007"
    checkpoint.save_checkpoint(saved, 9, {"policy": policy_of(1)}, FACTS)
    assert checkpoint.load_checkpoint(saved).path.name == "00000009"


@pytest.mark.usefixtures("collected")
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
            restored, message = checkpoint.load_checkpoint(copy).restore("policy", like()), None
        except CheckpointError as error:
            restored, message = None, str(error)
        if message is None:  # a file that holds nothing needed
            jax.tree.map(np.testing.assert_array_equal, restored, policy_of(0))
        else:
            assert str(copy) in message
            assert "damaged checkpoint" in message
            refused += 1
        shutil.rmtree(copy)
    assert refused >= 2


def test_an_array_that_was_changed_is_refused(saved, tmp_path):
    other = tmp_path / "other"
    checkpoint.save_checkpoint(other, 7, {"policy": policy_of(1)}, FACTS)
    arrays = saved / "checkpoint" / "00000007" / "arrays"
    shutil.rmtree(arrays)
    shutil.copytree(other / "checkpoint" / "00000007" / "arrays", arrays)
    with pytest.raises(CheckpointError, match="not those that were written"):
        checkpoint.load_checkpoint(saved)


def test_what_cannot_be_restored_is_refused_with_its_cause(saved, tmp_path):
    with pytest.raises(CheckpointError, match="no such folder"):
        checkpoint.load_checkpoint(tmp_path / "nowhere")
    with pytest.raises(CheckpointError, match="holds no checkpoint"):
        checkpoint.load_checkpoint(tmp_path)
    with pytest.raises(CheckpointError, match=r"another network: .*\[16\].*\[24\]"):
        checkpoint.load_checkpoint(saved).restore("policy", like(24))
    (saved / "checkpoint" / "00000007" / checkpoint.FACTS).write_text('{"schema": "subterra.tunnel/1"}')
    with pytest.raises(CheckpointError, match="'schema'"):
        checkpoint.load_checkpoint(saved)


def test_a_resumed_run_knows_its_best_score_and_for_how_long_the_goal_has_held(tunnel, tmp_path):
    world = open_world(TASK, tunnel)
    learner = make_learner(world, TrainConfig(n_envs=4, unroll=8, minibatches=2, hidden=(8,)))
    run = folder.RunFolder(tmp_path / "run", world, learner)
    run.start()
    state = jax.eval_shape(learner.init, jax.random.PRNGKey(0), world.params)
    first = snapshot.started(learner, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), state))
    best = dataclasses.replace(first.best, score=(0.75, 12.5), iteration=4)
    run.save(dataclasses.replace(first, iteration=9, solved_for=3, best=best))
    again = run.resume()
    assert (again.iteration, again.solved_for) == (9, 3)
    assert (again.best.score, again.best.iteration) == ((0.75, 12.5), 4)


@pytest.mark.parametrize(("succeeded", "held"), [(1.0, 1), (0.99, 0), (0.6, 0)])
def test_the_goal_holds_where_every_one_of_a_hundred_episodes_succeeded(succeeded, held):
    n = 100
    good = np.arange(n) < n * succeeded
    ended = Ended(n, np.arange(n), np.full(n, 0.95, np.float32), good, ~good, np.ones(n), np.full(n, 9))
    config = TrainConfig(stop_coverage=0.9, n_envs=4, unroll=8)
    before = Snapshot(0, None, EpisodeWindow(), Best.of(None, EpisodeWindow(), 0, None))
    assert snapshot.advance(before, None, None, ended, {}, config).solved_for == held


def test_a_reward_that_is_no_number_ends_the_training_in_one_sentence():
    ended = Ended(0, *(np.zeros(0) for _ in range(6)))
    before = Snapshot(0, None, EpisodeWindow(), Best.of(None, EpisodeWindow(), 0, None))
    for name, error in (("reward_mean", snapshot.RewardError), ("policy_loss", snapshot.TrainingError)):
        with pytest.raises(error, match=r"^iteration 1: .*finite"):
            snapshot.advance(before, None, None, ended, {name: np.float32("nan")}, TrainConfig())
