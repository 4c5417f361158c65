"""PPO learns to drive and to stop, and what would break it is noticed: by the run, or by what a step of it does."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.rules import GoalParams, Traverse
from tests.subterra_jax.tunnels import write_corridor
from train.config import TrainConfig
from train.driver import Driver, Policy
from train.evaluate import evaluate
from train.log import read_log
from train.policies import make_agent
from train.ppo import train
from train.rollout import begin, collect
from train.setup import make_layout, make_learner
from train.world import World

TASK = "Subterra/StopAtShort-v1"
LEAST = 0.5  # of 100 episodes without exploration noise
TINY = TrainConfig(steps=2048, n_envs=16, unroll=16, minibatches=2, hidden=(8,))


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """Goals 4 to 12 m away in a corridor; a metre off is still there, and fifteen seconds are enough."""
    plan = write_corridor(tmp_path_factory.mktemp("tunnel") / "corridor.npz", length=40.0)
    goal = GoalParams(low=4.0, high=12.0, margin=6.0, tolerance=1.0)
    env, params = st.make(TASK, tunnel=str(plan), goal=goal, horizon=150)
    return World(TASK, env, params, {})


def test_a_policy_learns_to_stop_at_its_goal_and_drives_as_it_was_trained(world):
    """Advantages of the wrong sign, or a start that training reads 40 m off, leave it below a tenth."""
    config = TrainConfig(
        steps=250_000, n_envs=64, unroll=32, hidden=(32, 32), learning_rate=1e-3, discount=0.99, last_std=0.1
    )
    learner = make_learner(world, config)
    last = train(learner, world.params)
    assert evaluate(world, make_agent(learner.driver, last.policy), 100)["success"] >= LEAST
    np.testing.assert_array_less(np.exp(last.state.student.weights["log_std"]), 0.1001)


@dataclasses.dataclass(frozen=True)
class Fast(Traverse):
    """Pays for speed."""

    def judge(self, step, params):
        return dataclasses.replace(super().judge(step, params), terms={"reward_speed": step.drive.motion[0]})


def test_what_pays_becomes_likelier(tunnel):
    env, params = st.make("Subterra/TraverseShort-v1", tunnel=str(tunnel), horizon=20)
    fast = World("Subterra/TraverseShort-v1", dataclasses.replace(env, rule=Fast()), params, {})
    paid = []
    train(make_learner(fast, TINY), params, log=lambda line: paid.append(line["reward_speed"]))
    assert paid[-1] > paid[0] + 0.1


def test_robots_whose_truth_alone_differs_read_and_do_the_same_and_are_asked_for_something_else(world):
    env, params = world.env, world.params
    driver = Driver(env, make_layout(env, params, TrainConfig(hidden=(8,), memory="gru", cell=8, auxiliary=True)))
    policy = Policy(driver.init(jax.random.PRNGKey(0)))
    drive = begin(env, driver, policy, params, jax.random.PRNGKey(1), 2)
    further = dataclasses.replace(drive.env_state, station=drive.env_state.station + 5.0)
    unroll = jax.jit(lambda drive: collect(env, driver, policy, params, drive, jax.random.PRNGKey(2), 1)[1])
    one, other = unroll(drive), unroll(dataclasses.replace(drive, env_state=further))
    for name in ("inputs", "raw", "log_prob", "value"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    np.testing.assert_allclose(one.error - other.error, 5.0, atol=1e-3)
    out = driver.unroll(policy.network, one.inputs, drive.memory, one.first)
    np.testing.assert_allclose(driver.log_prob(out, one.raw), one.log_prob, atol=1e-5)
    assert one.error.shape == (1, 2, 1)
    assert jnp.abs(one.error).max() < 1.0  # at the start nothing is off but the odometer


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
