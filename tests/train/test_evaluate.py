"""Evaluation of policies: scores that geometry tells, the command, ablations."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.baselines.agent import observed
from subterra_jax.evaluation import evaluate as drive
from subterra_jax.evaluation import listed_episodes
from subterra_jax.rules import StartParams
from tests.train.conftest import TASK, call
from train import evaluate
from train.config import ConfigError, TrainConfig
from train.driver import Driver, Policy
from train.policies import make_agent, open_agent
from train.setup import make_layout
from train.without import without


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


def test_an_ablation_takes_away_what_it_names_and_nothing_else():
    env, params = st.make("Subterra/StopAtShort-v1", tunnel="open:cast:train:0")
    flat, _ = env.reset(jax.random.key(0), params)
    begun = observed(env, params, flat)
    obs = dataclasses.replace(begun, distance=begun.distance + 5.0)
    driver = Driver(env, make_layout(env, params, TrainConfig(hidden=(4,))))
    agent = make_agent(driver, Policy(driver.init(jax.random.PRNGKey(0))))

    def reads(agent):
        act = jax.jit(lambda obs: agent.act(None, agent.begin(None, begun, params), obs, params, None))
        return np.asarray(act(obs)[1].kept.seen)

    whole = reads(agent)
    beams = slice(4, 4 + 2 * params.lidar.n_beams)
    for part, places in (("start", range(4)), ("odometry", range(4)), ("walls", range(beams.start, beams.stop))):
        changed = reads(without(agent, part)) != whole
        assert changed[list(places)].any()
        assert not np.delete(changed, list(places)).any()
    assert 100.0 * (whole - reads(without(agent, "start")))[3] == pytest.approx(40.0, abs=1e-3)
    assert 100.0 * (whole - reads(without(agent, "odometry")))[3] == pytest.approx(-5.0, abs=1e-3)
    for part in ("front", "memory"):
        with pytest.raises(ConfigError, match="to go without"):
            without(agent, part)


def test_without_its_localiser_a_policy_reads_the_dead_reckoned_way():
    agent, _ = open_agent(None, "StopAt-v1")
    env, params = st.make("Subterra/StopAt-v1", tunnel="open:cast:train:0")
    obs = observed(env, params, env.reset(jax.random.key(0), params)[0])
    drifted = dataclasses.replace(obs, distance=obs.distance + 5.0)

    def way(agent):
        act = jax.jit(lambda drifted: agent.act(None, agent.begin(None, obs, params), drifted, params, None))
        return 100.0 * float(act(drifted)[1].kept.seen[3])

    assert way(agent) - way(without(agent, "memory")) == pytest.approx(5.0, abs=0.2)
