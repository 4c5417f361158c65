"""An environment can be copied, and works in processes of its own unless they are forked."""

import copy
import os
import subprocess
import sys

import gymnasium
import jax
import numpy as np
import pytest

from subterra_jax.adapters import task as adapters_task
from subterra_jax.adapters.single import SubterraEnv
from subterra_jax.adapters.task import ForkError
from subterra_jax.adapters.vector import SubterraVectorEnv

pytestmark = pytest.mark.door

TASK, HORIZON = "Subterra/TraverseShort-v1", 12
CACHE = {"JAX_COMPILATION_CACHE_DIR": kept} if (kept := jax.config.jax_compilation_cache_dir) else {}


def drive(env, n_steps=20):
    """Observations, rewards and flags over the end of an episode and into the next."""
    rows = []
    for k in range(n_steps):
        obs, reward, terminated, truncated, _ = env.step(np.array([1.5, 0.4 * np.sin(k)], np.float32))
        rows.append([*obs, reward, terminated, truncated])
        if terminated or truncated:
            rows.append([*env.reset()[0], 0.0, 0.0, 0.0])
    return np.array(rows)


def test_a_copy_goes_on_with_the_same_bits_and_leaves_the_original_alone():
    env = gymnasium.make(f"subterra_jax:{TASK}", horizon=HORIZON)  # in Gymnasium's own wrappers
    env.reset(seed=4)
    env.step(np.array([1.0, 0.0], np.float32))
    twin = copy.deepcopy(env)
    assert twin.unwrapped.task is env.unwrapped.task, "a copy compiles nothing"
    ahead = drive(twin)
    np.testing.assert_array_equal(drive(env), ahead)


def test_a_forked_process_is_told_what_to_do_instead(monkeypatch):
    """As in a fork: the process that used JAX first was another one."""
    monkeypatch.setattr(adapters_task, "_first_process", os.getpid() + 1)
    for use in (lambda: SubterraEnv(TASK), lambda: SubterraVectorEnv(2, task=TASK)):
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
