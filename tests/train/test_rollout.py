"""An unroll of the trainer: answers, truncated episodes, rewards; several seeds that train at once."""

import dataclasses
import json

import jax
import numpy as np
import pytest

import subterra_jax as st
from tests.subterra_jax.tunnels import write_corridor
from tests.train.conftest import SMALL, TASK, call, log_without_timing, weights_of
from train import __main__ as navigate
from train import learning, ppo, session
from train.config import ConfigError, TrainConfig
from train.driver import Driver, Policy, Seen
from train.learner import Learner
from train.rollout import begin, collect
from train.setup import make_layout

HORIZON, N_ENVS, N_STEPS = 13, 3, 12
CONFIG = TrainConfig(n_envs=N_ENVS, unroll=N_STEPS, minibatches=1, hidden=(8,), memory="gru", cell=8)


@pytest.fixture(scope="module")
def driven(tunnel):
    """Two unrolls with episodes of thirteen steps, and the same steps taken one by one outside of `collect`."""
    env, params = st.make("Subterra/TraverseShort-v1", tunnel=tunnel, horizon=HORIZON)
    driver = Driver(env, make_layout(env, params, CONFIG))
    weights = weights_of(driver, 0, 0.02)
    policy = Policy(weights)
    drive = jax.jit(lambda p: begin(env, driver, policy, p, jax.random.PRNGKey(1), N_ENVS))(params)
    run = jax.jit(lambda p, d, key: collect(env, driver, policy, p, d, key, N_STEPS))
    middle, first, *_ = run(params, drive, jax.random.PRNGKey(2))
    after, rollout, finished, terms = run(params, middle, jax.random.PRNGKey(3))
    made = {"env": env, "params": params, "driver": driver, "policy": policy, "middle": middle}
    return made | {"first": first, "after": after, "rollout": rollout, "finished": finished, "terms": terms}


def test_the_unrolled_network_answers_as_it_did_step_by_step(driven):
    rollout, driver = driven["rollout"], driven["driver"]
    out = jax.jit(driver.unroll)(driven["policy"].network, rollout.inputs, driven["middle"].memory, rollout.first)
    np.testing.assert_allclose(driver.log_prob(out, rollout.raw), rollout.log_prob, atol=1e-4)
    np.testing.assert_allclose(out.value, rollout.value, atol=1e-4)
    np.testing.assert_array_equal(np.nonzero(rollout.first)[0], 1)  # the episodes that began within this unroll


def test_a_truncated_episode_is_valued_at_its_final_observation_and_no_other_is(driven):
    rollout = driven["rollout"]
    cut = np.asarray(rollout.truncated)
    np.testing.assert_array_equal(np.nonzero(cut)[0], 0)
    assert not np.any(rollout.terminated)
    assert np.all(np.asarray(rollout.final_value)[~cut] == 0.0)
    # The robots go on from where the clock cut them off: so does what they would have seen next.
    env, driver = driven["env"], driven["driver"]

    @jax.jit
    def valued(params, policy, middle, rollout):
        action = driver.action(rollout.raw[0])
        key_steps, key_last = jax.random.split(jax.random.PRNGKey(3))
        key_env = jax.random.split(jax.random.split(key_steps, N_STEPS)[0], 3)[1]
        noise = env.draw_step(key_env, (N_ENVS,), params)
        stepped, *_ = jax.vmap(env.advance, (0, 0, 0, None))(middle.env_state, action, noise, params)
        scan = env.draw_step(key_last, (N_ENVS,), params)
        observation = jax.vmap(env.observe, (0, 0, None))(stepped, scan, params)
        _, memory = driver.answer(policy, rollout.inputs[0], middle.memory)
        kept = driver.take(policy, middle.kept, action, Seen(observation, stepped.tunnel), params)
        return driver.answer(policy, driver.inputs(policy, kept), memory)[0].value

    value = valued(driven["params"], driven["policy"], driven["middle"], rollout)
    np.testing.assert_allclose(np.asarray(rollout.final_value)[0], value, atol=1e-4)
    assert np.abs(value - rollout.value[1]).max() > 1e-3


def test_finished_episodes_carry_their_length_and_their_whole_return(driven):
    finished, rewards = driven["finished"], np.concatenate([driven["first"].reward, driven["rollout"].reward])
    np.testing.assert_array_equal(np.asarray(finished.length)[np.asarray(finished.done)], HORIZON)
    np.testing.assert_allclose(finished.episode_return[0], rewards[:HORIZON].sum(axis=0), rtol=1e-4)


