"""Settings of the trainer: from a file, refusals, presets, weights of the reward, logs of one's own."""

import dataclasses
import hashlib
import json
import sys
import types

import jax
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.host.versions import VERSION
from subterra_jax.policies import load_policy
from tests import recorded
from tests.train.conftest import TASK, call, log_without_timing
from train import __main__ as navigate
from train import evaluate, release, sinks, tunnels, walk
from train.__main__ import read_command
from train.b2.walking import make_walk_config
from train.config import ConfigError, TrainConfig, check, make_config
from train.devices import compiler_options
from train.options import read_settings, reward_of, settings_of
from train.sinks import Logs
from train.world import open_world, with_reward

pytestmark = pytest.mark.door
COMMANDS = (navigate.Command, evaluate.Command, release.Command, walk.Command)

YAML = """
task: Subterra/StopAtShort-v1
memory: gru
auxiliary: true
cell: 48
discount: 0.9
reward: {jerk: 0.5}
"""
TOML = "task = 'Subterra/TraverseShort-v1'\nhidden = [24, 12]\nframes = 2\n[reward]\nlateral = 0.7\n"


def test_a_file_sets_what_the_command_line_sets_and_the_command_line_has_the_last_word(tmp_path):
    (tmp_path / "mine.yaml").write_text(YAML)
    command = read_command(["--config", str(tmp_path / "mine.yaml"), "--out", "o", "--cell", "32"])
    assert (command.config.memory, command.task) == ("gru", "Subterra/StopAtShort-v1")
    assert (command.config.cell, command.config.discount, command.config.auxiliary) == (32, 0.9, True)
    assert reward_of(command)["jerk"] == 0.5
    (tmp_path / "mine.toml").write_text(TOML)
    command = read_command([f"--config={tmp_path / 'mine.toml'}", "--out", "o", "--reward.jerk", "0"])
    assert (command.config.hidden, command.config.frames) == ((24, 12), 2)
    assert reward_of(command) == {"terminal": 1.0, "coverage": 100.0, "lateral": 0.7, "jerk": 0.0}


@pytest.mark.parametrize("words", [(), ("--memory", "gru"), ("--memory", "along", "--auxiliary", "--map")])
def test_the_settings_of_a_run_are_read_back_as_they_were(tmp_path, words):
    given = "--task Subterra/StopAtShort-v1 --n-envs=96 --reward.miss 3.5 --out o --log json:dumps"
    command = read_command([*given.split(), *words])
    (tmp_path / "config.json").write_text(json.dumps({"schema": "subterra.run/1", "command": settings_of(command)}))
    again = read_command(["--config", str(tmp_path / "config.json"), "--out", "o"])
    assert settings_of(again) == settings_of(command)
    assert (again.config, type(again).__name__) == (command.config, type(command).__name__)
    assert reward_of(again)["miss"] == 3.5


@pytest.mark.slow
def test_a_run_is_done_again_from_its_own_config(train_small, tmp_path):
    (tmp_path / "outcome.py").write_text("lines = []\ndef keep(line):\n    lines.append(line)\n")
    few = "--steps=8192 --stop-coverage=2 --memory=stack --frames 2 --reward.coverage 7 --evaluation-episodes 5"
    status, first = train_small(*few.split(), "--log", f"{tmp_path / 'outcome.py'}:keep")
    assert status == 0
    assert call(navigate.main, "--config", str(first / "config.json"), "--out", str(tmp_path / "again")) == 0
    assert log_without_timing(tmp_path / "again") == log_without_timing(first)
    (module,) = [module for name, module in sys.modules.items() if name.startswith("outcome_")]
    assert [line["iteration"] for line in module.lines] == [1, 2, 1, 2]
    outcome = json.loads((first / "config.json").read_text())
    assert outcome["reward"] == {"coverage": 7.0}
    # The reward is how it was taught, and no condition under which it drives.
    env, params = st.make(TASK)
    assert load_policy(first, env, params).agent.layout.memory.frames == 2
    assert load_policy(first, env, params).agent.conditions.constants == st.constants_digest(env, params)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("mine.ini", "", "mine.ini: must end in .yaml, .yml, .toml, .json"),
        ("mine.json", None, "mine.json: cannot be read (No such file or directory)"),
        ("mine.json", "{", "mine.json: cannot be read (Expecting property name"),
        ("mine.yaml", "a: [", "mine.yaml: cannot be read (while parsing"),
        ("mine.toml", "a = ", "mine.toml: cannot be read (Invalid value"),
        ("mine.yaml", "- 1", "mine.yaml: must hold settings by name"),
        ("mine.yaml", "step_size: 3", "mine.yaml: Unrecognized options: --step-size, 3"),
        ("mine.yaml", "steps: many", "mine.yaml: Error parsing --steps: invalid literal for int()"),
        ("mine.yaml", "task: Fly-v0", "mine.yaml: no task 'Fly-v0'"),
        ("mine.yaml", "reward: {speed: 2}", "mine.yaml: Unrecognized options: --reward.speed, 2"),
        ("config.json", '{"schema": "subterra.run/1"}', "config.json: has no field 'command'"),
    ],
)
def test_a_file_that_is_wrong_is_one_sentence_that_names_it(tmp_path, monkeypatch, capsys, name, text, message):
    monkeypatch.chdir(tmp_path)
    if text is not None:
        (tmp_path / name).write_text(text)
    assert call(navigate.main, "--config", name, "--out", "run") == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {message}")
    assert error.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_yaml_without_its_library_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "yaml", None)
    (tmp_path / "mine.yaml").write_text(YAML)
    with pytest.raises(ConfigError, match="need pyyaml, which is not installed: pip install pyyaml"):
        read_settings(tmp_path / "mine.yaml")


