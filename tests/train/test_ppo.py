"""PPO learns to drive through a corridor, stops in time and resumes bit for bit."""

import json

import numpy as np
import pytest

from tests.train.conftest import log_without_timing
from train import checkpoint
from train.log import read_log


@pytest.fixture(scope="module")
def straight_through(train_small):
    status, out = train_small("--steps=20000", "--stop-coverage=2", "--checkpoint-every=2")
    assert status == 0
    return out


def test_ppo_learns_to_drive_through_a_corridor(trained):
    last = read_log(trained)[-1]
    assert last["coverage_mean_100"] >= 0.9
    assert last["success_mean_100"] == 1.0
    assert last["timing"]["seconds"] < 60.0


def test_training_stops_once_the_goal_has_held_for_long_enough(trained):
    log, config = read_log(trained), json.loads((trained / "config.json").read_text())["config"]
    assert log[-1]["step"] < config["steps"]
    held = [line["coverage_mean_100"] >= 0.9 and line["success_mean_100"] == 1.0 for line in log]
    assert all(held[-config["stop_patience"] :])


def test_the_rolling_means_of_the_log_are_those_of_the_episodes_file(trained):
    rows = np.genfromtxt(trained / "episodes.csv", delimiter=",", names=True)
    for line in read_log(trained):
        so_far = rows[: line["episodes"]][-100:]
        if len(so_far):
            assert line["coverage_mean_100"] == pytest.approx(so_far["coverage"].mean(), abs=1e-7)
            assert line["success_mean_100"] == so_far["success"].mean()
    assert (np.diff(rows["step"]) >= 0).all()
    np.testing.assert_array_equal(rows["episode"], np.arange(1, len(rows) + 1))


def test_the_same_seed_logs_the_same_and_a_resumed_run_continues_bit_for_bit(train_small, straight_through):
    status, out = train_small("--steps=12000", "--stop-coverage=2", "--checkpoint-every=2")
    assert status == 0
    assert log_without_timing(out) == log_without_timing(straight_through)[:3]

    # As if killed after logging an iteration that no checkpoint knows.
    with (out / "log.jsonl").open("a") as log:
        log.write('{"iteration": 4, "half a li')
    status, _ = train_small("--steps=20000", "--stop-coverage=2", "--checkpoint-every=2", "--resume", out=out)
    assert status == 0
    assert log_without_timing(out) == log_without_timing(straight_through)
    for name in ("episodes.csv", "curve.csv", "evaluation.json"):
        assert (out / name).read_bytes() == (straight_through / name).read_bytes(), name
    assert (
        checkpoint.load_checkpoint(out).facts["digest"] == checkpoint.load_checkpoint(straight_through).facts["digest"]
    )
