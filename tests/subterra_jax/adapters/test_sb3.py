"""Stable-Baselines3 trains on the adapter, and its own wrappers and conventions hold."""

import copy

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from subterra_jax.adapters.sb3 import SubterraVecEnv
from subterra_jax.adapters.single import SubterraEnv

TASK, HORIZON = "Subterra/TraverseShort-v1", 24
ACTIONS = np.array([[1.0, 0.0], [2.0, 1.5]], np.float32)


@pytest.fixture(scope="module")
def envs():
    return SubterraVecEnv(2, TASK, horizon=HORIZON, render_mode="rgb_array")


def test_it_does_what_sb3s_own_gathering_of_single_environments_does(envs):
    one = SubterraEnv(TASK, horizon=HORIZON)
    theirs = DummyVecEnv([lambda: copy.copy(one)] * 2)
    for vec in (envs, theirs):
        vec.seed(3)
    np.testing.assert_allclose(envs.reset(), theirs.reset(), atol=1e-3)
    endings = set()
    for _ in range(50):
        ours, other = envs.step(ACTIONS), theirs.step(ACTIONS)
        np.testing.assert_allclose(ours[0], other[0], atol=2e-3)
        np.testing.assert_allclose(ours[1], other[1], atol=1e-4)
        np.testing.assert_array_equal(ours[2], other[2])
        assert ours[1].dtype == other[1].dtype
        for a, b, done in zip(ours[3], other[3], ours[2], strict=True):
            assert set(a) == set(b)
            assert a["TimeLimit.truncated"] == b["TimeLimit.truncated"]
            if done:
                endings.add(a["TimeLimit.truncated"])
                np.testing.assert_allclose(a["terminal_observation"], b["terminal_observation"], atol=2e-3)
    assert endings == {True, False}


def test_a_seed_is_used_once_and_repeats_the_episodes(envs):
    def first(seed):
        if seed is not None:
            envs.seed(seed)
        return envs.reset()

    a = first(8)
    np.testing.assert_array_equal(a, first(8))
    assert (a != first(None)).any()


def test_attributes_of_the_batch_and_pictures_of_each_environment(envs):
    envs.reset()
    assert envs.get_attr("render_mode") == ["rgb_array"] * 2
    assert not envs.has_attr("wheels")
    envs.set_attr("label", "left")
    assert envs.get_attr("label", 0) == ["left"]
    with pytest.raises(AttributeError, match="no method 'compute_reward'"):
        envs.env_method("compute_reward")
    assert envs.render().shape == (960, 480, 3)
    assert envs.env_is_wrapped(VecMonitor) == [False, False]


def test_ppo_takes_a_few_updates_through_sb3s_wrappers():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        # As many as above, so that nothing is compiled anew.
        monitored = VecNormalize(VecMonitor(SubterraVecEnv(2, TASK, horizon=HORIZON), info_keywords=("success",)))
        model = PPO("MlpPolicy", monitored, n_steps=64, batch_size=64, n_epochs=1, seed=0, device="cpu")
        weights = [w.detach().clone() for w in model.policy.parameters()]
        model.learn(2 * 64 * 2)
    finally:
        torch.set_num_threads(before)
    assert any((w != old).any() for w, old in zip(model.policy.parameters(), weights, strict=True))
    episodes = model.ep_info_buffer
    assert len(episodes) >= 8
    assert max(episode["l"] for episode in episodes) == HORIZON
    assert all(not episode["success"] for episode in episodes)


def test_a_task_with_named_fields_suits_the_policy_for_dicts():
    task = "Subterra/StopAtShort-v1"
    assert set(SubterraVecEnv(2, task).observation_space.keys()) >= {"ranges", "odometry", "goal"}
    assert SubterraVecEnv(2, task, flat=True).observation_space.shape == (21,)
