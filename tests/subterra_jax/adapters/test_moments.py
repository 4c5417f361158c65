"""An environment can be put back, copied, pickled and sent to another process, and goes on with the same bits."""

import copy
import os
import pickle
import subprocess
import sys

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium import error

from subterra_jax.adapters import task as adapters_task
from subterra_jax.adapters.sb3 import SubterraVecEnv
from subterra_jax.adapters.single import SubterraEnv
from subterra_jax.adapters.task import ForkError, MomentError
from subterra_jax.adapters.vector import SubterraVectorEnv
from tests.subterra_jax.adapters.test_vector import ACTIONS

pytestmark = pytest.mark.door

TASK, HORIZON = "Subterra/TraverseShort-v1", 12
WAYS = pytest.mark.parametrize(
    "way", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["deepcopy", "pickle"]
)
CACHE = {"JAX_COMPILATION_CACHE_DIR": str(jax.config.jax_compilation_cache_dir)}


@pytest.fixture(scope="module")
def made():
    return SubterraEnv(TASK, horizon=HORIZON)


@pytest.fixture
def env(made):
    return copy.copy(made)


@pytest.fixture(scope="module")
def envs():
    return SubterraVectorEnv(3, task=TASK, horizon=HORIZON)


def drive(env, n_steps=20):
    """Observations, rewards and flags over the end of an episode and into the next."""
    rows = []
    for k in range(n_steps):
        obs, reward, terminated, truncated, _ = env.step(np.array([1.5, 0.4 * np.sin(k)], np.float32))
        rows.append([*obs, reward, terminated, truncated])
        if terminated or truncated:
            rows.append([*env.reset()[0], 0.0, 0.0, 0.0])
    return np.array(rows)


def drive_all(envs, n_steps=20):
    return np.stack([np.concatenate([*map(np.ravel, envs.step(ACTIONS)[:4])]) for _ in range(n_steps)])


def test_after_going_back_it_continues_to_the_same_bits(env):
    first, _ = env.reset(seed=2)
    drive(env, 3)
    moment = env.get_state()
    here = env.step(np.array([1.0, 0.0], np.float32))[0].copy()
    ahead = drive(env)
    obs = env.set_state(moment)
    assert (obs != first).any()
    np.testing.assert_array_equal(env.step(np.array([1.0, 0.0], np.float32))[0], here)
    np.testing.assert_array_equal(drive(env), ahead)
    assert env.state.steps == copy.copy(env).state.steps


def test_a_batch_goes_back_as_well_in_the_middle_of_a_reset(envs):
    envs.reset(seed=2)
    while not np.logical_or(*envs.step(ACTIONS)[2:4]).any():
        pass
    moment = pickle.loads(pickle.dumps(envs.get_state()))
    ahead = drive_all(envs)
    envs.set_state(moment)
    np.testing.assert_array_equal(drive_all(envs), ahead)


def test_a_moment_of_another_environment_is_refused(env, envs):
    with pytest.raises(error.ResetNeeded, match="get_state"):
        env.get_state()
    env.reset(seed=0)
    envs.reset(seed=0)
    with pytest.raises(MomentError, match=r"Subterra/StopAt-v1 cannot be set in Subterra/TraverseShort-v1"):
        env.set_state(env.get_state()._replace(task="Subterra/StopAt-v1"))
    with pytest.raises(MomentError, match="shape"):
        env.set_state(envs.get_state())
    with pytest.raises(MomentError, match="shape"):
        envs.set_state(env.get_state())
    for one in (env, envs):
        with pytest.raises(MomentError, match="set_state takes what get_state returned, got NoneType"):
            one.set_state(None)


@WAYS
def test_a_copy_goes_on_with_the_same_bits_and_leaves_the_original_alone(way):
    env = gymnasium.make(f"subterra_jax:{TASK}", horizon=HORIZON)  # in Gymnasium's own wrappers
    env.reset(seed=4)
    env.step(np.array([1.0, 0.0], np.float32))
    twin = way(env)
    before = env.unwrapped.get_state()
    ahead = drive(twin)
    np.testing.assert_array_equal(env.unwrapped.get_state().words, before.words)
    np.testing.assert_array_equal(drive(env), ahead)
    assert twin.observation_space == env.observation_space


def test_a_deep_copy_compiles_nothing(made):
    assert copy.deepcopy(made).task is made.task


@WAYS
def test_a_batch_can_be_copied(way, envs):
    envs.reset(seed=4)
    envs.step(ACTIONS)
    twin = way(envs)
    ahead = drive_all(twin)
    np.testing.assert_array_equal(drive_all(envs), ahead)


def test_sb3s_view_of_a_batch_can_be_pickled():
    vec = SubterraVecEnv(3, TASK, horizon=HORIZON)
    vec.seed(1)
    vec.reset()
    twin = pickle.loads(pickle.dumps(vec))
    for _ in range(HORIZON + 2):
        np.testing.assert_array_equal(vec.step(ACTIONS)[0], twin.step(ACTIONS)[0])
    assert twin.get_attr("state", 1)[0].steps == vec.get_attr("state", 1)[0].steps


def test_a_forked_process_is_told_what_to_do_instead(env, monkeypatch):
    """As in a fork: the process that used JAX first was another one."""
    monkeypatch.setattr(adapters_task, "_first_process", os.getpid() + 1)
    for use in (lambda: SubterraEnv(TASK), lambda: SubterraVectorEnv(2, task=TASK), env.reset):
        with pytest.raises(ForkError, match=r"JAX does not survive a fork: .*context='spawn'"):
            use()


ASYNC = f"""
import sys, gymnasium, numpy as np
if __name__ == "__main__":
    envs = gymnasium.make_vec("subterra_jax:{TASK}", num_envs=2, vectorization_mode="async",
                              vector_kwargs={{"context": sys.argv[1]}}, horizon=5)
    first, _ = envs.reset(seed=3)
    for _ in range(7):
        obs, *_ = envs.step(np.tile(np.array([1.0, 0.0], np.float32), (2, 1)))
    envs.close()
    np.savez(sys.argv[2], first=first, obs=obs)
"""


def run_async(tmp_path, context):
    (tmp_path / "run.py").write_text(ASYNC)
    words = [sys.executable, str(tmp_path / "run.py"), context, str(tmp_path / "seen.npz")]
    return subprocess.run(words, capture_output=True, text=True, check=False, timeout=240, env={**os.environ, **CACHE})


@pytest.mark.slow
def test_processes_of_their_own_do_the_same_when_they_are_spawned(tmp_path):
    done = run_async(tmp_path, "spawn")
    assert done.returncode == 0, done.stderr
    seen = np.load(tmp_path / "seen.npz")
    envs = SubterraVectorEnv(2, task=TASK, horizon=5)
    np.testing.assert_allclose(envs.reset(seed=3)[0], seen["first"], atol=1e-3)
    for _ in range(7):
        obs = envs.step(np.tile(np.array([1.0, 0.0], np.float32), (2, 1)))[0]
    np.testing.assert_allclose(obs, seen["obs"], atol=2e-3)


@pytest.mark.slow
def test_forked_ones_end_at_once_with_the_sentence(tmp_path):
    done = run_async(tmp_path, "fork")
    assert done.returncode != 0
    assert "JAX does not survive a fork" in done.stderr
