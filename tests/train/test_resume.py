"""A run that was killed goes on with `--resume`, whenever the kill came, and ends as if nothing had happened."""

import dataclasses
import json
import os
import random
import shutil
import subprocess
import sys
import time
import types

import jax
import numpy as np
import pytest

from subterra_jax.policies import load
from tests.recorded import check
from tests.train.conftest import SMALL, TASK, log_without_timing
from train import checkpoint, folder, session
from train.config import TrainConfig
from train.ppo import train
from train.setup import make_learner
from train.world import open_world

pytestmark = pytest.mark.door

FEW = ("--steps=12288", "--stop-coverage=2", "--checkpoint-every=2", "--evaluation-episodes", "5")  # three iterations


@pytest.fixture(scope="module")
def whole(train_small):
    """A run that nobody killed."""
    status, out = train_small(*FEW)
    assert status == 0
    check(__file__, "whole", {"log": log_without_timing(out)[:2]}, 1e-3)
    return out


def digest(run):
    return checkpoint.load_checkpoint(run).facts["digest"]


def cut(whole, out, *kept):
    """Leave what a kill before the first checkpoint does: some files, the logs longer than any checkpoint knows."""
    out.mkdir()
    for name in kept:
        shutil.copy(whole / name, out / name)
    return out


@pytest.mark.parametrize(
    "kept",
    [
        pytest.param(None, marks=pytest.mark.slow),
        pytest.param((), marks=pytest.mark.slow),
        pytest.param(("config.json",), marks=pytest.mark.slow),
        ("config.json", "log.jsonl", "log.csv", "episodes.csv"),
    ],
    ids=["no-folder", "empty", "settings", "logs"],
)
def test_before_the_first_checkpoint_a_run_begins_again(whole, train_small, tmp_path, kept, capsys):
    out = tmp_path / "run" if kept is None else cut(whole, tmp_path / "run", *kept)
    if kept:
        (out / "checkpoint" / ".00000002.partial").mkdir(parents=True)
    status, _ = train_small(*FEW, "--resume", out=out)
    assert status == 0
    assert "no checkpoint yet; begins at the beginning" in capsys.readouterr().err
    assert log_without_timing(out) == log_without_timing(whole)
    assert (out / "episodes.csv").read_bytes() == (whole / "episodes.csv").read_bytes()
    assert digest(out) == digest(whole)
    assert sorted(path.name for path in (out / "checkpoint").iterdir()) == ["00000002", "00000003"]


OWN = {
    "none": {},
    "stack": {"frames": 2},
    "gru": {"cell": 8, "auxiliary": True},
    "along": {"auxiliary": True, "drives": 2, "drive_steps": 140},
    "map": {"map_cell": 0.5},
}


@pytest.mark.parametrize(
    "memory", ["gru", *(pytest.param(name, marks=pytest.mark.slow) for name in ("none", "stack", "along", "map"))]
)
def test_with_every_memory_a_run_goes_on_from_a_checkpoint_to_the_same_weights_to_the_bit(memory, tmp_path):
    config = TrainConfig(memory=memory, n_envs=4, unroll=8, minibatches=2, epochs=1, hidden=(8,), **OWN[memory])
    config = dataclasses.replace(config, steps=3 * config.steps_per_iteration)
    world = open_world("StopAtShort-v1", "open:straight:train:2")
    learner = make_learner(world, config)
    run = folder.RunFolder(tmp_path / "run", world, learner)
    run.start()
    whole = train(learner, world.params, watch=lambda now: run.save(now) if now.iteration == 2 else None)
    snapshot = run.resume()
    assert snapshot.iteration == 2
    again = train(learner, world.params, snapshot=snapshot)
    jax.tree.map(np.testing.assert_array_equal, again.state, whole.state)
    assert {**again.record, "timing": None} == {**whole.record, "timing": None}
    check(__file__, f"learns {memory}", {"line": {**whole.record, "timing": None, "policy_loss": None}}, 1e-3)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--hidden", "16"), "was trained with hidden = [32, 32], not [16]"),
        (("--reward.jerk", "0.5"), "was trained with reward = None, not {'jerk': 0.5}"),
        (("--lining", "smooth"), "was trained with lining = pockets, not smooth"),
        (("--memory", "gru"), "was trained with"),
    ],
)
def test_another_run_that_was_killed_before_its_first_checkpoint_is_not_gone_on_with(
    whole, train_small, tmp_path, words, message, capsys
):
    out = cut(whole, tmp_path / "run", "config.json")
    assert train_small(*FEW, *words, "--resume", out=out)[0] == 2
    assert message in capsys.readouterr().err
    (out / "config.json").write_text("{")
    assert train_small(*FEW, "--resume", out=out)[0] == 2
    assert "config.json: cannot be read; --overwrite begins anew" in capsys.readouterr().err


