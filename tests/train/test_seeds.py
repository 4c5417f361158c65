"""Several seeds trained at once: each as it is alone, resumed together, summed up."""

import dataclasses
import json

import jax
import numpy as np
import pytest

import subterra_jax as st
from tests.train.conftest import SMALL, TASK, call, log_without_timing
from train import __main__ as navigate
from train import ppo, session
from train.config import ConfigError, TrainConfig
from train.driver import Driver
from train.learner import Learner
from train.setup import make_layout

CONFIG = TrainConfig(steps=3 * 256, n_envs=16, unroll=16, minibatches=2, epochs=2, hidden=(8,), stop_coverage=2.0)


def learners(env, params):
    driver = Driver(env, make_layout(env, params, CONFIG))
    return [Learner(env, driver, dataclasses.replace(CONFIG, seed=seed)) for seed in (0, 1)]


@pytest.fixture(scope="module")
def world(tunnel):
    """Episodes so short that truncation happens in every unroll."""
    return st.make(TASK, tunnel=tunnel, horizon=20)


@pytest.fixture(scope="module")
def alone(world):
    return [ppo.train(learner, world[1]) for learner in learners(*world)]


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["cpu", "gpu"], ids=["one after the other", "vmapped"])
def test_a_seed_trained_with_others_comes_to_the_numbers_it_comes_to_alone(world, alone, backend, monkeypatch):
    monkeypatch.setattr(ppo, "compiler_options", lambda config: None)
    monkeypatch.setattr(ppo.jax, "default_backend", lambda: backend)
    together = ppo.train_seeds(learners(*world), world[1], [None, None])
    for one, other in zip(alone, together, strict=True):
        assert one.iteration == other.iteration == 3
        np.testing.assert_array_equal(one.window.last["step"], other.window.last["step"])
        np.testing.assert_allclose(one.window.last["coverage"], other.window.last["coverage"], rtol=1e-3)
        for name, value in one.record.items():
            if name != "timing":
                assert value == pytest.approx(other.record[name], rel=2e-3, abs=2e-4), name
        for a, b in zip(*map(jax.tree.leaves, (one.state.student.weights, other.state.student.weights)), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4)
    assert alone[0].record["policy_loss"] != pytest.approx(alone[1].record["policy_loss"], rel=1e-3)


def test_a_seed_that_is_done_stands_still_while_others_go_on(world):
    both, seen = learners(*world), []
    both[0].config = dataclasses.replace(both[0].config, steps=256)
    first, second = ppo.train_seeds(both, world[1], [None, None], lambda k, now: seen.append((k, now.iteration)))
    assert seen == [(0, 1), (1, 1), (1, 2), (1, 3)]
    assert (first.iteration, int(first.state.iteration), second.iteration) == (1, 1, 3)


def test_seeds_below_zero_or_named_twice_are_refused():
    for wrong in ((0, -1), (3, 3)):
        with pytest.raises(ConfigError, match=r"negative, got -1|named 2 times"):
            session.check_seeds(wrong)


@pytest.fixture(scope="module")
def several(tunnel, tmp_path_factory):
    """Runs the command; returns its status and folder."""

    def run(*arguments, out=None):
        out = out or tmp_path_factory.mktemp("seeds") / "runs"
        common = ("--task", TASK, "--tunnel", str(tunnel), "--preset", "cpu", "--evaluation-episodes", "10")
        more = ("--seeds", "0", "1", "--stop-coverage=2", "--checkpoint-every=1")
        return call(navigate.main, *common, *SMALL, *more, "--out", str(out), *arguments), out

    return run


@pytest.mark.slow
def test_the_command_writes_a_run_for_each_seed_and_goes_on_where_they_last_stood_together(several, capsys):
    status, whole = several("--steps=16384")
    assert status == 0
    assert "± sd" in capsys.readouterr().out
    status, out = several("--steps=8192")
    assert status == 0
    # As if killed between two checkpoints: seed 1 has one less than seed 0.
    (last,) = [p for p in (out / "seed-1" / "checkpoint").iterdir() if p.name == "00000002"]
    for path in sorted(last.rglob("*"), reverse=True):
        path.unlink() if path.is_file() else path.rmdir()
    last.rmdir()
    status, _ = several("--steps=16384", "--resume", out=out)
    assert status == 0
    for name in ("seed-0", "seed-1"):
        assert log_without_timing(out / name) == log_without_timing(whole / name)
        assert (out / name / "episodes.csv").read_bytes() == (whole / name / "episodes.csv").read_bytes()
    assert log_without_timing(out / "seed-0") != log_without_timing(out / "seed-1")
    assert json.loads((out / "seed-1" / "config.json").read_text())["config"]["seed"] == 1
    assert (out / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert len(json.loads((out / "seeds.json").read_text())["runs"]) == 2


def test_the_milestone_is_the_first_line_at_which_the_goal_holds(tmp_path):
    lines = [
        {"episodes": 50, "coverage_mean_100": 0.95, "success_mean_100": 1.0, "step": 10},
        {"episodes": 120, "coverage_mean_100": 0.95, "success_mean_100": 0.99, "step": 20},
        {"episodes": 220, "coverage_mean_100": 0.90, "success_mean_100": 1.0, "step": 30},
        {"episodes": 320, "coverage_mean_100": 0.91, "success_mean_100": 1.0, "step": 40},
    ]
    timing = {"seconds": 7.0, "compile_seconds": 5.0}
    text = "".join(json.dumps({**line, "timing": timing}) + "\n" for line in lines)
    (tmp_path / "log.jsonl").write_text(text)
    found = session.reached(tmp_path)
    assert found == {"episodes": 220, "steps": 30, "seconds": 7.0, "seconds_compiled": 2.0}
    (tmp_path / "log.jsonl").write_text(text.splitlines()[0] + "\n")
    assert session.reached(tmp_path) is None
