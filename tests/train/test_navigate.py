"""The command `python -m train`: its run folder, refusals to overwrite, Ctrl-C, curves."""

import json
import os
import signal
import subprocess
import sys
import time

from tests.train.conftest import SMALL, TASK, call
from train import __main__ as navigate
from train import checkpoint, curve


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
