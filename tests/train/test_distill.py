import dataclasses
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.baselines import registry
from tests.subterra_jax.probes import PROBES
from tests.train.conftest import call, log_without_timing
from train import checkpoint, navigate
from train.config import ConfigError
from train.recurrent import lessons
from train.recurrent.config import DistillConfig, check_distill, make_distill_config
from train.recurrent.distill import DistillLearner

TASK = "Subterra/StopAtShort-v1"
CONFIG = DistillConfig(steps=512, n_envs=4, unroll=32, minibatches=2, hidden=8, bins=9)
SMALL = (
    "--n-envs=16",
    "--unroll=64",
    "--minibatches=2",
    "--hidden=16",
    "--bins=9",
    "--learning-rate=0.005",
    "--handover=1",
)


@pytest.fixture(scope="module")
def learner(tunnel):
    env, params = st.make(TASK, tunnel=tunnel)
    return DistillLearner(env, params, CONFIG, registry.make_agent("oracle", params)), params


def test_what_a_teacher_wants_before_the_tanh_gives_its_action_after_it(learner):
    networks = learner[0].networks
    advice = jnp.array([[0.1, 0.3], [1.2, -1.4], [1.9, 0.0]])
    np.testing.assert_allclose(networks.action(learner[0]._before_tanh(advice)), advice, atol=1e-5)
    # Backing up is standing.
    assert (networks.action(learner[0]._before_tanh(jnp.zeros((1, 2)))) < jnp.array([-0.4, 0.01])).all()
    # The ends cannot be reached; what comes closest is finite.
    ends = networks.action(learner[0]._before_tanh(jnp.array([[2.0, 1.5], [2.0, -1.5]])))
    np.testing.assert_allclose(ends, [[2.0, 1.5], [2.0, -1.5]], atol=0.04)


@pytest.mark.parametrize("name", ["nothing", "truth", "ranges", "map"])
def test_a_teacher_gets_what_it_declares_and_no_more(learner, name):
    agent, speed = PROBES[name]
    env, params = learner[0].env.env, learner[1]
    observation, state = learner[0].env.reset(jax.random.key(0), params, 2)
    memory = lessons.blank(env, agent, params, 2)
    advise = jax.jit(lambda *seen: lessons.advise(env, agent, *seen, jnp.ones(2, bool), params))
    advice, _ = advise(jax.random.key(1), memory, observation, state)
    np.testing.assert_allclose(advice[:, 0], speed, rtol=1e-4)


def test_a_teacher_who_is_not_obeyed_remembers_what_was_done_and_has_not_arrived(learner):
    agent, env, params = learner[0].teacher, learner[0].env.env, learner[1]
    observation, state = learner[0].env.reset(jax.random.key(0), params, 2)
    memory = lessons.blank(env, agent, params, 2)
    # At the goal already, the oracle's advice is to stand; it is driven on all the same.
    there = observation.at[:, env.fields(params)["goal"]].set(state.station[:, None])
    advise = jax.jit(lambda *seen: lessons.advise(env, agent, *seen, jnp.ones(2, bool), params))
    advice, after = advise(jax.random.key(1), memory, there, state)
    np.testing.assert_allclose(advice[:, 0], 0.0, atol=1e-6)
    assert after.mission.stopped.all()
    done = jnp.array([[1.5, 0.1], [0.7, -0.2]])
    told = lessons.correct_memory(memory, after, done)
    np.testing.assert_array_equal(told.command, done)
    assert not told.mission.stopped.any()


@pytest.mark.parametrize(("name", "value"), [("handover", 1.5), ("imitation_weight", -1.0), ("minibatches", 3)])
def test_a_setting_that_makes_no_sense_is_refused_by_name(name, value):
    with pytest.raises(ConfigError, match=name):
        check_distill(dataclasses.replace(CONFIG, **{name: value}))


@pytest.mark.parametrize("preset", ["cpu", "gpu"])
def test_every_task_has_a_preset_that_makes_sense(preset):
    for task in st.TASKS:
        check_distill(make_distill_config(task, preset))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--teacher", "oracle"), "teacher = oracle teaches a policy with memory; give --memory gru as well"),
        (("--memory", "gru", "--teacher", "nobody", "--task", TASK), "teacher = nobody is no baseline"),
        (("--memory", "gru", "--teacher", "oracle", "--task", "Subterra/Relocalise-v1"), "does not ask for"),
        (("--memory", "gru", "--teacher", "TraverseShort-v1", "--task", TASK), "observations of 18 numbers"),
        (("--memory", "gru", "--teacher", "oracle", "--task", TASK, "--minibatches", "7"), "minibatches = 7"),
        (("--memory", "gru", "--task", "Subterra/Nowhere-v1"), "no task 'Subterra/Nowhere-v1'"),
        (("--memory", "lstm"), "unknown memory 'lstm'; there are none, gru"),
    ],
)
def test_a_mistake_about_teachers_is_one_sentence_and_status_2(tmp_path, capsys, arguments, message):
    assert call(navigate.main, "--out", str(tmp_path / "run"), *arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_a_student_comes_closer_to_its_teacher_and_goes_on_after_a_kill_to_the_same_bytes(tunnel, tmp_path, capsys):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    line = ("--task", TASK, "--tunnel", str(tunnel), "--memory", "gru", "--teacher", "oracle", *SMALL)
    line += ("--steps=24576", "--evaluation-episodes=2", "--checkpoint-every=8")
    assert call(navigate.main, *line, "--out", str(whole)) == 0
    log = log_without_timing(whole)
    assert len(log) == 24
    assert np.mean([line["imitation_loss"] for line in log[-3:]]) < 0.7 * log[0]["imitation_loss"]
    # Only episodes that the student drove are counted; the teacher's end after some 80 steps as well.
    assert log[0]["taught"] == 1.0
    assert [line["finished"] for line in log[:2]] == [0, 0]
    assert log[-1]["taught"] < 0.5
    assert log[-1]["episodes"] > 0
    shutil.copytree(whole, killed)
    shutil.rmtree(killed / "checkpoint" / "00000024")
    assert call(navigate.main, *line, "--out", str(killed), "--resume") == 0
    assert log_without_timing(killed) == log
    assert checkpoint.load_checkpoint(killed).facts["digest"] == checkpoint.load_checkpoint(whole).facts["digest"]
    assert json.loads((whole / "config.json").read_text())["config"]["teacher"] == "oracle"
    capsys.readouterr()
    alone = tuple(word for word in line if word not in ("--teacher", "oracle", "--handover=1"))
    assert call(navigate.main, *alone, "--epochs=1", "--curriculum=0", "--out", str(killed), "--resume") == 2
    assert "this run has no" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_student_learns_to_stop_within_a_quarter_of_a_metre(tmp_path):
    line = ("--task", TASK, "--memory", "gru", "--teacher", "oracle", "--preset", "cpu")
    assert call(navigate.main, *line, "--out", str(tmp_path / "run"), "--evaluation-episodes=500") == 0
    found = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    assert found["success"] >= 0.98  # dead reckoning: 0.28