@pytest.mark.parametrize("lost", [(), ("00000003",)], ids=["the last", "the one before"])
def test_a_run_that_was_killed_after_a_checkpoint_goes_on_bit_for_bit_and_is_scored(whole, train_small, tmp_path, lost):
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    (out / "evaluation.json").unlink()
    for name in lost:  # as if killed after logging an iteration that no checkpoint knows, and half of the next
        shutil.rmtree(out / "checkpoint" / name)
        with (out / "log.jsonl").open("a") as log:
            log.write('{"iteration": 4, "half a li')
    assert train_small(*FEW, "--resume", out=out)[0] == 0
    assert log_without_timing(out) == log_without_timing(whole)
    for name in ("episodes.csv", "curve.csv", "evaluation.json"):
        assert (out / name).read_bytes() == (whole / name).read_bytes(), name
    assert digest(out) == digest(whole)


def test_a_checkpoint_stays_whole_while_it_is_written_again(whole, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    newest = checkpoint.load_checkpoint(run)

    def look(place):
        assert place.name != newest.path.name
        assert digest(run) == newest.facts["digest"]

    trees = {"policy": {"w": np.zeros(3, np.float32)}}
    checkpoint.save_checkpoint(run, newest.facts["iteration"], trees, {"task": "t"}, look)
    assert digest(run) != newest.facts["digest"]


@pytest.mark.parametrize(
    ("kept", "done", "at"),
    [
        ([[2, 3], [2]], [], [2, 2]),
        ([[2], []], [], [None, None]),
        ([[2, 3], [3, 4]], [], [3, 3]),
        ([[3], []], [0], [3, None]),
    ],
)
def test_seeds_go_on_from_the_newest_checkpoint_that_all_have(monkeypatch, kept, done, at):
    def seed(k):
        folder = types.SimpleNamespace(path=k, start=lambda: kept[k].clear())
        folder.begin = lambda **_: types.SimpleNamespace(iteration=kept[k][-1], k=k) if kept[k] else None
        folder.resume = lambda iteration: types.SimpleNamespace(iteration=iteration)
        return types.SimpleNamespace(folder=folder, learner=types.SimpleNamespace(config=None))

    monkeypatch.setattr(session, "iterations", lambda k: kept[k])
    monkeypatch.setattr(session, "finished", lambda snapshot, config: snapshot.k in done)
    found = session.resume_seeds([seed(0), seed(1)])
    assert [None if one is None else one.iteration for one in found] == at
    assert all(kept[k] == [] for k in (0, 1) if at[k] is None)


def test_an_overwritten_run_loses_its_checkpoints_before_anything_else(whole, tmp_path, monkeypatch):
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    half = folder.RunFolder(run, None, None)  # type: ignore[arg-type]
    monkeypatch.setattr(half, "_write_config", lambda: None)
    monkeypatch.setattr(folder.shutil, "rmtree", lambda *a, **k: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        half.start()
    assert not checkpoint.has_checkpoint(run)


def test_every_checkpoint_holds_its_policy_as_the_package_loads_it(whole):
    agent, facts = load(whole)
    assert (agent.name, facts["task"], facts["iteration"]) == ("ppo", TASK, 3)
    older, _ = load(whole / "checkpoint" / "00000002")
    assert older.layout == agent.layout


def lines_of(run):
    """Lines that the log of a run has; -1 where there is none yet."""
    log = run / "log.jsonl"
    return log.read_bytes().count(b"\n") if log.exists() else -1


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_run_survives_sigkill_at_random_moments(tunnel, tmp_path):
    """Kills the process a dozen times: before it has begun, while it compiles, and in and between checkpoints."""
    line = [sys.executable, "-m", "train", "--task", TASK, "--tunnel", str(tunnel), "--preset", "cpu", *SMALL]
    line += ["--steps=204800", "--stop-coverage=2", "--checkpoint-every=1", "--evaluation-episodes", "5"]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    subprocess.run([*line, "--out", str(tmp_path / "whole")], env=environment, check=True, capture_output=True)
    draw, out, reached = random.Random(16), tmp_path / "run", []
    for kill in range(12):
        process = subprocess.Popen([*line, "--out", str(out), "--resume"], env=environment, stderr=subprocess.DEVNULL)
        before, more = lines_of(out), draw.randrange(4)
        early = time.monotonic() + draw.uniform(0.0, 4.0)
        while process.poll() is None:
            if kill < 3 and time.monotonic() > early:
                break
            if kill >= 3 and lines_of(out) > before + more:
                time.sleep(draw.uniform(0.0, 0.2))
                break
            time.sleep(0.002)
        process.kill()
        assert process.wait() == -9
        reached.append(checkpoint.iterations(out)[-1:])
    done = subprocess.run([*line, "--out", str(out), "--resume"], env=environment, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    print(reached)
    assert [] in reached, "no kill came before the first checkpoint"
    assert len({tuple(one) for one in reached}) > 4, "the kills came at few moments"
    assert log_without_timing(out) == log_without_timing(tmp_path / "whole")
    assert (out / "episodes.csv").read_bytes() == (tmp_path / "whole" / "episodes.csv").read_bytes()
    assert digest(out) == digest(tmp_path / "whole")
    scores = [json.loads((run / "evaluation.json").read_text()) for run in (out, tmp_path / "whole")]
    assert scores[0] == scores[1]
