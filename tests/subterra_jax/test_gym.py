"""The Gymnasium adapter: both checkers, seeding, and the same numbers as the environment beneath."""

import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import subterra_jax as st
from subterra_jax.gym import SubterraEnv, register

TASK = "Subterra/TraverseShort-v0"
# Actions are m/s and rad/s, and a dead-reckoned distance has no bounds; the checkers would like it otherwise.
ADVICE = ("symmetric and normalized", "infinity")


@pytest.fixture(scope="module")
def env():
    return gymnasium.make(TASK, render_mode="rgb_array")


@pytest.mark.parametrize("task", sorted(st.TASKS))
def test_both_checkers_have_nothing_to_say(task):
    from stable_baselines3.common.env_checker import check_env as check_env_sb3

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(gymnasium.make(task, render_mode="rgb_array").unwrapped)
        check_env_sb3(gymnasium.make(task).unwrapped)
    said = [str(w.message) for w in caught if issubclass(w.category, UserWarning)]
    assert [text for text in said if not any(advice in text for advice in ADVICE)] == []


def test_registering_again_changes_nothing():
    before = dict(gymnasium.registry)
    register()
    assert gymnasium.registry == before
    assert set(st.TASKS) <= set(gymnasium.registry)


def test_the_same_seed_gives_the_same_episodes_and_another_seed_others(env):
    def episodes(seed):
        first, _ = env.reset(seed=seed)
        steps = [env.step(np.array([1.0, 0.05 * k], np.float32))[0] for k in range(5)]
        return np.stack([first, *steps, env.reset()[0]])

    np.testing.assert_array_equal(episodes(3), episodes(3))
    assert (episodes(3) != episodes(4)).any(axis=1).all()
    a = episodes(3)
    assert (a[0] != a[-1]).any()


def test_observations_are_not_overwritten_by_later_steps(env):
    first, _ = env.reset(seed=0)
    kept = first.copy()
    second = env.step(np.array([2.0, 0.0], np.float32))[0]
    held = second.copy()
    env.step(np.array([2.0, 0.1], np.float32))
    np.testing.assert_array_equal(first, kept)
    np.testing.assert_array_equal(second, held)


def test_an_episode_runs_to_its_end_and_info_is_plain_python():
    env = SubterraEnv(TASK, horizon=30)
    env.reset(seed=0)
    for k in range(30):
        obs, reward, terminated, truncated, info = env.step(np.array([1.0, 0.0]))
        assert isinstance(reward, float)
        assert not terminated
        assert truncated == (k == 29)
    assert isinstance(info["success"], bool)
    assert isinstance(info["coverage"], float)
    assert info["station"] == pytest.approx(3.0, abs=0.05)
    assert reward == pytest.approx(sum(value for name, value in info.items() if name.startswith("reward_")), abs=1e-5)
    assert obs.dtype == np.float32


def test_an_action_that_is_not_a_number_is_safe():
    env = SubterraEnv(TASK)
    env.reset(seed=0)
    obs, reward, *_ = env.step(np.array([np.nan, np.inf]))
    assert np.isfinite(obs).all()
    assert np.isfinite(reward)


def test_the_picture_shows_walls_beams_and_robot(env):
    env.reset(seed=0)
    for _ in range(100):
        env.step(np.array([2.0, 0.0], np.float32))
    picture = env.render()
    assert picture.shape == (480, 480, 3)
    assert picture.dtype == np.uint8
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) == 4
    assert SubterraEnv(TASK).render() is None
    with pytest.raises(ValueError, match="'human'"):
        SubterraEnv(TASK, render_mode="human")


def test_importing_the_simulator_needs_no_heavy_library():
    code = "import sys, subterra_jax; print([m for m in sys.argv[1:] if m in sys.modules])"
    # Not rich, which flax brings along.
    heavy = ("mujoco", "brax", "stable_baselines3", "torch", "tyro", "scene", "train", "benchmarks")
    done = subprocess.run([sys.executable, "-c", code, *heavy], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
