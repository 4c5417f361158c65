import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from train import learning
from train.config import PPOConfig
from train.feedforward import networks
from train.feedforward.learner import Learner
from train.feedforward.rollout import begin, collect, push_frame, rebuild_stacks

HORIZON, N_ENVS, N_STEPS, N_FRAMES = 5, 3, 12, 4


@pytest.fixture(scope="module")
def driven(tunnel):
    """An unroll with episodes of five steps, and the same steps taken one by one outside of `collect`."""
    env, params = st.make("Subterra/TraverseShort-v1", tunnel=tunnel, horizon=HORIZON)
    nets = networks.Networks(networks.Layout(18, (0.0, -1.5), (2.0, 1.5), N_FRAMES, (8,), 0.5, 0.01))
    weights, statistics = nets.init(jax.random.PRNGKey(0)), learning.start_statistics((18,))
    batch, key = st.batch.AutoReset(env), jax.random.PRNGKey(2)
    drive = jax.jit(lambda p: begin(batch, p, jax.random.PRNGKey(1), N_ENVS, N_FRAMES))(params)
    run = jax.jit(lambda p, d: collect(batch, p, nets, weights, statistics, d, key, N_STEPS))
    after, rollout, finished, terms = run(params, drive)

    @jax.jit
    def step(p, state, stack, key_now, raw):
        _, key_env = jax.random.split(key_now)
        observation, state, reward, _, truncated, info = batch.step(key_env, state, nets.action(raw), p)
        final = push_frame(stack, info["final_observation"], jnp.zeros(N_ENVS, bool))
        value = nets.value(weights["value"], statistics, final)
        seen = {"stack": stack, "reward": reward, "value": value, "coverage": info["coverage"]}
        return state, push_frame(stack, observation, truncated), seen

    state, stack, steps = drive.env_state, drive.stack, []
    for key_now, raw in zip(jax.random.split(key, N_STEPS), rollout.raw_action, strict=True):
        state, stack, seen = step(params, state, stack, key_now, raw)
        steps.append(seen)
    return {"after": after, "rollout": rollout, "finished": finished, "terms": terms, "steps": steps, "drive": drive}


def test_rebuilt_stacks_equal_those_the_policy_acted_upon(driven):
    rollout = driven["rollout"]
    rebuilt = rebuild_stacks(driven["drive"].stack, rollout.observation, rollout.age)
    np.testing.assert_allclose(rebuilt, [step["stack"] for step in driven["steps"]], atol=1e-5)


def test_a_truncated_episode_is_valued_at_its_final_observation_and_no_other_is(driven):
    rollout = driven["rollout"]
    at_the_clock = np.arange(1, N_STEPS + 1) % HORIZON == 0
    np.testing.assert_array_equal(rollout.truncated, np.repeat(at_the_clock[:, None], N_ENVS, axis=1))
    assert not np.any(rollout.terminated)
    wanted = np.where(rollout.truncated, [step["value"] for step in driven["steps"]], 0.0)
    np.testing.assert_allclose(rollout.final_value, wanted, atol=1e-4)
    assert np.abs(wanted[at_the_clock]).min() > 0.0


def test_finished_episodes_carry_their_length_and_their_whole_return(driven):
    finished, reward = driven["finished"], np.array([step["reward"] for step in driven["steps"]])
    np.testing.assert_array_equal(np.asarray(finished.length)[np.asarray(finished.done)], HORIZON)
    np.testing.assert_allclose(finished.episode_return[4], reward[:5].sum(axis=0), rtol=1e-4)
    np.testing.assert_allclose(finished.episode_return[9], reward[5:10].sum(axis=0), rtol=1e-4)
    coverage = np.array([step["coverage"] for step in driven["steps"]])
    np.testing.assert_allclose(finished.coverage, coverage, atol=1e-6)


def test_reward_terms_are_logged_by_name_and_add_up_to_the_reward(driven):
    assert {"reward_coverage", "reward_lateral", "reward_jerk", "reward_terminal"} == set(driven["terms"])
    np.testing.assert_allclose(sum(driven["terms"].values()), np.mean(driven["rollout"].reward), rtol=1e-4)


def test_the_next_unroll_goes_on_where_this_one_ended(driven):
    np.testing.assert_array_equal(driven["after"].age, N_STEPS % HORIZON)
    np.testing.assert_array_equal(driven["after"].env_state.steps, N_STEPS % HORIZON)


def test_the_value_target_of_a_truncated_step_goes_on_with_its_final_observation(tunnel):
    env, params = st.make("Subterra/TraverseShort-v1", tunnel=tunnel, horizon=HORIZON)
    config = PPOConfig(n_envs=4, unroll=12, minibatches=2, hidden=(8,), frames=N_FRAMES)
    learner = Learner(env, params, config)
    state = learner.init(jax.random.PRNGKey(0), params)
    weights, key = state.student.weights, jax.random.PRNGKey(1)
    after, rollout, _, _ = collect(
        learner.env, params, learner.networks, weights, state.statistics, state.drive, key, config.unroll
    )
    scale = jnp.float32(2.0)
    target = np.asarray(learner._lesson(state, rollout, after, scale).target)
    cut = np.asarray(rollout.truncated)
    wanted = np.asarray(rollout.reward / scale + config.discount * rollout.final_value)
    assert cut.sum() == 8
    assert np.abs(np.asarray(rollout.final_value)[cut]).min() > 1e-3
    np.testing.assert_allclose(target[cut], wanted[cut], atol=1e-5)
