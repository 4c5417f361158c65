import jax.numpy as jnp
import numpy as np

from train import learning


def test_running_statistics_equal_those_of_all_the_data_at_once():
    rng = np.random.default_rng(0)
    data = (rng.standard_normal((6, 50, 20, 3)) * [1.0, 5.0, 0.1] + [0.0, 20.0, -3.0]).astype(np.float32)
    statistics = learning.start_statistics((3,))
    for batch in data:
        statistics = learning.update_statistics(statistics, jnp.asarray(batch))
    np.testing.assert_allclose(statistics.mean, data.mean(axis=(0, 1, 2)), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(statistics.std, data.std(axis=(0, 1, 2)), rtol=1e-4)


def test_normalized_observations_have_no_mean_and_unit_variance():
    data = jnp.asarray(np.random.default_rng(1).normal(7.0, 3.0, (1000, 2)), jnp.float32)
    statistics = learning.update_statistics(learning.start_statistics((2,)), data)
    normal = learning.normalize(data, statistics.mean, statistics.std)
    np.testing.assert_allclose(normal.mean(axis=0), 0.0, atol=1e-4)
    np.testing.assert_allclose(normal.std(axis=0), 1.0, rtol=1e-4)


def test_a_reading_that_never_moved_stays_finite_and_clipped():
    statistics = learning.update_statistics(learning.start_statistics((1,)), jnp.zeros((100, 1)))
    assert float(learning.normalize(jnp.array([5.0]), statistics.mean, statistics.std)[0]) == 10.0


def test_discounted_returns_begin_anew_with_every_episode_and_go_on_between_unrolls():
    reward = jnp.ones((4, 1))
    done = jnp.array([[False], [True], [False], [False]])
    after, returns = learning.discounted_returns(jnp.array([4.0]), reward, done, 0.5)
    np.testing.assert_allclose(returns[:, 0], [3.0, 2.5, 1.0, 1.5])
    np.testing.assert_allclose(after, [1.5])
    after, _ = learning.discounted_returns(after, reward[:1], jnp.array([[True]]), 0.5)
    np.testing.assert_allclose(after, [0.0])
