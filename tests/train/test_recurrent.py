import dataclasses
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from tests.train.conftest import call, log_without_timing
from train import checkpoint, navigate
from train.config import ConfigError
from train.recurrent import drive
from train.recurrent.config import (
    RecurrentConfig,
    check_recurrent,
    make_recurrent_config,
)
from train.recurrent.drive import make_layout
from train.recurrent.learner import RecurrentLearner, nearer
from train.recurrent.network import RecurrentLayout, RecurrentNetworks, estimation_loss

TASK = "Subterra/StopAtShort-v1"
CONFIG = RecurrentConfig(steps=512, n_envs=8, unroll=32, minibatches=2, epochs=1, hidden=8, bins=9)
SMALL = ("--n-envs=8", "--unroll=32", "--minibatches=2", "--epochs=1", "--hidden=8", "--bins=9")


def test_memory_begins_anew_with_every_episode_and_goes_on_between_unrolls():
    env, params = st.make(TASK)
    networks = RecurrentNetworks(make_layout(env, params, CONFIG))
    weights = networks.init(jax.random.PRNGKey(0))
    features = jax.random.normal(jax.random.PRNGKey(1), (7, 3, networks.layout.n_features))
    first = jnp.zeros((7, 3), bool).at[4, 1].set(True)
    begun = jax.random.normal(jax.random.PRNGKey(2), (3, 8))
    last, hidden = networks.remember(weights, features, begun, first)
    halfway, early = networks.remember(weights, features[:4], begun, first[:4])
    np.testing.assert_allclose(early, hidden[:4], atol=1e-6)
    np.testing.assert_allclose(networks.remember(weights, features[4:], halfway, first[4:])[0], last, atol=1e-6)
    anew, _ = networks.remember(weights, features[4:], jnp.zeros((3, 8)), first[4:])
    np.testing.assert_allclose(anew[1], last[1], atol=1e-6)
    assert np.abs(anew[0] - last[0]).max() > 1e-3


def test_in_16_bits_an_image_weighs_half_and_the_answer_and_its_gradient_stay_near():
    full = RecurrentLayout(
        7 + 64, 3, (0.0, -1.0), (2.0, 1.0), hidden=32, bins=9, bin_width=0.5, init_std=0.5, min_std=0.1, image=(8, 8)
    )
    features = jax.random.uniform(jax.random.key(0), (12, 16, full.n_features))
    first, begun = jnp.zeros((12, 16), bool).at[5, 3].set(True), jnp.zeros((16, 32))
    weights = jax.jit(RecurrentNetworks(full).init)(jax.random.key(1))

    def loss_of(layout):
        networks = RecurrentNetworks(layout)
        kept = networks.keep(features)

        def loss(weights):
            _, hidden = networks.remember(weights, kept, begun, first)
            return jnp.mean(estimation_loss(networks.think(weights, hidden, jnp.ones(())).logits, first - 0.5, 0.5))

        return kept, *jax.jit(jax.value_and_grad(loss))(weights)

    whole, loss, gradient = loss_of(full)
    half, near, other = loss_of(dataclasses.replace(full, half=True))
    assert 2 * half.image.nbytes == whole.image.nbytes
    assert half.plain.dtype == whole.plain.dtype == jnp.float32
    assert float(near) == pytest.approx(float(loss), rel=0.01)
    assert float(near) != float(loss)
    one, two = (np.concatenate([leaf.ravel() for leaf in jax.tree.leaves(t["memory"])]) for t in (gradient, other))
    assert two.dtype == np.float32
    assert np.linalg.norm(one - two) < 0.03 * np.linalg.norm(one)


def test_the_value_target_of_a_truncated_step_goes_on_with_the_value_it_had():
    env, params = st.make(TASK, horizon=5)
    learner = RecurrentLearner(env, params, CONFIG)
    state = learner.init(jax.random.PRNGKey(0), params)
    after, rollout, _, _ = drive.collect(
        learner.env, params, learner.networks, state.weights, state.drive, jax.random.PRNGKey(1), CONFIG.unroll
    )
    scale = jnp.float32(2.0)
    target = np.asarray(learner._lesson(state, rollout, after, params, scale).target)
    value = np.asarray(learner.networks.value(state.weights, rollout.truth))
    cut = np.asarray(rollout.truncated & ~rollout.terminated)
    assert cut.sum() > 20
    assert np.abs(value[cut]).min() > 1e-4
    wanted = np.asarray(rollout.reward) / 2.0 + CONFIG.discount * value
    np.testing.assert_allclose(target[cut], wanted[cut], atol=1e-5)


