"""Gymnasium and Stable-Baselines3 get the scan of a LiDAR in three dimensions as an image."""

import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.adapters.kernel import as_observation
from subterra_jax.adapters.single import SubterraEnv
from subterra_jax.adapters.task import Task
from subterra_jax.parts import make_sensor

TASK = "Subterra/TraverseShort-v1"


def world():
    """A straight tunnel and a small image, for quick compiling."""
    xy = np.stack([np.linspace(0.0, 40.0, 41), np.zeros(41)], axis=-1)
    made = make_sensor("spin16x64")
    rays = np.asarray(made.directions).reshape(16, 64, 3)[::4, ::8].reshape(-1, 3)
    sensor = make_sensor(rays, shape=(4, 8))
    return {"tunnel": st.tunnel.from_centreline(xy, 2.8), "sensor": sensor}


def test_spaces_and_observations_have_the_shape_of_the_image():
    task = Task(*st.make(TASK, **world()))
    assert task.observation_space["scan"].shape == (4, 8)
    vector = np.arange(3 * 34, dtype=np.float32).reshape(3, 34)
    seen = as_observation(vector, task.fields)
    assert seen["scan"].shape == (3, 4, 8)
    assert seen["odometry"].shape == (3, 2)
    np.testing.assert_array_equal(seen["scan"][1, 2], vector[1, 16:24])
    assert Task(*st.make(TASK, tunnel=world()["tunnel"])).fields is None


@pytest.mark.slow
def test_one_environment_and_a_batch_give_the_same_images_within_their_space():
    env = SubterraEnv(TASK, **world())
    obs, _ = env.reset(seed=3)
    assert list(obs) == ["scan", "odometry"]
    assert obs["scan"].shape == (4, 8)
    assert env.observation_space["scan"].shape == (4, 8)
    after, *_ = env.step(np.array([1.0, 0.0], np.float32))
    assert env.observation_space.contains(after)
    assert np.ptp(after["scan"]) > 1.0
    sb3 = pytest.importorskip("stable_baselines3")
    from subterra_jax.adapters.sb3 import SubterraVecEnv

    envs = SubterraVecEnv(2, TASK, **world())
    envs.seed(3)
    batch = envs.reset()
    assert batch["scan"].shape == (2, 4, 8)
    np.testing.assert_allclose(batch["scan"][0], obs["scan"], atol=1e-3)
    policy = sb3.PPO("MultiInputPolicy", envs, n_steps=8, batch_size=8, device="cpu")
    action, _ = policy.predict(batch)
    assert action.shape == (2, 2)
