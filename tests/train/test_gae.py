import jax.numpy as jnp
import numpy as np

from train import learning


def slow_advantages(reward, value, last_value, final_value, terminated, truncated, discount, gae_lambda):
    """Straight from the definition: the discounted sum of one-step errors up to the end of the episode."""
    n_steps, n_envs = reward.shape
    result = np.zeros((n_steps, n_envs))
    for env in range(n_envs):
        for begin in range(n_steps):
            weight = 1.0
            for t in range(begin, n_steps):
                if terminated[t, env]:
                    following = 0.0
                elif truncated[t, env]:
                    following = final_value[t, env]
                else:
                    following = value[t + 1, env] if t + 1 < n_steps else last_value[env]
                result[begin, env] += weight * (reward[t, env] + discount * following - value[t, env])
                weight *= discount * gae_lambda
                if terminated[t, env] or truncated[t, env]:
                    break
    return result


def random_rollout(rng, n_steps=40, n_envs=7):
    normal = lambda *shape: rng.standard_normal(shape).astype(np.float32)  # noqa: E731
    terminated, truncated = rng.random((n_steps, n_envs)) < 0.1, rng.random((n_steps, n_envs)) < 0.1
    assert (terminated & truncated).any()
    assert (truncated & ~terminated).any()
    return (
        normal(n_steps, n_envs),
        normal(n_steps, n_envs),
        normal(n_envs),
        normal(n_steps, n_envs),
        terminated,
        truncated,
    )


def test_advantages_equal_the_definition_with_both_ends_of_an_episode():
    for seed in range(3):
        data = random_rollout(np.random.default_rng(seed))
        fast = learning.advantages(*(jnp.asarray(x) for x in data), discount=0.97, gae_lambda=0.9)
        np.testing.assert_allclose(fast, slow_advantages(*data, 0.97, 0.9), rtol=1e-4, atol=1e-5)


def one_env(**changes):
    steps = 4
    data = {
        "reward": jnp.ones((steps, 1)),
        "value": jnp.zeros((steps, 1)),
        "last_value": jnp.array([10.0]),
        "final_value": jnp.full((steps, 1), 5.0),
        "terminated": jnp.zeros((steps, 1), bool),
        "truncated": jnp.zeros((steps, 1), bool),
    }
    return learning.advantages(**{**data, **changes}, discount=0.5, gae_lambda=1.0)[:, 0]


def test_an_unfinished_episode_is_worth_its_rewards_and_the_value_after_them():
    np.testing.assert_allclose(one_env(), [2.5, 3.0, 4.0, 6.0])


def test_a_truncated_episode_is_worth_the_value_of_its_final_observation():
    truncated = jnp.zeros((4, 1), bool).at[1].set(True)
    np.testing.assert_allclose(one_env(truncated=truncated), [1 + 0.5 * 3.5, 1 + 0.5 * 5.0, 4.0, 6.0])


def test_a_terminated_episode_is_worth_nothing_more():
    terminated = jnp.zeros((4, 1), bool).at[1].set(True)
    np.testing.assert_allclose(one_env(terminated=terminated), [1.5, 1.0, 4.0, 6.0])


def test_a_step_that_is_both_counts_as_terminated():
    both = jnp.zeros((4, 1), bool).at[1].set(True)
    np.testing.assert_allclose(one_env(terminated=both, truncated=both), one_env(terminated=both))