def test_a_reward_of_other_weights_is_the_reward_that_is_trained_on(tunnel):
    usual = open_world(TASK, tunnel)
    world = with_reward(usual, {"coverage": 3.0, "jerk": float(usual.params.reward.jerk)})
    assert world.facts["reward"] == {"coverage": 3.0}
    assert world.task_params is usual.params
    _, state = usual.env.reset(jax.random.key(0), usual.params)
    earned = [
        float(w.env.step(jax.random.key(1), state, np.array([2.0, 0.0]), w.params)[5]["reward_coverage"])
        for w in (usual, world)
    ]
    assert earned[0] > 0.0
    assert earned[1] == pytest.approx(earned[0] * 3.0 / float(usual.params.reward.coverage), rel=1e-5)
    with pytest.raises(ConfigError, match=r"has no weight reward\.speed; there are terminal, coverage, lateral, jerk"):
        with_reward(usual, {"speed": 1.0})
    with pytest.raises(ConfigError, match=r"reward\.jerk must be finite, got nan"):
        with_reward(usual, {"jerk": float("nan")})


def test_a_function_of_ones_own_gets_every_line_of_the_log(tmp_path, monkeypatch):
    (tmp_path / "keeper.py").write_text(
        "lines = []\ndef keep(line):\n    lines.append(line)\ndef fail(line):\n    1 / 0\n"
    )
    monkeypatch.chdir(tmp_path)
    (sink,) = Logs(log="keeper.py:keep").checked().open(tmp_path / "run", 0, {})
    sink.write({"iteration": 3, "timing": {}})
    (module,) = [
        m for name, m in sys.modules.items() if name.startswith("keeper_") and str(tmp_path) in str(m.__file__)
    ]
    assert module.lines == [{"run": str(tmp_path / "run"), "iteration": 3, "timing": {}}]
    (sink,) = Logs(log="keeper.py:fail").checked().open(tmp_path / "run", 0, {})
    with pytest.raises(ConfigError, match=r"^log = keeper.py:fail: ZeroDivisionError: division by zero$"):
        sink.write({})


@pytest.mark.parametrize(
    ("logs", "message"),
    [
        (Logs(log="nothing"), "log must be module:function or FILE.py:function, got 'nothing'"),
        (Logs(log="math:pi"), "log = math:pi is no function, but float"),
        (Logs(wandb="tunnels"), "wandb = PROJECT needs wandb, which is not installed: pip install wandb"),
    ],
)
def test_a_log_that_cannot_be_written_is_refused_in_one_sentence(logs, message, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ConfigError) as refused:
        logs.checked()
    assert str(refused.value) == message


def test_weights_and_biases_gets_every_number_at_its_step(tmp_path, monkeypatch):
    calls = []
    run = types.SimpleNamespace(
        log=lambda values, step: calls.append((step, values)), finish=lambda: calls.append("end")
    )
    wandb = types.ModuleType("wandb")
    wandb.init = lambda **options: calls.append(options) or run  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    (sink,) = Logs(wandb="tunnels").open(tmp_path / "run-3", 0, {"seed": 3})
    timing = {"steps_per_second": 7}
    sink.write({"iteration": 1, "step": 100, "success_mean_100": None, "policy_loss": 0.5, "timing": timing})
    sink.close()
    options, (step, values), end = calls
    assert (options["project"], options["name"], options["config"]) == ("tunnels", "run-3", {"seed": 3})
    assert step == 100
    assert values == {"learning/iteration": 1, "loss/policy_loss": 0.5, "learning/steps_per_second": 7}
    assert end == "end"
    assert sinks.NO_LOGS.open(tmp_path, 0, {}) == []


NOTHING = dict.fromkeys(("steps", "n_envs", "frames", "learning_rate", "init_std", "last_std"), 0)
BEYOND = {"unroll": -1, "minibatches": 7, "seed": -1, "discount": 1.5, "gae_lambda": -0.1, "entropy_weight": -1.0}
WRONG = {**NOTHING, **BEYOND, "hidden": (), "clip": float("nan")}


@pytest.mark.parametrize("name", WRONG)
def test_a_setting_that_makes_no_sense_is_refused_by_name(name):
    with pytest.raises(ConfigError, match=name):
        check(dataclasses.replace(TrainConfig(), **{name: WRONG[name]}))


def test_every_task_has_presets_that_make_sense_and_are_what_they_were():
    made = [check(make_config(task, preset)) for task in st.TASKS for preset in ("cpu", "gpu")]
    assert min(one.steps_per_iteration for one in made[1::2]) >= 50_000
    every = (
        [*map(dataclasses.asdict, made)],
        [dataclasses.asdict(make_walk_config(preset)) for preset in ("cpu", "gpu")],
    )
    recorded.check(__file__, "presets", dict(zip(("tasks", "walk"), every, strict=True)))
    fields = {f"{one.__module__} {f.name}": f for one in COMMANDS for f in dataclasses.fields(one)}
    usual = {name: str(f.default) for name, f in fields.items() if f.default is not dataclasses.MISSING}
    recorded.check(__file__, "commands", {"usual": usual})


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
