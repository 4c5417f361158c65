"""The trainer's command, and training of the walking robot: settings, networks, scores and release."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from benchmarks import b2_traverse
from benchmarks.records import read_records
from subterra_jax.b2 import gait as gaits
from subterra_jax.b2.transfer import LaggedWheels
from subterra_jax.host.errors import OutputError
from subterra_jax.policies import PolicyError, load
from subterra_jax.policies.files import read
from tests.recorded import check
from tests.train.conftest import SMALL, TASK, call
from train import __main__ as navigate
from train import checkpoint, curve, walk
from train.__main__ import read_command
from train.b2 import embodied
from train.b2.walking import WalkConfig, WalkDriver, make_walk_config, score, walker
from train.config import ConfigError
from train.driver import Policy
from train.policies import write_tensors


def test_a_run_folder_holds_everything(trained):
    names = "checkpoint config.json curve.csv curve.png episodes.csv evaluation.json log.csv log.jsonl"
    assert sorted(path.name for path in trained.iterdir()) == names.split()
    config = json.loads((trained / "config.json").read_text())
    assert len(config["tunnel_sha256"]) == 64
    assert config["tunnel_provenance"] == "simulated"
    assert config["config"]["n_envs"] == 64
    assert "jax" in config["versions"]
    assert (trained / "curve.png").read_bytes().startswith(b"\x89PNG")
    for path in trained.rglob("*.json*"):
        assert str(trained.parent) not in path.read_text(), f"{path.name} names a path of this machine"


def test_a_folder_that_holds_a_run_is_not_overwritten_unasked(trained, capsys):
    before = (trained / "log.jsonl").read_bytes()
    assert call(navigate.main, "--out", str(trained)) == 2
    assert "holds a run already" in capsys.readouterr().err
    assert (trained / "log.jsonl").read_bytes() == before


def test_ctrl_c_saves_the_checkpoint_and_exits_with_130(tunnel, tmp_path):
    out = tmp_path / "run"
    line = [sys.executable, "-m", "train", "--task", TASK, "--tunnel", str(tunnel), "--out", str(out), *SMALL]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    process = subprocess.Popen([*line, "--stop-coverage=2"], stderr=subprocess.PIPE, text=True, env=environment)
    log = out / "log.jsonl"
    while process.poll() is None and not (log.exists() and log.read_text().count("\n") >= 2):
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "--resume" in error
    facts = checkpoint.load_checkpoint(out).facts
    assert facts["iteration"] == log.read_text().count("\n")
    assert (out / "curve.png").exists()
    assert not (out / "evaluation.json").exists()


def test_curves_of_several_runs_are_drawn_into_one_figure(trained, tmp_path, capsys):
    assert call(curve.main, str(trained), str(trained), "--out", str(tmp_path / "both.png")) == 0
    assert (tmp_path / "both.png").stat().st_size > 10_000
    assert call(curve.main, str(tmp_path), "--out", str(tmp_path / "none.png")) == 2
    assert "no readable episodes.csv" in capsys.readouterr().err


SHORT = "Subterra/TraverseShort-v1"


@pytest.fixture(scope="module")
def world():
    return embodied.open_world(SHORT, None, None)


def test_the_stand_in_is_told_what_the_legs_are_told_and_obeys_as_late(world):
    mission, params = st.make("Subterra/B2Traverse-v1", policy="trot")
    assert world.env.motion == LaggedWheels()
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
    outcome = {record.id.rpartition("/")[2]: record.value for record in read_records(asked.out)}
    assert (outcome["success"], outcome["fall"], outcome["robots"]) == (100.0, 0.0, 4.0)


N_SEEN, N_TRUTH = 56, 12


@pytest.fixture(scope="module")
def driver():
    space = lambda n: types.SimpleNamespace(low=-np.ones(n, np.float32), high=np.ones(n, np.float32))  # noqa: E731
    env = types.SimpleNamespace(action_space=lambda _: space(12), observation_size=lambda _: N_SEEN + N_TRUTH)
    return WalkDriver(env, None, WalkConfig(hidden=(32, 16)), N_SEEN)


@pytest.fixture(scope="module")
def policy(driver):
    shapes = jax.eval_shape(driver.init, jax.random.key(0))
    keys = iter(jax.random.split(jax.random.key(0), 100))
    random = jax.tree.map(lambda leaf: 0.3 * jax.random.normal(next(keys), leaf.shape), shapes)
    mean = jnp.linspace(-1.0, 1.0, N_SEEN + N_TRUTH)
    return Policy(random, statistics={"mean": mean, "std": jnp.full(N_SEEN + N_TRUTH, 2.0)})


def answer(driver, policy, seen):
    return driver.answer(policy, driver.inputs(policy, seen), driver.start_memory(seen.shape[:1]))[0]


def records(n_steps=200, n_robots=4, speed=0.5, asked=0.6):
    velocity, expected = np.zeros((n_steps, n_robots, 3)), np.zeros((n_steps, n_robots, 3))
    velocity[..., 0], expected[..., 0] = speed, asked
    flags = {name: np.zeros((n_steps, n_robots), bool) for name in ("fall", "over", "contact")}
    return {"velocity": velocity, "asked": expected, "effort": np.full((n_steps, n_robots), 300.0), **flags}


def test_the_policy_does_not_see_the_truth_and_the_critic_does(driver, policy):
    seen = jax.random.normal(jax.random.key(2), (3, N_SEEN + N_TRUTH))
    one, other = answer(driver, policy, seen), answer(driver, policy, seen.at[:, N_SEEN:].add(1.0))
    np.testing.assert_array_equal(one.mean, other.mean)
    assert not np.allclose(one.value, other.value)


def test_a_released_gait_acts_as_the_one_that_was_trained(driver, policy, tmp_path):
    out = tmp_path / "gait.safetensors"
    write_tensors(out, driver.kind, driver.layout, driver.tensors(policy), {"task": "Subterra/B2Walk-v1", "world": {}})
    loaded, facts = load(out)
    seen = jax.random.normal(jax.random.key(3), (5, N_SEEN + N_TRUTH))
    expected = driver.action(answer(driver, policy, seen).mean)
    np.testing.assert_allclose(loaded.act(seen[:, :N_SEEN]), expected, atol=1e-6)
    assert facts["kind"] == "walk"
    assert loaded.n_observation == N_SEEN
    gaits.check_fits(loaded, N_SEEN, out)
    with pytest.raises(PolicyError, match="made for observations of 56 numbers, the B2 gives 60"):
        gaits.check_fits(loaded, 60, out)


def test_statistics_of_the_observation_are_those_of_what_was_seen(driver, policy):
    seen = jax.random.normal(jax.random.key(4), (5, N_SEEN + N_TRUTH))
    np.testing.assert_allclose(driver.raw(driver.inputs(policy, seen), policy), seen, atol=1e-5)


def test_a_policy_that_is_no_gait_is_refused():
    with pytest.raises(PolicyError, match="a policy of kind 'ppo', which is no gait"):
        gaits.make_policy(read("Traverse-v1"))


def test_a_constant_lag_is_scored_as_what_it_is():
    found = score(records(), 0.02)
    assert found["velocity_error"] == pytest.approx(0.1)
    assert found["yaw_rate_error"] == 0.0
    assert found["falls"] == 0.0
    assert found["power"] == pytest.approx(300.0)


def test_swaying_within_a_stride_is_no_tracking_error():
    swaying = records(speed=0.6)
    swaying["velocity"][..., 1] = 0.3 * np.sin(2.0 * np.pi * np.arange(200) / 20.0)[:, None]
    assert score(swaying, 0.02)["velocity_error"] == pytest.approx(0.0, abs=1e-6)


def test_one_fall_of_four_is_a_quarter_and_what_comes_after_it_does_not_count():
    fallen = records()
    fallen["fall"][100, 2] = True
    fallen["over"][101:, 2] = True
    fallen["velocity"][101:, 2] = 50.0
    fallen["effort"][101:, 2] = 1e9
    found = score(fallen, 0.02)
    assert found["falls"] == 0.25
    assert found["velocity_error"] == pytest.approx(0.1)
    assert found["power"] == pytest.approx(300.0)


def test_robots_walk_for_their_score_as_they_walked():
    env, params = st.make("Subterra/B2Walk-v1", engine="mujoco")
    found = walker(env, lambda obs: jnp.zeros((len(obs), 12)), 2, 6)(params)
    check(__file__, "walker", found, 5e-3)


def test_settings_that_make_no_sense_are_refused_before_anything_is_compiled(tmp_path):
    with pytest.raises(ConfigError, match="robots must be at least 1, got 0"):
        walk.command(walk.Command(out=tmp_path / "run", robots=0))
    with pytest.raises(ConfigError, match="n_envs = 100 cannot be divided into minibatches = 32"):
        walk.command(walk.Command(out=tmp_path / "run", config=WalkConfig(n_envs=100)))
    with pytest.raises(OutputError, match=r"must end in \.safetensors"):
        walk.command(walk.Command(out=tmp_path / "run", release=tmp_path / "gait.bin"))
    with pytest.raises(ConfigError, match="either a tunnel or a scene"):
        walk.command(walk.Command(out=tmp_path / "run", tunnel=tmp_path / "t.npz", scene=tmp_path))
    with pytest.raises(ConfigError, match="unknown preset 'tpu'"):
        walk.read_command(["--out", str(tmp_path / "run"), "--preset", "tpu"])
    assert not (tmp_path / "run").exists()


def test_the_critic_s_observation_is_the_policy_s_and_more():
    env, params = st.make("Subterra/B2Walk-v1", privileged=True)
    plain = dataclasses.replace(env, privileged=False)
    assert plain.observation_size(params) == N_SEEN
    assert env.observation_size(params) == N_SEEN + N_TRUTH
    check(__file__, "critic", {"seen": jax.jit(env.reset)(jax.random.key(0), params)[0]})


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_it_learns_on_a_cpu(tmp_path):
    config = dataclasses.replace(make_walk_config("cpu"), steps=600_000)
    assert walk.command(walk.Command(out=tmp_path / "run", robots=32, config=config)) == 0
    lines = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    paid = np.array([line["reward_velocity"] + line["reward_yaw_rate"] for line in lines])
    assert paid[-10:].mean() > paid[10:20].mean() * 1.02
    assert (tmp_path / "run" / "evaluation.json").exists()
