"""The goal-conditioned T1: nothing leaks, rewards can be judged for another goal, and hindsight replay runs on it."""

import warnings

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3.common.env_checker import check_env

import subterra_jax as st
from subterra_jax.adapters.goal import GoalConditioned, GoalError
from subterra_jax.rules import GoalParams

pytestmark = pytest.mark.door

TASK = "Subterra/StopAtShort-v1"
WORLD = {
    "tunnel": st.load_tunnel("subterra-351").slice(0.0, 65.0),
    "goal": GoalParams(low=10.0, high=50.0, margin=5.0, tolerance=0.25),
}


@pytest.fixture(scope="module")
def env():
    return GoalConditioned(gymnasium.make(f"subterra_jax:{TASK}", flat=True, horizon=40, **WORLD))


def test_sb3s_checker_has_nothing_to_say_and_the_spaces_hold(env):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env)
    advice = ("normalize", "symmetric", "not within")
    assert [str(w.message) for w in caught if not any(word in str(w.message) for word in advice)] == []
    obs, _ = env.reset(seed=0)
    assert obs in env.observation_space


def test_the_observation_has_neither_the_goal_nor_the_truth(env):
    """Another goal alone leaves the observation as it is; what is achieved is counted from the start that is told."""
    near, _ = env.reset(seed=1, options={"goal": 12.0})
    far, _ = env.reset(seed=1, options={"goal": 50.0})
    np.testing.assert_array_equal(near["observation"], far["observation"])
    assert (near["desired_goal"], far["desired_goal"]) == (12.0, 50.0)
    assert near["observation"].shape == (20,)
    moved, _ = env.reset(seed=1, options={"start": 7.0})
    assert moved["achieved_goal"] == pytest.approx(7.0)
    for _ in range(20):
        obs, *_, info = env.step(np.array([2.0, 0.0], np.float32))
    assert obs["achieved_goal"] == pytest.approx(info["station"], abs=0.5)
    assert obs["achieved_goal"] != info["station"]


def test_a_reward_is_what_the_step_gave_and_what_another_goal_would_have_given(env):
    env.reset(seed=2, options={"goal": 12.0, "start": {"station": 12.1, "lateral": 0.0}})
    for k in range(10):
        obs, reward, terminated, _, info = env.step(np.zeros(2, np.float32))
        assert reward == env.compute_reward(obs["achieved_goal"], obs["desired_goal"], info) == float(k == 9)
    assert terminated
    assert info["success"]
    assert info["task_reward"] > 4.0
    goals, infos = np.array([[12.3], [12.4], [11.9], [11.8]]), [info] * 4
    np.testing.assert_array_equal(env.compute_reward(np.zeros((4, 1)), goals, infos), [1.0, 0.0, 1.0, 0.0])


def test_named_parts_give_the_same_as_the_bare_vector(env):
    named = GoalConditioned(gymnasium.make(f"subterra_jax:{TASK}", horizon=40, **WORLD))
    for key, values in named.reset(seed=3)[0].items():
        np.testing.assert_array_equal(values, env.reset(seed=3)[0][key])


@pytest.mark.parametrize("task", ["TraverseShort", "Return", "Relocalise"])
def test_a_task_that_does_not_stop_at_a_goal_is_refused(task):
    class Bare(gymnasium.Env):
        """An environment of which nothing is compiled."""

        spec = gymnasium.spec(f"Subterra/{task}-v1")
        task_env, task_params = st.make(spec.id, tunnel="control")

    with pytest.raises(GoalError, match=f"Subterra/{task}-v1 does not ask for a stop at a goal"):
        GoalConditioned(Bare())


def test_without_the_truth_no_reward_is_made_up(env):
    with pytest.raises(GoalError, match="copy_info_dict=True"):
        env.compute_reward(np.zeros((2, 1)), np.zeros((2, 1)), [{}, {}])


@pytest.mark.slow
def test_hindsight_replay_runs_on_it(env):
    from stable_baselines3 import SAC, HerReplayBuffer

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        replay = {"n_sampled_goal": 4, "goal_selection_strategy": "future", "copy_info_dict": True}
        model = SAC(
            "MultiInputPolicy",
            env,
            replay_buffer_class=HerReplayBuffer,
            replay_buffer_kwargs=replay,
            learning_starts=90,
            batch_size=64,
            seed=0,
            device="cpu",
        )
        model.learn(110)
    finally:
        torch.set_num_threads(before)
    batch = model.replay_buffer.sample(256)
    goals = batch.observations["desired_goal"][:, 0]
    assert len(torch.unique(goals)) > 10, "goals were to be exchanged"
    assert np.isfinite(batch.rewards).all()
