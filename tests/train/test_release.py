"""Released policies, their tensors and facts; evaluation: scores that geometry tells, the command, ablations."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import load_file

import subterra_jax as st
from subterra_jax import policies
from subterra_jax.baselines.agent import observed
from subterra_jax.evaluation import evaluate as drive
from subterra_jax.evaluation import listed_episodes
from subterra_jax.rules import StartParams
from tests.train.conftest import TASK, call, weights_of
from train import evaluate, release
from train.config import ConfigError, TrainConfig
from train.driver import Driver, Policy, Seen
from train.policies import facts_file, make_agent, open_agent, write_tensors
from train.setup import make_layout, make_learner
from train.without import without
from train.world import open_world

GOAL_TASK = "Subterra/StopAtShort-v1"


@pytest.fixture(scope="module")
def gru():
    env, params = st.make(GOAL_TASK, tunnel="open:cast:train:0")
    driver = Driver(env, make_layout(env, params, TrainConfig(hidden=(12,), memory="gru", cell=12, auxiliary=True)))
    weights = weights_of(driver, 1, 0.05)
    return env, params, driver, Policy(weights)


@pytest.fixture
def released(gru, tmp_path):
    out = tmp_path / "mine.safetensors"
    _, _, driver, policy = gru
    facts = {"task": GOAL_TASK, "world": {"lining": "built"}}
    write_tensors(out, driver.kind, driver.layout, driver.tensors(policy), facts)
    return out


def test_a_gru_drives_without_the_trainer_as_it_does_with_it(gru):
    env, params, driver, policy = gru
    agent = make_agent(driver, policy)
    flat, state = env.reset(jax.random.key(0), params)
    memory = agent.begin(None, observed(env, params, flat), params)
    kept, cell = driver.begin(policy, Seen(flat[None], np.zeros(1, int)), params), driver.start_memory((1,))
    act = jax.jit(lambda memory, flat: agent.act(None, memory, observed(env, params, flat), params, None))

    @jax.jit
    def think(kept, cell):
        out, cell = driver.answer(policy, driver.inputs(policy, kept), cell)
        return driver.action(out.mean), cell

    step = jax.jit(env.step)
    for i in range(5):
        expected, cell = think(kept, cell)
        action, memory = act(memory, flat)
        np.testing.assert_allclose(action[:2], expected[0], atol=1e-5)
        assert 0.0 < action[2] < params.tunnel.length
        flat, state, *_ = step(jax.random.key(i), state, expected[0], params)
        kept = driver.take(policy, kept, expected, Seen(flat[None], np.zeros(1, int)), params)


def test_released_tensors_are_what_the_safetensors_library_reads(gru, released):
    agent, facts = policies.load(released)
    assert facts["kind"] == "ppo"
    for name, tensor in load_file(released).items():
        np.testing.assert_array_equal(agent.tensors[name], tensor)
    again = released.with_name("again.safetensors")
    _, _, driver, policy = gru
    write_tensors(again, driver.kind, driver.layout, driver.tensors(policy), {"task": GOAL_TASK, "world": {}})
    assert again.read_bytes() == released.read_bytes()


def test_weights_in_half_precision_take_half_the_bytes_and_are_read_as_float32(gru, released):
    half = released.with_name("half.safetensors")
    _, _, driver, policy = gru
    facts = {"task": GOAL_TASK, "world": {}}
    write_tensors(half, driver.kind, driver.layout, driver.tensors(policy), facts, half=True)
    agent, _ = policies.load(half)
    whole, _ = policies.load(released)
    assert half.stat().st_size < 0.7 * released.stat().st_size
    for name, tensor in agent.tensors.items():
        assert tensor.dtype == np.float32
        np.testing.assert_allclose(tensor, whole.tensors[name], rtol=1e-3, atol=1e-6)


def test_a_tensor_that_is_missing_or_of_another_shape_is_refused(gru, released):
    _, _, driver, policy = gru
    tensors = driver.tensors(policy)
    name = "network.actor.hidden_0.kernel"
    for wrong in ({**tensors, name: tensors[name][:-1]}, {k: v for k, v in tensors.items() if k != name}):
        write_tensors(released, driver.kind, driver.layout, wrong, {"task": GOAL_TASK, "world": {}})
        with pytest.raises(policies.PolicyError, match=r"do not belong together .*actor\.hidden_0\.kernel"):
            policies.load(released)


def test_what_is_released_is_scored_like_the_run_it_comes_from(trained, tunnel, tmp_path, capsys):
    out = tmp_path / "corridor.safetensors"
    line = ("--tunnel", str(tunnel), "--episodes", "100")
    assert call(release.main, str(trained), "--out", str(out), *line) == 0
    capsys.readouterr()
    assert call(evaluate.main, "--policy", str(out), "--task", TASK, *line, "--json") == 0
    saved = json.loads((trained / "evaluation.json").read_text())
    saved.pop("schema")
    assert json.loads(capsys.readouterr().out) == saved
    assert json.loads(facts_file(out).read_text())["scores"] == saved
    constants = st.constants_digest(*st.make(TASK))
    for source in (trained, out):
        agent, _ = open_agent(source, None)
        assert agent.conditions == policies.Conditions(TASK, 0.1, 16, ("ranges", "odometry"), constants)
    assert call(release.main, str(trained), "--out", str(tmp_path / "corridor.bin")) == 2
    assert "must end in .safetensors" in capsys.readouterr().err


@pytest.mark.parametrize(("frames", "walls"), [(1, False), (2, False), (2, True)])
def test_a_localiser_begins_from_a_policy_that_has_none_and_drives_as_it_does(tmp_path, frames, walls):
    world = open_world("StopAtShort-v1", "open:cast:train:0")
    kept = TrainConfig(memory="stack", frames=frames, hidden=(8,))
    driver, file = make_learner(world, kept).driver, tmp_path / "stack.safetensors"
    weights = weights_of(driver, 0)
    write_tensors(file, driver.kind, driver.layout, driver.tensors(Policy(weights)), {"task": GOAL_TASK, "world": {}})
    own = dataclasses.replace(kept, memory="along", walls=walls, begin_from=f"{file},locate-transformer")
    learner = make_learner(world, own)
    rows = jax.random.normal(jax.random.PRNGKey(1), (frames, driver.layout.shape.n_inputs // frames))
    doubts = np.concatenate([rows, np.full((frames, 4 if walls else 1), 7.0)], axis=1)  # nothing is made of them yet
    before, _ = driver.answer(Policy(weights), rows.reshape(-1), driver.start_memory(()))
    after, _ = learner.driver.answer(learner.given, doubts.reshape(-1), driver.start_memory(()))
    np.testing.assert_allclose(after.mean, before.mean, atol=1e-5)


@pytest.fixture(scope="module")
def straight_driver():
    """A policy that drives straight on at 1 m/s whatever it sees."""
    env, params = st.make(TASK)
    driver = Driver(env, make_layout(env, params, TrainConfig(hidden=(4,))))
    weights = jax.tree.map(np.zeros_like, weights_of(driver, 0))
    # A speed of 1 m/s between -1 and 2 m/s.
    weights["actor"]["out"]["bias"] = jnp.arctanh(jnp.array([2.0 * 2.0 / 3.0 - 1.0, 0.0]))
    return make_agent(driver, Policy(weights))


def driven(agent, tunnel, **start):
    env, params = st.make(TASK, tunnel=tunnel, start=StartParams(**start))
    return evaluate.scores(drive(env, params, agent, listed_episodes(env, params, 20)))


def test_a_drive_down_the_centreline_scores_what_geometry_says(straight_driver, tunnel):
    scores = driven(straight_driver, tunnel, lateral=0.0, heading=0.0)
    assert scores["success"] == 1.0
    assert scores["coverage"] == pytest.approx(0.9, abs=0.006)
    assert scores["coverage_min"] == pytest.approx(0.9, abs=0.006)
    assert scores["time"] == pytest.approx(18.0, abs=0.15)
    assert scores["offset"] == pytest.approx(0.0, abs=1e-4)
    assert scores["jerk"] == pytest.approx(1.0 / 180.0, rel=0.02)
    assert (scores["contacts"], scores["contacts_per_100m"]) == (0, 0.0)


def test_a_drive_into_the_wall_counts_its_contact(straight_driver, tunnel):
    scores = driven(straight_driver, tunnel, heading=1.0)
    assert scores["success"] < 1.0
    assert scores["contacts"] == round(20 * (1.0 - scores["success"]))
    assert scores["contacts_per_100m"] > 0.0


def test_a_trained_policy_succeeds_without_its_exploration_noise(trained):
    scores = json.loads((trained / "evaluation.json").read_text())
    assert scores["episodes"] >= 100
    assert scores["success"] == 1.0
    assert scores["coverage"] >= 0.9
    assert scores["contacts"] == 0


def test_the_command_prints_one_line_of_json_and_nothing_else(trained, tunnel, capfd):
    words = ("--policy", str(trained), "--tunnel", str(tunnel), "--episodes", "100")
    assert call(evaluate.main, *words, "--json") == 0
    (line,) = capfd.readouterr().out.splitlines()
    saved = json.loads((trained / "evaluation.json").read_text())
    assert json.loads(line) == {name: value for name, value in saved.items() if name != "schema"}
    assert call(evaluate.main, *words) == 0
    assert f"{saved['success']:g}" in capfd.readouterr().out


def test_an_ablation_takes_away_what_it_names_and_nothing_else():
    env, params = st.make("Subterra/StopAtShort-v1", tunnel="open:cast:train:0")
    flat, _ = env.reset(jax.random.key(0), params)
    fresh = observed(env, params, flat)
    obs = dataclasses.replace(fresh, distance=fresh.distance + 5.0)
    driver = Driver(env, make_layout(env, params, TrainConfig(hidden=(4,))))
    agent = make_agent(driver, Policy(weights_of(driver, 0)))

    def reads(agent):
        act = jax.jit(lambda obs: agent.act(None, agent.begin(None, fresh, params), obs, params, None))
        return np.asarray(act(obs)[1].kept.seen)

    whole = reads(agent)
    beams = slice(4, 4 + 2 * params.lidar.n_beams)
    for part, places in (("start", range(4)), ("odometry", range(4)), ("walls", range(beams.start, beams.stop))):
        changed = reads(without(agent, part)) != whole
        assert changed[list(places)].any()
        assert not np.delete(changed, list(places)).any()
    assert 100.0 * (whole - reads(without(agent, "start")))[3] == pytest.approx(40.0, abs=1e-3)
    assert 100.0 * (whole - reads(without(agent, "odometry")))[3] == pytest.approx(-5.0, abs=1e-3)
    for part in ("front", "memory"):
        with pytest.raises(ConfigError, match="to go without"):
            without(agent, part)


def test_without_its_localiser_a_policy_reads_the_dead_reckoned_way():
    agent, _ = open_agent(None, "StopAt-v1")
    env, params = st.make("Subterra/StopAt-v1", tunnel="open:cast:train:0")
    obs = observed(env, params, env.reset(jax.random.key(0), params)[0])
    drifted = dataclasses.replace(obs, distance=obs.distance + 5.0)

    def way(agent):
        act = jax.jit(lambda drifted: agent.act(None, agent.begin(None, obs, params), drifted, params, None))
        return 100.0 * float(act(drifted)[1].kept.seen[3])

    assert way(agent) - way(without(agent, "memory")) == pytest.approx(5.0, abs=0.2)
