import json
import subprocess
import sys

import jax
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.env import StartParams
from tests.train.conftest import TASK, call
from train import evaluate, networks, normalize


@pytest.fixture(scope="module")
def straight_driver(tunnel):
    """A policy that drives straight on at 1 m/s whatever it sees, from the middle of the mouth."""
    env, params = st.make(TASK, tunnel=tunnel, start=StartParams(lateral=0.0, heading=0.0))
    nets = networks.Networks(networks.Layout(18, (0.0, -1.5), (2.0, 1.5), 4, (4,), 0.5, 0.01))
    weights = jax.tree.map(lambda x: 0.0 * x, nets.init(jax.random.PRNGKey(0))["policy"])
    return env, params, nets, networks.Policy(weights, normalize.init((18,)))


def test_a_drive_down_the_centreline_scores_what_geometry_says(straight_driver):
    scores = evaluate.evaluate(*straight_driver, n_episodes=5, seed=0)
    assert scores["success"] == 1.0
    assert scores["coverage"] == pytest.approx(0.9, abs=0.006)
    assert scores["time"] == pytest.approx(18.0, abs=0.15)
    assert scores["offset"] == pytest.approx(0.0, abs=1e-4)
    assert scores["jerk"] == pytest.approx(1.0 / 180.0, rel=0.02)
    assert (scores["contacts"], scores["contacts_per_100m"]) == (0, 0.0)


def test_a_drive_into_the_wall_counts_its_contact(straight_driver):
    env, params, nets, policy = straight_driver
    params = params.replace(start=params.start.replace(heading=np.float32(1.0)))
    scores = evaluate.evaluate(env, params, nets, policy, n_episodes=20, seed=0)
    assert scores["success"] < 1.0
    assert scores["contacts"] == round(20 * (1.0 - scores["success"]))
    assert scores["contacts_per_100m"] > 0.0


def test_an_episode_does_not_depend_on_how_many_are_driven_with_it(straight_driver):
    env, params, nets, policy = straight_driver
    params = params.replace(start=params.start.replace(heading=np.float32(0.3), lateral=np.float32(0.5)))
    key = jax.random.PRNGKey(3)
    run = jax.jit(evaluate.drive, static_argnums=(0, 2, 5))
    few, many = (run(env, params, nets, policy, key, n_episodes) for n_episodes in (3, 10))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b[:3], rtol=1e-5), few, many)


def test_a_trained_policy_succeeds_without_its_exploration_noise(trained):
    scores = json.loads((trained / "evaluation.json").read_text())
    assert scores["episodes"] >= 100
    assert scores["success"] == 1.0
    assert scores["coverage"] >= 0.9
    assert scores["contacts"] == 0


def test_the_command_prints_one_line_of_json_and_nothing_else(trained, tunnel):
    line = [sys.executable, "-m", "train.evaluate", "--policy", str(trained), "--task", TASK]
    ran = subprocess.run(
        [*line, "--tunnel", str(tunnel), "--episodes", "100", "--json"], capture_output=True, text=True, check=True
    )
    assert ran.stdout.count("\n") == 1
    saved = json.loads((trained / "evaluation.json").read_text())
    assert json.loads(ran.stdout) == {name: value for name, value in saved.items() if name != "schema"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--task", "Subterra/Nowhere-v0"), "unknown task 'Subterra/Nowhere-v0'"),
        (("--tunnel", "nowhere.npz"), "nowhere.npz: no such tunnel file"),
        (("--lining", "velvet"), "no lining 'velvet'"),
        (("--episodes", "0"), "episodes must be at least 1, got 0"),
    ],
)
def test_a_mistake_on_the_command_line_is_one_sentence_and_status_2(trained, capsys, arguments, message):
    assert call(evaluate.main, "--policy", str(trained), *arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert error.count("\n") == 1
