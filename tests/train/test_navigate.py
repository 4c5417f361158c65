import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from tests.train.conftest import SMALL, TASK, call
from train import __main__ as navigate
from train import checkpoint, curve, evaluate


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


NOT_A_NUMBER = """
import dataclasses
import jax.numpy as jnp
import subterra_jax as st
from subterra_jax.rules import Traverse

@dataclasses.dataclass(frozen=True)
class Hasty(Traverse):
    key = "hasty"

    def judge(self, step, params):
        verdict = super().judge(step, params)
        time = jnp.log(step.place.station - 3.0)
        return dataclasses.replace(verdict, terms={**verdict.terms, "reward_time": time})

st.register("Mine/Hasty-v1", Hasty(), horizon=100)
"""


def test_a_reward_of_a_users_own_that_is_no_number_ends_the_training_in_one_sentence(tmp_path, tunnel, capsys):
    (tmp_path / "hasty.py").write_text(NOT_A_NUMBER)
    words = ("--task", f"{tmp_path / 'hasty.py'}:Mine/Hasty-v1", "--tunnel", str(tunnel), *SMALL)
    assert call(navigate.main, *words, "--out", str(tmp_path / "run")) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert line == (
        "error: iteration 1: the task's reward is not finite (reward_time); a policy learns from finite rewards alone"
    )


def test_a_folder_that_holds_a_run_is_not_overwritten_unasked(trained, capsys):
    before = (trained / "log.jsonl").read_bytes()
    assert call(navigate.main, "--out", str(trained)) == 2
    assert "holds a run already" in capsys.readouterr().err
    assert (trained / "log.jsonl").read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--hidden", "32", "16"), "was trained with hidden = [32, 32], not [32, 16]"),
        (("--seed", "5"), "was trained with seed = 0, not 5"),
        (("--lining", "smooth"), "was trained with lining = pockets, not smooth"),
    ],
)
def test_a_run_resumes_only_as_what_it_was(trained, train_small, capsys, arguments, message):
    status, _ = train_small("--resume", *arguments, out=trained)
    assert status == 2
    assert message in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # a thread of the storage library's
@pytest.mark.parametrize("victim", ["facts", "arrays", "policy"])
def test_a_truncated_checkpoint_is_one_sentence_when_resumed_or_scored(trained, train_small, tmp_path, capsys, victim):
    shutil.copytree(trained, tmp_path / "run")
    place = checkpoint.load_checkpoint(tmp_path / "run").path
    arrays = (path for path in (place / checkpoint.ARRAYS).rglob("*") if path.is_file())
    files = {"facts": place / checkpoint.FACTS, "policy": place / "policy.safetensors"}
    path = files[victim] if victim in files else max(arrays, key=lambda path: path.stat().st_size)
    path.write_bytes(path.read_bytes()[:100])
    if victim == "policy":  # which scoring reads, and nothing else
        assert call(evaluate.main, "--policy", str(tmp_path / "run")) == 2
        assert "damaged policy" in capsys.readouterr().err
        return
    status, _ = train_small("--resume", out=tmp_path / "run")
    assert status == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert str(place) in error
    assert "damaged checkpoint" in error


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