def test_reward_terms_are_logged_by_name_and_add_up_to_the_reward(driven):
    assert {"reward_coverage", "reward_lateral", "reward_jerk", "reward_terminal"} == set(driven["terms"])
    np.testing.assert_allclose(sum(driven["terms"].values()), np.mean(driven["rollout"].reward), rtol=1e-4)


def test_the_next_unroll_goes_on_where_this_one_ended(driven):
    np.testing.assert_array_equal(driven["after"].age, 2 * N_STEPS % HORIZON)
    np.testing.assert_array_equal(driven["after"].env_state.steps, 2 * N_STEPS % HORIZON)


def test_the_value_target_of_a_truncated_step_goes_on_with_its_final_observation(driven):
    learner = Learner(driven["env"], driven["driver"], CONFIG)
    rollout, scale = driven["rollout"], np.float32(2.0)
    batch = learner._batch(driven["policy"], driven["middle"], rollout, driven["after"], scale)
    cut = np.asarray(rollout.truncated)
    expected = np.asarray(rollout.reward / scale + CONFIG.discount * rollout.final_value)
    assert cut.sum() == N_ENVS
    assert np.abs(np.asarray(rollout.final_value)[cut]).min() > 1e-3
    np.testing.assert_allclose(np.asarray(batch.target)[cut], expected[cut], atol=1e-5)


def test_the_loss_is_the_weighted_sum_of_its_parts(driven, monkeypatch):
    learner = Learner(driven["env"], driven["driver"], CONFIG)
    rollout = dataclasses.replace(driven["rollout"], error=np.ones((N_STEPS, N_ENVS, 1), np.float32))
    batch = learner._batch(driven["policy"], driven["middle"], rollout, driven["after"], np.float32(2.0))
    monkeypatch.setattr(learning, "auxiliary_loss", lambda estimate, error: 7.0)
    total, parts = learner._loss(driven["policy"].network, batch)
    expected = parts["policy_loss"] + CONFIG.value_weight * parts["value_loss"] + 7.0 * CONFIG.auxiliary_weight
    assert float(total) == pytest.approx(float(expected - CONFIG.entropy_weight * parts["entropy"]), rel=1e-5)


class Filling(Driver):
    """Keeps statistics of its inputs, as that of the walking robot does."""

    def start_statistics(self):
        return learning.start_statistics((self.layout.shape.n_inputs,))


def test_the_first_iteration_fills_the_statistics_and_only_the_second_learns(driven):
    driver = Filling(driven["env"], driven["driver"].layout)
    learner = Learner(driven["env"], driver, dataclasses.replace(CONFIG, steps=10 * N_ENVS * N_STEPS))
    states = [jax.jit(learner.init)(jax.random.key(0), driven["params"])]
    iterate = jax.jit(learner.iterate)
    for _ in range(2):
        states.append(iterate(states[-1], driven["params"])[0])
    weights = [state.student.weights for state in states]
    same = [jax.tree.leaves(jax.tree.map(np.array_equal, weights[0], later)) for later in weights[1:]]
    assert all(same[0])
    assert not all(same[1])


def test_a_robot_is_told_the_length_of_its_own_tunnel_of_a_stack(tmp_path):
    lengths = np.array([20.0, 30.0])
    plans = [write_corridor(tmp_path / f"{length}.npz", length=length) for length in lengths]
    env, params = st.make("Subterra/Traverse-v1", tunnel=plans, horizon=HORIZON)
    driver = Driver(env, make_layout(env, params, CONFIG))
    policy = Policy(weights_of(driver, 0))

    @jax.jit
    def two_steps(params):
        drive = begin(env, driver, policy, params, jax.random.PRNGKey(1), 8)
        collect(env, driver, policy, params, drive, jax.random.PRNGKey(2), 2)
        return drive

    drive = two_steps(params)
    assert set(np.asarray(drive.env_state.tunnel)) == {0, 1}
    way = jax.vmap(driver.layout.reckoned_way)(drive.kept.seen)
    np.testing.assert_allclose(way, lengths[drive.env_state.tunnel], atol=1e-3)


SEEDED = TrainConfig(steps=3 * 256, n_envs=16, unroll=16, minibatches=2, epochs=2, hidden=(8,), stop_coverage=2.0)


def learners(env, params):
    driver = Driver(env, make_layout(env, params, SEEDED))
    return [Learner(env, driver, dataclasses.replace(SEEDED, seed=seed)) for seed in (0, 1)]


@pytest.fixture(scope="module")
def world(tunnel):
    """Episodes so short that truncation happens in every unroll."""
    return st.make(TASK, tunnel=tunnel, horizon=20)