def test_an_error_between_two_bins_is_shared_between_them():
    # Nine bins of 0.25 m about 0: the fifth has its middle at 0.
    logits = jnp.log(jnp.arange(1.0, 10.0) / 45.0)
    missed = estimation_loss(jnp.tile(logits, (3, 1)), jnp.array([0.0, 0.0625, -99.0]), 0.25)
    wanted = [np.log(45.0 / 5.0), 0.75 * np.log(45.0 / 5.0) + 0.25 * np.log(45.0 / 6.0), np.log(45.0)]
    np.testing.assert_allclose(missed, wanted, atol=2e-3)


def test_goals_move_away_while_it_learns_and_end_where_the_task_has_them():
    _, params = st.make(TASK)
    near, far, end = (
        nearer(params, progress, CONFIG.curriculum).goal for progress in (0.0, 0.5 * CONFIG.curriculum, 1.0)
    )
    assert near.high < far.high < end.high
    assert float(end.high) == pytest.approx(float(params.goal.high))
    assert float(end.low) == pytest.approx(float(params.goal.low))
    assert (int(near.still_steps), int(end.still_steps)) == (1, int(params.goal.still_steps))
    assert float(end.still_speed) == pytest.approx(float(params.goal.still_speed))


@pytest.mark.parametrize("task", ["Subterra/Traverse-v1", "Subterra/Relocalise-v1"])
def test_a_task_that_has_no_goal_is_refused_before_anything_compiles(task):
    with pytest.raises(ConfigError, match=f"which {task} does not ask for"):
        RecurrentLearner(*st.make(task), CONFIG)


@pytest.mark.parametrize(
    ("name", "value"), [("bins", 2), ("hidden", 0), ("bin_width", 0.0), ("estimate_weight", -1.0), ("minibatches", 3)]
)
def test_a_setting_that_makes_no_sense_is_refused_by_name(name, value):
    with pytest.raises(ConfigError, match=name):
        check_recurrent(dataclasses.replace(CONFIG, **{name: value}))


@pytest.mark.parametrize("preset", ["cpu", "gpu"])
@pytest.mark.parametrize("task", [id for id in st.TASKS])
def test_every_task_has_a_preset_that_makes_sense(task, preset):
    check_recurrent(make_recurrent_config(task, preset))


@pytest.mark.slow
def test_a_run_that_was_killed_goes_on_to_the_same_bytes(tmp_path, capsys):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    line = ("--task", TASK, "--memory", "gru", *SMALL, "--steps=768", "--evaluation-episodes=2", "--checkpoint-every=1")
    assert call(navigate.main, *line, "--out", str(whole)) == 0
    shutil.copytree(whole, killed)
    shutil.rmtree(killed / "checkpoint" / "00000003")
    (killed / "evaluation.json").unlink()
    assert call(navigate.main, *line, "--out", str(killed), "--resume") == 0
    assert log_without_timing(killed) == log_without_timing(whole)
    assert len(log_without_timing(whole)) == 3
    assert (killed / "evaluation.json").read_bytes() == (whole / "evaluation.json").read_bytes()
    assert checkpoint.load_checkpoint(killed).facts["digest"] == checkpoint.load_checkpoint(whole).facts["digest"]
    assert json.loads((whole / "config.json").read_text())["kind"] == "gru"
    # The schedule of goals and learning rate hangs on the steps.
    capsys.readouterr()
    assert call(navigate.main, *line, "--steps=1024", "--out", str(killed), "--resume") == 2
    assert "was trained with steps = 768, not 1024" in capsys.readouterr().err
    assert call(navigate.main, "--task", TASK, "--out", str(killed), "--resume") == 2
    assert "made for another network: gru, not mlp" in capsys.readouterr().err
