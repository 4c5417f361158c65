"""Trainers of other libraries: the watch that times them, the command, and each of them on a task of a few metres."""

import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from subterra_jax.evaluation import harness
from subterra_jax.evaluation.episodes import listed_seeds
from train.others import __main__ as others
from train.others import watch as watches
from train.others.watch import Act, OnHost, Watch

pytestmark = pytest.mark.door

TASK = "Subterra/TraverseShort-v1"
FEW_METRES = {"horizon": 30, "goal_coverage": 0.06}  # 3.6 m in 3 s; one who stands or circles does not get there


@pytest.fixture(autouse=True)
def few_episodes(monkeypatch):
    """Ten fresh episodes of thirty steps in place of a hundred of two hundred."""
    monkeypatch.setattr(watches, "N_FRESH", 10)
    monkeypatch.setattr(harness, "_CHUNK", FEW_METRES["horizon"])


def ahead(weights, obs):
    return weights * jnp.array([2.0, 0.0]) + 0.0 * obs[:2]


@pytest.fixture(scope="module")
def watch():
    return Watch(TASK, **FEW_METRES)


@pytest.fixture
def fresh(watch):
    watch.scores.clear()
    watch.every = 0
    return watch


def test_the_watch_stops_at_the_goal_and_keeps_the_first_score_there(fresh):
    assert not fresh(100, Act(ahead, jnp.float32(0.2)))
    assert fresh.reached is None
    assert fresh(200, Act(ahead, jnp.float32(1.0)))
    assert fresh(300, Act(ahead, jnp.float32(0.0)))
    assert [(score.steps, score.success) for score in fresh.scores] == [(100, 0.0), (200, 1.0)]
    assert fresh.reached.steps == 200


def test_a_score_costs_the_trainer_no_time(fresh, monkeypatch):
    now = [0.0]

    def slow(*arguments):
        now[0] += 1000.0
        return scored(*arguments)

    scored = watches.evaluate
    monkeypatch.setattr(watches, "evaluate", slow)
    monkeypatch.setattr(watches.time, "perf_counter", lambda: now[0])
    fresh._began, fresh._scoring = 0.0, 0.0
    for step in (1, 2, 3):
        now[0] += 5.0
        fresh(step, Act(ahead, jnp.float32(0.0)))
    assert [score.seconds for score in fresh.scores] == [5.0, 10.0, 15.0]


def test_it_does_not_score_more_often_than_it_is_told_to(fresh):
    fresh.every = 100
    for steps in (50, 120, 150, 260):
        fresh(steps, Act(ahead, jnp.float32(0.0)))
    assert [score.steps for score in fresh.scores] == [50, 150, 260]


def test_scores_come_from_other_episodes_than_the_listed(fresh):
    seeds = range(watches.FIRST_FRESH, watches.FIRST_FRESH + watches.N_FRESH)
    assert not set(seeds) & set(listed_seeds(TASK).tolist())
    fresh(1, Act(ahead, jnp.float32(1.0)))
    listed = fresh.listed(3)
    assert (listed["episodes"], listed["success"]) == (3, 1.0)


def test_a_function_on_the_host_drives_as_the_same_function_in_jax(fresh):
    seen = []

    def act(obs):
        seen.append(obs.shape)
        return np.tile(np.float32([2.0, 0.0]), (len(obs), 1))

    assert fresh(1, Act(OnHost(act)))
    assert set(seen) == {(watches.N_FRESH, 18)}
    single = jax.jit(OnHost(lambda obs: obs[:, :2]))(None, jnp.arange(18.0))
    np.testing.assert_array_equal(single, [0.0, 1.0])


def learns(name, steps, **options):
    """Return whether a trainer reaches the goal within a number of steps."""
    watch = Watch(TASK, **options)
    others.importlib.import_module(f"train.others.{name}").train(watch, steps, seed=0)
    assert all(a.steps < b.steps for a, b in zip(watch.scores, watch.scores[1:], strict=False))
    assert 0 < watch.scores[-1].steps <= steps
    return watch.reached is not None


@pytest.mark.slow
def test_a_loop_like_cleanrls_learns_to_drive_a_few_metres():
    pytest.importorskip("torch")
    assert learns("cleanrl_like", 10 * 8192, **FEW_METRES)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("name", "library"),
    [
        ("ours", "jax"),
        ("brax_ppo", "brax"),
        ("sb3_ppo", "stable_baselines3"),
        ("purejaxrl_like", "flax"),
        ("rejax_ppo", "rejax"),
    ],
)
def test_every_trainer_learns_the_short_task(name, library):
    pytest.importorskip(library)
    assert learns(name, 12 * 16384)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_command_trains_the_short_task_and_writes_what_it_saw(tmp_path, monkeypatch, capsys):
    monkeypatch.undo()
    out = tmp_path / "out.json"
    monkeypatch.setattr(sys, "argv", ["others", "purejaxrl_like", "--out", str(out), "--steps", "400000"])
    with pytest.raises(SystemExit) as ended:
        others.main()
    assert ended.value.code == 0
    content = json.loads(out.read_text())
    assert content["reached"]["success"] >= 0.9
    assert content["reached"] == content["scores"][-1]
    assert content["listed"]["episodes"] == 500
    assert content["listed"]["success"] > 0.8
    assert "90 % after" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["sb4_ppo"], "sb4_ppo"),
        (["rejax_ppo"], "rejax_ppo needs rejax, which is not installed; the head of train/others/rejax_ppo.py"),
        (["ours", "--task", "Subterra/Nowhere-v1"], "no task 'Subterra/Nowhere-v1'"),
        (["ours", "--steps", "0"], "steps must be at least 1"),
    ],
)
def test_a_mistake_is_one_sentence_and_status_2(tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.setitem(sys.modules, "rejax", None)
    monkeypatch.setattr(sys, "argv", ["others", *words, "--out", str(tmp_path / "out.json")])
    with pytest.raises(SystemExit) as ended:
        others.main()
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out.json").exists()
