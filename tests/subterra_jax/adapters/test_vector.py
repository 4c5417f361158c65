"""The batched Gymnasium adapter against Gymnasium's own gathering of single environments."""

import copy

import gymnasium
import numpy as np
import pytest
from gymnasium import error
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from subterra_jax.adapters.single import SubterraEnv
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