@pytest.fixture(scope="module")
def alone(world):
    return [ppo.train(learner, world[1]) for learner in learners(*world)]


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["cpu", "gpu"], ids=["one after the other", "vmapped"])
def test_a_seed_trained_with_others_comes_to_the_numbers_it_comes_to_alone(world, alone, backend, monkeypatch):
    monkeypatch.setattr(ppo, "compiler_options", lambda config: None)
    monkeypatch.setattr(ppo.jax, "default_backend", lambda: backend)
    together = ppo.train_seeds(learners(*world), world[1], [None, None])
    for one, other in zip(alone, together, strict=True):
        assert one.iteration == other.iteration == 3
        np.testing.assert_array_equal(one.window.last["step"], other.window.last["step"])
        np.testing.assert_allclose(one.window.last["coverage"], other.window.last["coverage"], rtol=1e-3)
        for name, value in one.record.items():
            if name != "timing":
                assert value == pytest.approx(other.record[name], rel=2e-3, abs=2e-4), name
        for a, b in zip(*map(jax.tree.leaves, (one.state.student.weights, other.state.student.weights)), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4)
    assert alone[0].record["policy_loss"] != pytest.approx(alone[1].record["policy_loss"], rel=1e-3)


def test_a_seed_that_is_done_stands_still_while_others_go_on(world):
    both, seen = learners(*world), []
    both[0].config = dataclasses.replace(both[0].config, steps=256)
    first, second = ppo.train_seeds(both, world[1], [None, None], lambda k, now: seen.append((k, now.iteration)))
    assert seen == [(0, 1), (1, 1), (1, 2), (1, 3)]
    assert (first.iteration, int(first.state.iteration), second.iteration) == (1, 1, 3)


def test_seeds_below_zero_or_named_twice_are_refused():
    for wrong in ((0, -1), (3, 3)):
        with pytest.raises(ConfigError, match=r"negative, got -1|named 2 times"):
            session.check_seeds(wrong)


@pytest.fixture(scope="module")
def several(tunnel, tmp_path_factory):
    """Runs the command; returns its status and folder."""

    def run(*arguments, out=None):
        out = out or tmp_path_factory.mktemp("seeds") / "runs"
        common = ("--task", TASK, "--tunnel", str(tunnel), "--preset", "cpu", "--evaluation-episodes", "10")
        more = ("--seeds", "0", "1", "--stop-coverage=2", "--checkpoint-every=1")
        return call(navigate.main, *common, *SMALL, *more, "--out", str(out), *arguments), out

    return run


@pytest.mark.slow
def test_the_command_writes_a_run_for_each_seed_and_goes_on_where_they_last_stood_together(several, capsys):
    status, whole = several("--steps=16384")
    assert status == 0
    assert "± sd" in capsys.readouterr().out
    status, out = several("--steps=8192")
    assert status == 0
    # As if killed between two checkpoints: seed 1 has one less than seed 0.
    (last,) = [p for p in (out / "seed-1" / "checkpoint").iterdir() if p.name == "00000002"]
    for path in sorted(last.rglob("*"), reverse=True):
        path.unlink() if path.is_file() else path.rmdir()
    last.rmdir()
    status, _ = several("--steps=16384", "--resume", out=out)
    assert status == 0
    for name in ("seed-0", "seed-1"):
        assert log_without_timing(out / name) == log_without_timing(whole / name)
        assert (out / name / "episodes.csv").read_bytes() == (whole / name / "episodes.csv").read_bytes()
    assert log_without_timing(out / "seed-0") != log_without_timing(out / "seed-1")
    assert json.loads((out / "seed-1" / "config.json").read_text())["config"]["seed"] == 1
    assert (out / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert len(json.loads((out / "seeds.json").read_text())["runs"]) == 2


def test_the_milestone_is_the_first_line_at_which_the_goal_holds(tmp_path):
    lines = [
        {"episodes": 50, "coverage_mean_100": 0.95, "success_mean_100": 1.0, "step": 10},
        {"episodes": 120, "coverage_mean_100": 0.95, "success_mean_100": 0.99, "step": 20},
        {"episodes": 220, "coverage_mean_100": 0.90, "success_mean_100": 1.0, "step": 30},
        {"episodes": 320, "coverage_mean_100": 0.91, "success_mean_100": 1.0, "step": 40},
    ]
    timing = {"seconds": 7.0, "compile_seconds": 5.0}
    text = "".join(json.dumps({**line, "timing": timing}) + "\n" for line in lines)
    (tmp_path / "log.jsonl").write_text(text)
    found = session.reached(tmp_path)
    assert found == {"episodes": 220, "steps": 30, "seconds": 7.0, "seconds_compiled": 2.0}
    (tmp_path / "log.jsonl").write_text(text.splitlines()[0] + "\n")
    assert session.reached(tmp_path) is None
