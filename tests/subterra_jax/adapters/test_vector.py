"""The batched Gymnasium adapter against Gymnasium's own gathering, in one process and in several."""

import copy
import os
import subprocess
import sys

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium import error
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from subterra_jax.adapters import task as adapters_task
from subterra_jax.adapters.single import SubterraEnv
from subterra_jax.adapters.task import ForkError
from subterra_jax.adapters.vector import SubterraVectorEnv

TASK, HORIZON = "Subterra/Return-v1", 26
WORLD = {"tunnel": "subterra-351"}
# Straight on to the horizon; and round in a circle that touches the wall before it.
ACTIONS = np.array([[1.0, 0.0], [2.0, 0.9], [0.5, -0.1]], np.float32)


def made(mode, **options):
    return gymnasium.make_vec(
        TASK,
        num_envs=3,
        vectorization_mode="vector_entry_point",
        autoreset_mode=mode,
        horizon=HORIZON,
        **WORLD,
        **options,
    )


@pytest.fixture(scope="module")
def singles():
    one = SubterraEnv(TASK, horizon=HORIZON, **WORLD)
    return [copy.copy(one) for _ in range(3)]  # what is compiled is shared; what changes is not


def same(a, b, path="info"):
    """Equal structure, dtypes and flags; numbers equal up to the rounding of another order of compilation."""
    assert type(a) is type(b), path
    if isinstance(a, dict):
        assert set(a) == set(b), path
        for name in a:
            same(a[name], b[name], f"{path}[{name!r}]")
    elif isinstance(a, tuple) or (a is not None and a.dtype.hasobject):
        for one, other in zip(a, b, strict=True):
            same(one, other, f"{path}[i]")
    elif a is not None:
        assert (a.dtype, a.shape) == (b.dtype, b.shape), path
        np.testing.assert_allclose(a, b, atol=2e-3, err_msg=path)


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_every_mode_does_what_gymnasium_does_with_single_environments(mode, singles):
    ours, theirs = made(mode), SyncVectorEnv([lambda env=env: env for env in singles], autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"] == mode
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    same(ours.reset(seed=11), theirs.reset(seed=11))
    ended = np.zeros(3, int)
    for _ in range(60):
        a, b = ours.step(ACTIONS), theirs.step(ACTIONS)
        same(a, b)
        done = a[2] | a[3]
        ended += done
        if mode == AutoresetMode.DISABLED and done.any():
            same(*(envs.reset(options={"reset_mask": done.copy()}) for envs in (ours, theirs)))
    assert (ended >= 2).all()
    assert len(set(ended)) > 1, "the environments were to end at different times"


def test_only_the_chosen_environments_are_reset_and_a_seed_repeats_theirs():
    envs = made(AutoresetMode.DISABLED, flat=True)
    first, _ = envs.reset(seed=[5, 6, 7])
    moved = envs.step(ACTIONS)[0]
    mask = np.array([False, True, False])
    again, _ = envs.reset(seed=[None, 6, None], options={"reset_mask": mask})
    np.testing.assert_array_equal(again[~mask], moved[~mask])
    np.testing.assert_allclose(again[mask], first[mask], atol=2e-4)
    fresh, _ = envs.reset(options={"reset_mask": mask})
    assert (fresh[mask] != first[mask]).any()


def test_without_autoreset_a_finished_environment_must_be_reset():
    envs = made(AutoresetMode.DISABLED)
    with pytest.raises(error.ResetNeeded, match="reset"):
        envs.step(ACTIONS)
    envs.reset(seed=0)
    while not (done := np.logical_or(*envs.step(ACTIONS)[2:4])).any():
        pass
    with pytest.raises(error.ResetNeeded, match=str(np.flatnonzero(done)[0])):
        envs.step(ACTIONS)


def test_what_a_caller_gets_wrong_is_named():
    envs = SubterraVectorEnv(3, task=TASK, horizon=HORIZON, **WORLD)
    with pytest.raises(error.ResetNeeded, match="all environments"):
        envs.reset(options={"reset_mask": np.array([True, False, False])})
    envs.reset(seed=0)
    with pytest.raises(TypeError, match="bool array"):
        envs.reset(options={"reset_mask": [True, False, False]})
    with pytest.raises(ValueError, match=r"\(3,\) and a True"):
        envs.reset(options={"reset_mask": np.zeros(3, np.bool_)})
    with pytest.raises(ValueError, match="no option 'goal' in a reset of a batch"):
        envs.reset(options={"goal": 40.0})
    with pytest.raises(ValueError, match="3 environments, got 2"):
        envs.reset(seed=[1, 2])
    with pytest.raises(ValueError, match=r"\(3, 2\), got \(2, 2\)"):
        envs.step(ACTIONS[:2])
    with pytest.raises(ValueError, match="at least 1"):
        SubterraVectorEnv(0, task=TASK)


pytestmark = pytest.mark.door

SHORT, FEW = "Subterra/TraverseShort-v1", 12
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
    env = gymnasium.make(f"subterra_jax:{SHORT}", horizon=FEW)  # in Gymnasium's own wrappers
    env.reset(seed=4)
    env.step(np.array([1.0, 0.0], np.float32))
    twin = copy.deepcopy(env)
    assert twin.unwrapped.task is env.unwrapped.task, "a copy compiles nothing"
    ahead = drive(twin)
    np.testing.assert_array_equal(drive(env), ahead)


def test_a_forked_process_is_told_what_to_do_instead(monkeypatch):
    """As in a fork: the process that used JAX first was another one."""
    monkeypatch.setattr(adapters_task, "_first_process", os.getpid() + 1)
    for use in (lambda: SubterraEnv(SHORT), lambda: SubterraVectorEnv(2, task=SHORT)):
        with pytest.raises(ForkError, match=r"JAX does not survive a fork: .*context='spawn'"):
            use()


ASYNC = f"""
import sys, gymnasium, numpy as np
if __name__ == "__main__":
    envs = gymnasium.make_vec("subterra_jax:{SHORT}", num_envs=2, vectorization_mode="async",
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
    envs = SubterraVectorEnv(2, task=SHORT, horizon=5)
    np.testing.assert_allclose(envs.reset(seed=3)[0], seen["first"], atol=1e-3)
    for _ in range(7):
        obs = envs.step(np.tile(np.array([1.0, 0.0], np.float32), (2, 1)))[0]
    np.testing.assert_allclose(obs, seen["obs"], atol=2e-3)


@pytest.mark.slow
def test_forked_ones_end_at_once_with_the_sentence(tmp_path):
    done = run_async(tmp_path, "fork")
    assert done.returncode != 0
    assert "JAX does not survive a fork" in done.stderr
