"""Settings of the trainer: refusals, presets, steps and the order of sums on a GPU."""

import dataclasses
import hashlib

import jax
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.host.versions import VERSION
from train import tunnels
from train.config import ConfigError, TrainConfig, check, make_config
from train.devices import compiler_options
from train.world import open_world

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


def test_no_tunnel_and_one_tunnel_need_no_other_process():
    assert tunnels.load([]) == []
    (one,) = tunnels.load(["control"], "smooth")
    assert one.count == 1


@pytest.mark.parametrize(
    ("task", "sensor"),
    [
        ("StopAtShort-v1", "planar16"),  # a piece is cut out of each
        pytest.param("StopAt-v1", "spin16x64", marks=pytest.mark.slow),  # two processes
    ],
)
def test_a_world_of_several_tunnels_is_that_of_their_plans(task, sensor):
    names = ["open:straight:train:2", "open:straight:train:3"]
    world = open_world(f"Subterra/{task}", "open:straight:train:2-3", sensor=sensor)
    plans = [st.load_tunnel(name, solid=sensor != "planar16") for name in names]
    _, params = st.make(f"Subterra/{task}", tunnel=plans, lining=plans[0].default_lining, sensor=sensor)
    assert jax.tree.structure(world.params) == jax.tree.structure(params)
    for one, other in zip(jax.tree.leaves(world.params), jax.tree.leaves(params), strict=True):
        np.testing.assert_array_equal(one, other)
    digest = hashlib.sha256("\n".join(f"{name} {VERSION}" for name in names).encode()).hexdigest()
    assert world.facts["tunnel_sha256"] == digest
    assert world.facts["tunnel"] == "open:straight:train:2-3"
