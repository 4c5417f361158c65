import jax.numpy as jnp
import numpy as np
import pytest

from train.feedforward import rollout


def online(rng, n_frames, n_steps, n_envs, p_done=0.25):
    """Stacks kept step by step, with what a rollout would store of them."""
    observation = jnp.asarray(rng.standard_normal((n_steps + 1, n_envs, 3)), jnp.float32)
    done = rng.random((n_steps, n_envs)) < p_done
    stack, age = rollout.start_stack(observation[0], n_frames), np.zeros(n_envs, np.int32)
    stacks, ages = [], []
    for t in range(n_steps):
        stacks.append(stack)
        ages.append(age)
        stack = rollout.push_frame(stack, observation[t + 1], jnp.asarray(done[t]))
        age = np.where(done[t], 0, age + 1).astype(np.int32)
    return jnp.stack(stacks), observation[:-1], jnp.asarray(np.stack(ages))


@pytest.mark.parametrize("n_frames", [1, 2, 4])
def test_rebuilt_stacks_equal_those_kept_online(n_frames):
    for seed in range(3):
        stacks, observation, age = online(np.random.default_rng(seed), n_frames, 30, 5)
        np.testing.assert_array_equal(rollout.rebuild_stacks(stacks[0], observation, age), stacks)


def test_a_rollout_that_begins_within_an_episode_rebuilds_the_same_stacks():
    stacks, observation, age = online(np.random.default_rng(3), 4, 30, 5)
    for begin in (1, 2, 3, 17):
        rebuilt = rollout.rebuild_stacks(stacks[begin], observation[begin:], age[begin:])
        np.testing.assert_array_equal(rebuilt, stacks[begin:])


def test_no_stack_reaches_back_across_the_beginning_of_its_episode():
    stacks, observation, age = online(np.random.default_rng(4), 4, 40, 6)
    rebuilt = np.asarray(rollout.rebuild_stacks(stacks[0], observation, age))
    for t in range(4, 40):
        for env in range(6):
            episode = np.asarray(observation[t - min(int(age[t, env]), t) : t + 1, env])
            for frame in rebuilt[t, env]:
                assert (frame == episode).all(axis=1).any()


def test_the_first_observation_of_an_episode_fills_its_stack():
    stack = rollout.push_frame(jnp.zeros((1, 4, 2)), jnp.ones((1, 2)), jnp.array([True]))
    np.testing.assert_array_equal(stack, jnp.ones((1, 4, 2)))


def test_the_newest_observation_is_the_last_frame():
    stack = rollout.push_frame(jnp.zeros((1, 3, 2)), jnp.ones((1, 2)), jnp.array([False]))
    np.testing.assert_array_equal(stack[0], [[0, 0], [0, 0], [1, 1]])
