"""Inputs of a network: the same in training and in driving, on every task and with every memory."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax import policies
from subterra_jax.baselines.agent import observed
from subterra_jax.baselines.stations import OdometerCount
from subterra_jax.policies import inputs
from subterra_jax.policies.memories import Given, Memory
from subterra_jax.rules import GoalParams
from tests.train.conftest import weights_of
from train.config import TrainConfig
from train.driver import Driver, Policy
from train.policies import begin_with, make_agent
from train.rollout import begin, collect
from train.setup import make_layout

N_STEPS = 4
GOAL_TASKS = ("StopAtShort-v1", "Return-v1", "Obstructed-v1", "Faulted-v1")


@pytest.fixture(scope="module")
def plan():
    return st.load_tunnel("open:cast:train:0")


def train_and_drive(plan, task, config, localiser=None):
    """An unroll as training drives it, and what an agent with the same weights reads of the same observations."""
    env, params = st.make(f"Subterra/{task}", tunnel=plan)
    driver = Driver(env, make_layout(env, params, config, Given(localiser)))
    memory = driver.layout.memory

    def run(params, policy, agent):
        def step(drive, key):
            state = jax.tree.map(lambda leaf: leaf[0], drive.env_state)
            after, rollout, *_ = collect(env, driver, policy, params, drive, key, 1)
            return after, (rollout.inputs[0, 0], driver.action(rollout.raw[0])[0], state)

        def read(kept, step):
            action, state = step
            obs = observed(env, params, env.observe(state, env.draw_step(jax.random.PRNGKey(5), (), params), params))
            own = memory.take(kept.kept, kept.command, obs, params, agent.given)
            return dataclasses.replace(kept, kept=own, command=action[:2]), own.seen

        drive = begin(env, driver, policy, params, jax.random.PRNGKey(1), 1)
        start = jax.tree.map(lambda leaf: leaf[0], drive.env_state)
        flat = env.observe(start, env.draw_step(jax.random.PRNGKey(5), (), params), params)
        _, (seen, acted, states) = jax.lax.scan(step, drive, jax.random.split(jax.random.PRNGKey(2), N_STEPS))
        kept = agent.begin(None, observed(env, params, flat), params)
        return seen, jax.lax.scan(read, kept, (acted, states))[1]

    policy = Policy(weights_of(driver, 0, 0.01), localiser)
    agent = make_agent(driver, policy)
    agent.try_out()
    seen, read = jax.jit(lambda params, policy: run(params, policy, agent))(params, policy)
    return driver, policy, agent, np.asarray(seen), np.asarray(read)


@pytest.mark.parametrize("task", [*GOAL_TASKS, "Traverse-v1", "Relocalise-v1"])
def test_training_and_driving_read_equal_numbers(plan, task):
    _, _, _, seen, read = train_and_drive(plan, task, TrainConfig(hidden=(8,), memory="stack", frames=2))
    # The scan's noise of a step is drawn anew: what is compared is all but the ranges, closely.
    seen = seen[:, seen.shape[1] // 2 :]
    ranges = np.zeros(seen.shape[1], bool)
    ranges[4 : 4 + 32] = True
    ranges[41 : 41 + 16] = True
    np.testing.assert_allclose(read[:, ~ranges], seen[:, ~ranges], atol=1e-5)
    assert np.mean(np.abs(read - seen)[:, 4:36]) < 0.1


@pytest.mark.parametrize("task", GOAL_TASKS)
def test_the_way_to_go_is_the_true_one_but_for_the_odometer_and_the_start_that_is_given(plan, task):
    env, params = st.make(f"Subterra/{task}", tunnel=plan)

    @jax.jit
    @jax.vmap
    def start(key):
        flat, state = env.reset(key, params)
        return way_at_start(env, params, flat), env.privileged(state, params)["to_goal"]

    way, truth = start(jax.random.split(jax.random.key(0), 32))
    np.testing.assert_allclose(way, truth, atol=0.5)
    assert np.median(truth) > 20.0


def way_at_start(env, params, flat):
    obs = observed(env, params, flat)
    return inputs.way_to_go(inputs.begin(obs), obs, params)


def test_a_start_that_is_40_m_off_makes_another_way_to_go(plan):
    env, params = st.make("Subterra/StopAtShort-v1", tunnel=plan)
    flat, _ = env.reset(jax.random.key(0), params)
    shifted = flat.at[env.fields(params)["start"]].add(40.0)
    assert way_at_start(env, params, flat) - way_at_start(env, params, shifted) == pytest.approx(40.0, abs=1e-3)


def test_who_remembers_reads_how_far_the_commands_are_ahead_of_the_odometer(plan):
    env, params = st.make("Subterra/StopAtShort-v1", tunnel=plan)
    obs = observed(env, params, env.reset(jax.random.key(0), params)[0])
    now, moved = inputs.begin(obs), dataclasses.replace(obs, distance=obs.distance + 0.1)
    for _ in range(3):
        now = inputs.obey(now, jnp.array([1.0, 0.0]), 0.1)
    assert float(100.0 * inputs.look(now, moved, 0.0, params, relief=True)[-1]) == pytest.approx(0.2, abs=1e-4)


def test_after_the_flag_the_way_leads_back_to_the_start(plan):
    env, params = st.make("Subterra/Return-v1", tunnel=plan)
    flat, _ = env.reset(jax.random.key(0), params)
    obs = observed(env, params, flat)
    out = float(obs.goal - obs.start)
    now = inputs.begin(obs)
    there = dataclasses.replace(obs, distance=obs.distance + out - 2.0, flag=jnp.float32(1.0))
    now = inputs.see(now, there)
    reach = float(params.goal.flag_reach)
    assert float(inputs.way_to_go(now, there, params)) == pytest.approx(out - reach, abs=1e-3)
    assert not now.turned
    back = dataclasses.replace(there, distance=there.distance + 10.0, heading=obs.heading + 3.0)
    now = inputs.see(now, back)
    assert float(inputs.way_to_go(now, back, params)) == pytest.approx(out - reach - 10.0, abs=1e-3)
    bent = dataclasses.replace(back, heading=obs.heading + 1.0)
    assert now.turned
    assert inputs.see(now, bent).turned  # wherever the tunnel bends on the way back


def test_a_localiser_counts_the_way_back_from_where_the_robot_has_turned(tunnel, monkeypatch):
    """Walls that are found anew while the robot is still askew count a metre as less."""
    monkeypatch.setattr(Given, "localiser", lambda given, params: OdometerCount())
    env, params = st.make("Subterra/Return-v1", tunnel=str(tunnel), goal=GoalParams(low=4.0, high=8.0, margin=4.0))
    memory, flag = Memory("along"), jnp.float32(1.0)

    @jax.jit
    def step(state, kept, command, key):
        flat, state, *_ = env.step(key, state, command, params)
        obs = dataclasses.replace(observed(env, params, flat), flag=flag)
        return state, memory.take(kept, command, obs, params, Given())

    flat, state = env.reset(jax.random.key(0), params)
    kept = memory.begin(observed(env, params, flat), params, Given())
    around = [jnp.array([0.0, 1.5])] * 16 + [jnp.array([1.0, 1.5])] * 5  # the last third of the turn while it drives
    for k, command in enumerate([jnp.array([1.0, 0.0])] * 10 + around + [jnp.array([1.0, 0.0])] * 20):
        state, kept = step(state, kept, command, jax.random.key(k))
    assert kept.located.direction == -1.0
    assert float(kept.located.station.station - state.station) == pytest.approx(0.0, abs=0.25)


def test_a_localiser_drives_in_training_as_in_an_agent(plan):
    localiser = begin_with("locate-transformer").localiser
    driver, policy, agent, seen, read = train_and_drive(
        plan, "StopAtShort-v1", TrainConfig(hidden=(8,), memory="along", walls=True, cruise=1.2), localiser
    )
    assert seen.shape[-1] == driver.layout.shape.n_inputs
    assert agent.given.weights["match"]["taps"].shape == policy.localiser["match"]["taps"].shape
    np.testing.assert_allclose(read[:, :4], seen[:, :4], atol=1e-4)
    np.testing.assert_allclose(read[:, -4], seen[:, -4], atol=1e-4)
    np.testing.assert_allclose(read[:, -3:], seen[:, -3:], atol=0.2)  # the scan's noise of a step is drawn anew
    assert np.all(np.std(seen[:, -3:], axis=0) > 0.0)
    assert float(driver.action(jnp.array([9.0, 0.0]))[0]) == pytest.approx(1.2)
    env, params = st.make("Subterra/StopAtShort-v1", tunnel=plan)
    policies.check_task(agent, env, params, "mine")
    with pytest.raises(policies.PolicyError, match=r"made for actions up to \[2.5, 1.5\]"):
        policies.check_task(dataclasses.replace(agent, high=agent.high.at[0].set(2.5)), env, params, "mine")
