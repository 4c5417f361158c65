"""PPO learns to drive through a corridor and stops in time."""

import json

import numpy as np
import pytest

from train.log import read_log


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
