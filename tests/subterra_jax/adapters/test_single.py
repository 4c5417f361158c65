"""The Gymnasium adapter: both checkers, seeding, and the same numbers as the environment beneath."""

import copy
import importlib
import os
import subprocess
import sys
import warnings

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium import error, spaces
from gymnasium.utils.env_checker import check_env

import subterra_jax as st
from subterra_jax.adapters import register_tasks
from subterra_jax.adapters.kernel import start_streams, take_key
from subterra_jax.adapters.single import SubterraEnv
from subterra_jax.pictures.views import make_view

TASK, FURTHER = "Subterra/TraverseShort-v1", "Subterra/Relocalise-v1"
# Actions are m/s and rad/s, and a dead-reckoned distance has no bounds; the checkers would like it otherwise.
ADVICE = ("symmetric and normalized", "infinity")


@pytest.fixture(scope="module")
def made():
    return {task: gymnasium.make(task, render_mode="rgb_array") for task in (TASK, FURTHER)}


@pytest.fixture
def env(made):
    """An environment that nobody has reset; what is compiled is shared."""
    return copy.copy(made[TASK].unwrapped)


@pytest.mark.parametrize("task", [TASK, FURTHER])
def test_both_checkers_have_nothing_to_say(task, made):
    from stable_baselines3.common.env_checker import check_env as check_env_sb3

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        # The checker would make the environment twice more, to render with each mode.
        check_env(copy.copy(made[task].unwrapped), skip_render_check=True)
        check_env_sb3(copy.copy(made[task].unwrapped))
    said = [str(w.message) for w in caught if issubclass(w.category, UserWarning)]
    assert [text for text in said if not any(advice in text for advice in ADVICE)] == []


def test_a_scene_folder_is_a_tunnel_wherever_one_is_named(tmp_path):
    from tests.subterra_jax.tunnels import straight, tunnel_arrays, write_tunnel

    write_tunnel(tmp_path / "tunnel.npz", tunnel_arrays(straight(40.0)))
    for named in ({"tunnel": str(tmp_path)}, {"scene": tmp_path}):
        assert SubterraEnv(TASK, **named).task_params.tunnel.length == 40.0
        assert st.make(TASK, **named)[1].tunnel.length == 40.0
    with pytest.raises(ValueError, match="either a tunnel or a scene, got both 'metro'"):
        SubterraEnv(TASK, tunnel="metro", scene=tmp_path)


def test_gymnasium_finds_a_task_by_module_and_id_alone_and_nothing_heavy_comes_with_it():
    # Not rich, which flax brings along.
    heavy = ("mujoco", "brax", "gymnax", "stable_baselines3", "torch", "tyro", "scene", "train", "benchmarks")
    heavy += ("scipy.ndimage", "scipy.spatial")  # half a second of the first impression
    code = (
        "import sys, gymnasium; assert 'subterra_jax' not in sys.modules;"
        f"env = gymnasium.make('subterra_jax:{TASK}', render_mode='rgb_array'); env.reset(); env.render();"
        f"print(type(env.unwrapped).__name__, [m for m in {heavy} if m in sys.modules])"
    )
    folder = {"JAX_COMPILATION_CACHE_DIR": kept} if (kept := jax.config.jax_compilation_cache_dir) else {}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env={**os.environ, **folder}
    )
    assert done.stdout.strip() == "SubterraEnv []"


def test_registering_again_changes_nothing():
    before = dict(gymnasium.registry)
    register_tasks()
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


def test_without_a_seed_two_environments_differ(env):
    other = copy.copy(env)
    assert (env.reset()[0] != other.reset()[0]).any()


def test_the_numbers_are_those_of_the_environment_beneath(env):
    """The step compiled as one kernel against the same step compiled in the usual way."""
    inner, params = st.make(TASK)
    reset, step = jax.jit(inner.reset), jax.jit(inner.step)
    key, stream = take_key(start_streams([7], np.random.default_rng())[0])
    expected, state = reset(key, params)
    obs, _ = env.reset(seed=7)
    np.testing.assert_allclose(obs, expected, atol=1e-5)
    for k in range(20):
        action = np.array([1.5, 0.3 * np.sin(k)], np.float32)
        key, stream = take_key(stream)
        expected, state, reward, terminated, truncated, info = step(key, state, action, params)
        obs, got, *flags, outcome = env.step(action)
        np.testing.assert_allclose(obs, expected, atol=1e-3)
        assert got == pytest.approx(float(reward), abs=1e-5)
        assert flags == [bool(terminated), bool(truncated)]
        assert set(outcome) == set(info)
        assert outcome["station"] == pytest.approx(float(info["station"]), abs=1e-4)


def test_observations_are_not_overwritten_by_later_steps(env):
    first, _ = env.reset(seed=0)
    kept = first.copy()
    second = env.step(np.array([2.0, 0.0], np.float32))[0]
    held = second.copy()
    env.step(np.array([2.0, 0.1], np.float32))
    np.testing.assert_array_equal(first, kept)
    np.testing.assert_array_equal(second, held)


def test_misuse_is_told_in_one_sentence(env):
    with pytest.raises(error.ResetNeeded, match="reset"):
        env.step(np.zeros(2))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"\(2,\), got \(3,\)"):
        env.step(np.zeros(3))
    with pytest.raises(ValueError, match="'human'"):
        SubterraEnv(TASK, render_mode="human")
    with pytest.raises(ValueError, match="'side'"):
        SubterraEnv(TASK, view="side")


def test_a_task_that_adds_fields_gives_a_dict_and_the_vector_when_asked(made):
    named, flat = copy.copy(made[FURTHER].unwrapped), SubterraEnv(FURTHER, flat=True)
    assert isinstance(named.observation_space, spaces.Dict)
    assert isinstance(flat.observation_space, spaces.Box)
    parts, vector = named.reset(seed=5)[0], flat.reset(seed=5)[0]
    assert list(parts) == ["ranges", "odometry", "ring_pitch"]
    np.testing.assert_array_equal(np.concatenate(list(parts.values())), vector)
    assert parts in named.observation_space
    assert vector in flat.observation_space


def test_what_an_action_reports_is_scored(made):
    env = copy.copy(made[FURTHER].unwrapped)
    assert env.action_space.shape == (5,)
    env.reset(seed=0)
    info = env.step(np.array([1.0, 0.0, 5.0, 0.0, 1.0]))[-1]
    assert abs(info["estimate_error"]) == pytest.approx(abs(info["station"] - 5.0), abs=1e-3)


def test_the_picture_is_drawn_when_asked_for(env):
    env.reset(seed=0)
    picture = env.render()
    assert (picture.shape, picture.dtype) == ((480, 480, 3), np.uint8)
    env.render_mode = None
    assert env.render() is None


@pytest.mark.parametrize(
    ("adapter", "library", "package"),
    [
        ("sb3", "stable_baselines3.common.vec_env.base_vec_env", "stable-baselines3"),
        ("brax", "brax.envs.base", r"'subterra-jax\[brax\]'"),
    ],
)
def test_a_missing_library_is_named_with_the_command_that_installs_it(adapter, library, package, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(sys.modules, f"subterra_jax.adapters.{adapter}", raising=False)
    with pytest.raises(st.SubterraError, match=f"pip install {package}$") as caught:
        importlib.import_module(f"subterra_jax.adapters.{adapter}")
    assert isinstance(caught.value, ImportError)


def test_a_view_without_mujoco_names_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(st.SubterraError, match=r"pip install mujoco$") as caught:
        make_view("mujoco")
    assert isinstance(caught.value, ImportError)
