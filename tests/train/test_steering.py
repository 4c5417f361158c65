"""A steering that learns by reward: what it sees, that its file acts as the network that learnt, and mistakes."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax import policies
from subterra_jax.baselines.agent import observed
from subterra_jax.policies.locate.steering import N_SIGHT, PREFIX, LearntSteering, sight, to_command
from train.config import ConfigError, PPOConfig
from train.feedforward.learner import Learner
from train.locate import steering
from train.policies import policy_tensors

_SMALL = PPOConfig(n_envs=4, unroll=8, minibatches=2, hidden=(8,), frames=3, steps=64, stop_coverage=2.0)


@pytest.fixture(scope="module")
def task():
    return st.make("Subterra/Obstructed-v1", tunnel="subterra-351")


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    out = tmp_path_factory.mktemp("steering") / "run"
    steering.run(steering.Command("locate-transformer", out, tunnels="subterra-351", config=_SMALL))
    return out / "policy.safetensors"


def test_full_speed_can_be_chosen_and_standing_cannot_since_it_would_end_the_episode():
    shares = jnp.array([-0.5, 0.0, 0.5, 0.96, 1.0])
    speeds = jax.vmap(lambda share: to_command(jnp.stack([share, 0.7]), jnp.float32(2.0))[0])(shares)
    np.testing.assert_allclose(speeds, [0.4, 0.4, 1.05, 2.0, 2.0], rtol=1e-6)
    assert float(to_command(jnp.array([0.3, 0.7]), jnp.float32(2.0))[1]) == pytest.approx(0.7)
    assert float(to_command(jnp.array([0.3, 0.7]), jnp.float32(0.0))[0]) == 0.0, "the mission alone says when to stop"


def test_of_a_finer_lidar_it_sees_the_beams_of_sixteen():
    ranges = jnp.arange(64.0)
    np.testing.assert_array_equal(sight(ranges, jnp.array([1.0, 2.0])), [*range(0, 64, 4), 1.0, 2.0])


def test_a_robot_is_shown_ranges_and_its_last_command_and_goes_no_further_than_the_goal(task):
    env, params = task
    steered = steering.SteeringEnv(env)
    state = jax.jit(steered.begin)(steered.draw_reset(jax.random.key(0), (), params), params)
    noise = steered.draw_step(jax.random.key(1), (), params)
    near = dataclasses.replace(
        state, inner=state.inner.replace(goal=dataclasses.replace(state.inner.goal, station=state.inner.station + 0.05))
    )
    after, *_ = jax.jit(steered.advance)(near, jnp.array([1.0, 0.3]), noise, params)
    np.testing.assert_allclose(after.command, [0.05 / params.vehicle.period, 0.3], rtol=1e-4)
    shown = jax.jit(steered.observe)(after, noise, params)
    flat = env.observe(after.inner, noise, params)
    assert shown.shape == (N_SIGHT,) == (steered.observation_size(params),)
    np.testing.assert_allclose(shown, [*observed(env, params, flat).ranges, *after.command], rtol=1e-5)


def test_the_file_steers_as_the_network_that_learnt(task):
    env, params = task
    learner = Learner(steering.SteeringEnv(env), params, _SMALL)
    state = jax.jit(learner.init)(jax.random.PRNGKey(3), params)
    policy = learner.policy_of(state)
    statistics = policy.statistics.replace(mean=jnp.full(N_SIGHT, 0.4), std=jnp.linspace(0.5, 2.0, N_SIGHT))
    weights = jax.tree.map(lambda leaf: leaf + 0.1, policy.weights)
    policy = dataclasses.replace(policy, statistics=statistics, weights=weights)
    tensors = policy_tensors(learner.networks, policy)
    stack = jax.random.normal(jax.random.key(0), (3, N_SIGHT))
    # The network's own means carry an offset for the spread alone.
    np.testing.assert_allclose(LearntSteering(tensors, 3).choose(stack), learner.networks.act(policy, stack), rtol=1e-5)


def test_a_policy_localises_as_before_and_steers_as_it_learnt(written, task):
    env, params = task
    agent, facts = policies.load(written)
    assert (agent.frames, facts["steering"]["task"]) == (3, "Subterra/Obstructed-v1")
    assert "by reward how to steer" in facts["learnt"], "the card says what was learnt"
    assert facts["task"] == "Subterra/Obstructed-v1"
    assert "scores" not in facts, "scores of the localiser under the written steering"
    given = policies.load("locate-transformer")[0].tensors
    for name, tensor in given.items():
        np.testing.assert_array_equal(agent.tensors[name], tensor)
    other = dataclasses.replace(
        agent, tensors={n: -t if n.startswith(PREFIX + "policy.hidden_1") else t for n, t in agent.tensors.items()}
    )
    commands = [_drive(one, env, params) for one in (agent, other, policies.load("locate-transformer")[0])]
    assert np.isfinite(commands[0]).all()
    for one in commands[1:]:
        assert np.abs(commands[0] - one).max() > 1e-3


def test_a_learnt_steering_goes_beside_another_localiser_and_nothing_is_trained(written, tmp_path):
    command = steering.Command("locate-obstructed", tmp_path / "both", steering=str(written))
    steering.run(command)
    agent, facts = policies.load(tmp_path / "both" / "policy.safetensors")
    theirs, localiser = policies.load(written), policies.load("locate-obstructed")
    assert facts["steering"] == {**theirs[1]["steering"], "localiser": localiser[1]["tensors_sha256"]}
    expected = {n: t for n, t in theirs[0].tensors.items() if n.startswith(PREFIX)} | dict(localiser[0].tensors)
    assert agent.tensors.keys() == expected.keys()
    for name, tensor in agent.tensors.items():
        np.testing.assert_array_equal(tensor, expected[name])
    with pytest.raises(ConfigError, match="exists already"):
        steering.run(command)


def _drive(agent, env, params, n=4):
    draws, noise = env.draw_reset(jax.random.key(0), (), params), env.draw_step(jax.random.key(1), (), params)
    state = env.begin(draws, params)
    seen = observed(env, params, env.observe(state, noise, params))
    memory, found = agent.begin(jax.random.key(2), seen, params), []
    for _ in range(n):
        action, memory = agent.act(jax.random.key(3), memory, seen, params, None)
        state = env.advance(state, action[: env.action_size], noise, params)[0]
        seen = observed(env, params, env.observe(state, noise, params))
        found.append(action[:2])
    return np.array(found)


def test_tensors_that_do_not_fit_are_refused(written):
    agent, facts = policies.load(written)
    for layout, tensors in (
        ({**facts["layout"], "frames": 0}, agent.tensors),
        ({**facts["layout"], "frames": 4}, agent.tensors),
        (facts["layout"], {n: t for n, t in agent.tensors.items() if n != PREFIX + "policy.hidden_0.bias"}),
    ):
        with pytest.raises((KeyError, TypeError, ValueError)):
            policies.from_tensors("locate", layout, tensors, "x", None).try_out()


def test_mistakes_are_told_before_anything_is_written(tmp_path):
    out = tmp_path / "run"
    for localiser, more, sentence in (
        ("Traverse-v1", {}, "Traverse-v1: is no localiser"),
        ("locate-transformer", {"task": "Subterra/Return-v1"}, "asks to return"),
        ("locate-transformer", {"steering": "locate-map"}, "locate-map: has no steering that was learnt"),
    ):
        with pytest.raises(ConfigError, match=sentence):
            steering.run(steering.Command(localiser, out, tunnels="subterra-351", config=_SMALL, **more))
    assert not out.exists()


def test_the_run_says_what_it_was(written):
    config = json.loads((written.parent / "config.json").read_text())
    assert config["config"]["frames"] == 3
    assert (written.parent / "log.csv").exists()
