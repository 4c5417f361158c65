"""Settings of the trainer: refusals, presets, steps and the order of sums on a GPU."""

import dataclasses

import jax
import pytest

import subterra_jax as st
from train.config import ConfigError, TrainConfig, check, make_config
from train.devices import compiler_options

WRONG = {
    "steps": 0,
    "n_envs": 0,
    "unroll": -1,
    "minibatches": 7,
    "hidden": (),
    "frames": 0,
    "seed": -1,
    "learning_rate": 0.0,
    "init_std": 0.0,
    "discount": 1.5,
    "gae_lambda": -0.1,
    "last_std": 0.0,
    "clip": float("nan"),
    "entropy_weight": -1.0,
}


@pytest.mark.parametrize("name", WRONG)
def test_a_setting_that_makes_no_sense_is_refused_by_name(name):
    with pytest.raises(ConfigError, match=name):
        check(dataclasses.replace(TrainConfig(), **{name: WRONG[name]}))


@pytest.mark.parametrize("preset", ["cpu", "gpu"])
@pytest.mark.parametrize("task", [id for id in st.TASKS])
def test_every_task_has_presets_that_make_sense(task, preset):
    config = check(make_config(task, preset))
    assert preset == "cpu" or config.steps_per_iteration >= 50_000


def test_steps_are_rounded_up_to_whole_iterations():
    config = dataclasses.replace(TrainConfig(), steps=1001, n_envs=10, unroll=10, minibatches=5)
    assert (config.steps_per_iteration, config.iterations, config.minibatch_envs) == (100, 11, 2)


def test_a_gpu_adds_up_in_a_fixed_order_unless_the_settings_say_otherwise(monkeypatch):
    assert compiler_options(TrainConfig()) is None  # a CPU always does
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert compiler_options(TrainConfig()) == {"xla_gpu_deterministic_ops": True}
    assert compiler_options(TrainConfig(sums="any")) is None
