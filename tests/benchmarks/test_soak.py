"""The soak notices what it is there for, and the tasks pass it."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from benchmarks import soak


def test_actions_are_inside_outside_and_extreme():
    low, high = np.float32([0.0, -1.5]), np.float32([2.0, 1.5])
    actions = np.asarray(soak.wild_actions(jax.random.key(0), 4096, low, high))
    assert np.isnan(actions).any()
    assert np.isposinf(actions).any()
    assert np.isneginf(actions).any()
    inside = ((actions >= low) & (actions <= high)).all(axis=1)
    assert 0.2 < inside.mean() < 0.7
    assert inside[::8].all()
    assert (np.abs(actions[np.isfinite(actions)]) > 2.0).any()


def test_violations_are_counted_by_name():
    low, high = np.float32([0.0, -np.inf]), np.float32([30.0, np.inf])
    state = {"good": jnp.zeros(3), "bad": jnp.array([0.0, jnp.nan]), "steps": jnp.zeros(3, jnp.int32)}
    obs = jnp.array([[0.0, 1e9], [31.0, 0.0], [jnp.nan, jnp.inf]])
    found = {k: int(v) for k, v in soak._violations(state, obs, jnp.array([0.0, jnp.inf]), low, high).items() if v}
    assert found == {
        "state['bad'] not finite": 1,
        "observation outside its space": 2,
        "observation not finite": 2,
        "reward not finite": 1,
    }


@pytest.mark.slow
def test_random_and_extreme_actions_leave_nothing_outside_of_its_space():
    # Faults have the most parts; the other tasks and ten million steps are for the command.
    env, params = st.make("Subterra/Faulted-v1", estimates=True)
    assert soak.soak(env, params, 300, 60_000, seed=0) == {}


@pytest.mark.slow
@pytest.mark.parametrize("task", st.TASKS)
def test_every_task_is_clean_under_checkify(task):
    env, params = st.make(task, estimates=True)
    assert soak.first_complaint(env, params, seed=0) is None
    assert soak.soak(env, params, 1000, 200_000, seed=1) == {}


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--steps", "0"), "error: steps must be at least 1, got 0"),
        (("--tasks", "Fly"), "error: no task 'Fly'"),
        (("--tunnel", "no.npz"), "error: no.npz: no such tunnel file"),
    ],
)
def test_a_soak_that_cannot_be_run_is_one_sentence_and_status_2(monkeypatch, capsys, arguments, sentence):
    monkeypatch.setattr(sys, "argv", ["soak", *arguments])
    assert soak.main() == 2
    assert capsys.readouterr().err.startswith(sentence)
