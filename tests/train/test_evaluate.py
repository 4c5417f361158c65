import json

import jax
import jax.numpy as jnp
import pytest

import subterra_jax as st
from subterra_jax.evaluation import evaluate as drive
from subterra_jax.evaluation import listed_episodes
from subterra_jax.rules import StartParams
from tests.train.conftest import TASK, call
from train import evaluate
from train.config import TrainConfig
from train.driver import Driver, Policy
from train.policies import make_agent
from train.setup import make_layout


@pytest.fixture(scope="module")
def straight_driver():
    """A policy that drives straight on at 1 m/s whatever it sees."""
    env, params = st.make(TASK)
    driver = Driver(env, make_layout(env, params, TrainConfig(hidden=(4,))))
    weights = jax.tree.map(lambda x: 0.0 * x, driver.init(jax.random.PRNGKey(0)))
    # A speed of 1 m/s between -1 and 2 m/s.
    weights["actor"]["out"]["bias"] = jnp.arctanh(jnp.array([2.0 * 2.0 / 3.0 - 1.0, 0.0]))
    return make_agent(driver, Policy(weights))


def driven(agent, tunnel, **start):
    env, params = st.make(TASK, tunnel=tunnel, start=StartParams(**start))
    return evaluate.scores(drive(env, params, agent, listed_episodes(env, params, 20)))


def test_a_drive_down_the_centreline_scores_what_geometry_says(straight_driver, tunnel):
    scores = driven(straight_driver, tunnel, lateral=0.0, heading=0.0)
    assert scores["success"] == 1.0
    assert scores["coverage"] == pytest.approx(0.9, abs=0.006)
    assert scores["coverage_min"] == pytest.approx(0.9, abs=0.006)
    assert scores["time"] == pytest.approx(18.0, abs=0.15)
    assert scores["offset"] == pytest.approx(0.0, abs=1e-4)
    assert scores["jerk"] == pytest.approx(1.0 / 180.0, rel=0.02)
    assert (scores["contacts"], scores["contacts_per_100m"]) == (0, 0.0)


def test_a_drive_into_the_wall_counts_its_contact(straight_driver, tunnel):
    scores = driven(straight_driver, tunnel, heading=1.0)
    assert scores["success"] < 1.0
    assert scores["contacts"] == round(20 * (1.0 - scores["success"]))
    assert scores["contacts_per_100m"] > 0.0


def test_a_trained_policy_succeeds_without_its_exploration_noise(trained):
    scores = json.loads((trained / "evaluation.json").read_text())
    assert scores["episodes"] >= 100
    assert scores["success"] == 1.0
    assert scores["coverage"] >= 0.9
    assert scores["contacts"] == 0


def test_the_command_prints_one_line_of_json_and_nothing_else(trained, tunnel, capfd):
    words = ("--policy", str(trained), "--task", TASK, "--tunnel", str(tunnel), "--episodes", "100", "--json")
    assert call(evaluate.main, *words) == 0
    (line,) = capfd.readouterr().out.splitlines()
    saved = json.loads((trained / "evaluation.json").read_text())
    assert json.loads(line) == {name: value for name, value in saved.items() if name != "schema"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--task", "Subterra/Nowhere-v1"), "no task 'Subterra/Nowhere-v1'"),
        (("--tunnel", "nowhere.npz"), "nowhere.npz: no such tunnel file"),
        (("--lining", "velvet"), "no lining 'velvet'"),
        (("--episodes", "0"), "episodes must be at least 1, got 0"),
        (("--episodes", "501"), "episodes must be at most 500"),
        (
            ("--task", "Subterra/StopAt-v1"),
            "has learnt Subterra/TraverseShort-v1 (to cover); Subterra/StopAt-v1 asks",
        ),
    ],
)
def test_a_mistake_on_the_command_line_is_one_sentence_and_status_2(trained, capsys, arguments, message):
    assert call(evaluate.main, "--policy", str(trained), *arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert error.count("\n") == 1


def test_without_a_policy_or_a_task_nothing_can_be_scored(capsys):
    assert call(evaluate.main) == 2
    assert "a task or a policy must be named" in capsys.readouterr().err


def test_a_policy_that_there_is_not_is_refused_with_those_there_are(capsys):
    assert call(evaluate.main, "--policy", "nobody") == 2
    assert "nobody: no such policy; released are" in capsys.readouterr().err
