"""The command `python -m train`: its run folder, refusals to overwrite, Ctrl-C, curves."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from benchmarks import b2_traverse
from benchmarks.records import read_records
from subterra_jax.b2 import tasks
from subterra_jax.b2.transfer import LaggedWheels
from tests.train.conftest import SMALL, TASK, call
from train import __main__ as navigate
from train import checkpoint, curve
from train.__main__ import read_command
from train.b2 import embodied
from train.config import ConfigError


def test_a_run_folder_holds_everything(trained):
    names = {path.name for path in trained.iterdir()}
    assert names == {
        "checkpoint",
        "config.json",
        "curve.csv",
        "curve.png",
        "episodes.csv",
        "evaluation.json",
        "log.csv",
        "log.jsonl",
    }
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
    mission, params = tasks.make_mission(policy="trot")
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
    told = {record.id.rpartition("/")[2]: record.value for record in read_records(asked.out)}
    assert (told["success"], told["fall"], told["robots"]) == (100.0, 0.0, 4.0)
