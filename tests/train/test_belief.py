import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax import policies as released
from tests.train.conftest import call, log_without_timing
from train import navigate, policies
from train.belief import lessons
from train.belief.learner import (
    BeliefLayout,
    BeliefLearner,
    BeliefNetworks,
    check_belief,
    make_belief_config,
)
from train.config import ConfigError
from train.policies import make_agent

TASK = "Subterra/Relocalise-v1"
CONFIG = make_belief_config("cpu")
LENGTH, PITCH = 300.0, 1.5
STATION = jnp.linspace(80.0, 92.0, 61)


draw = jax.jit(lessons.ways, static_argnums=(5, 6, 7))


def drawn(forward: float, pitch: float = PITCH) -> lessons.Ways:
    station = STATION if forward > 0.0 else LENGTH - STATION
    key = jax.random.PRNGKey(0)
    return draw(key, station, jnp.float32(forward), jnp.float32(LENGTH), jnp.float32(pitch), 400, 0.2, 0.05)


@pytest.mark.parametrize("forward", [1.0, -1.0])
def test_the_first_way_is_the_true_one_within_a_cell_and_every_other_is_driven_as_far(forward):
    ways = drawn(forward)
    true = STATION if forward > 0.0 else LENGTH - STATION
    assert float(ways.forward[0]) == forward
    assert not bool(ways.wrong[0])
    assert float(jnp.max(jnp.abs(ways.station[:, 0] - true))) <= 0.05
    np.testing.assert_allclose(ways.station[-1] - ways.station[0], 12.0 * ways.forward, atol=1e-3)
    assert bool(jnp.all(jnp.diff(ways.station, axis=0) * ways.forward > 0.0))


def test_ways_that_face_alike_begin_whole_rings_away_or_near_by():
    ways = drawn(1.0)
    alike = np.flatnonzero(np.asarray(ways.forward) == 1.0)[1:]
    apart = np.asarray(ways.station[0, alike] - STATION[0])
    rings = apart / PITCH - np.round(apart / PITCH)
    far = np.abs(apart) > 1.5
    assert np.std(rings[far]) * PITCH == pytest.approx(0.1, rel=0.2)
    assert 0.15 < np.mean(~far) < 0.35
    assert np.asarray(ways.wrong)[alike][np.abs(apart) < 0.19].sum() == 0
    assert np.asarray(ways.wrong)[alike][np.abs(apart) > 0.21].all()
    assert np.std(np.modf(np.abs(np.asarray(drawn(1.0, 0.0).station[0, alike] - STATION[0])) / PITCH)[0][far]) > 0.2


def test_half_of_the_ways_face_the_other_way_and_begin_anywhere():
    ways = drawn(1.0)
    other = np.asarray(ways.station[0])[np.asarray(ways.forward) == -1.0]
    assert len(other) == 200
    assert np.asarray(ways.wrong)[np.asarray(ways.forward) == -1.0].all()
    assert np.histogram(other, bins=4, range=(0.0, LENGTH))[0].min() > 30


def test_it_is_refused_where_one_knows_where_one_is():
    with pytest.raises(ConfigError, match="which Subterra/StopAtShort-v1 does not"):
        BeliefLearner(*st.make("Subterra/StopAtShort-v1"), CONFIG)


@pytest.mark.parametrize(("name", "value"), [("ways", 0), ("least_apart", 0.0), ("hidden", ()), ("minibatches", 3)])
def test_a_setting_that_makes_no_sense_is_refused_by_name(name, value):
    with pytest.raises(ConfigError, match=name):
        check_belief(dataclasses.replace(CONFIG, **{name: value}))


@pytest.mark.parametrize(("name", "value"), [("cell", 0.0), ("sure_mass", 1.5), ("drift", -1.0)])
def test_so_is_a_habit_of_the_filter(name, value):
    with pytest.raises(ConfigError, match=name):
        check_belief(dataclasses.replace(CONFIG, habits=dataclasses.replace(CONFIG.habits, **{name: value})))


def test_an_untrained_sensor_is_the_nominal_one_and_survives_a_release(tmp_path):
    layout = BeliefLayout((0.0, -1.5), (2.0, 1.5), (8,), dataclasses.asdict(CONFIG.habits))
    networks = BeliefNetworks(layout)
    policy = networks.init(jax.random.PRNGKey(0))
    out = tmp_path / "mine.safetensors"
    policies.write_policy(out, networks, policy, {"task": TASK, "world": {"lining": "pockets"}})
    agent, facts = released.load(out)
    assert (facts["kind"], agent.name, agent.habits) == ("belief", "mine", CONFIG.habits)
    for name, tensor in make_agent(networks, policy).tensors.items():
        np.testing.assert_array_equal(agent.tensors[name], tensor)
    assert float(jnp.max(jnp.abs(agent.tensors["scan.hidden_1.kernel"]))) == 0.0
    broken = {name: tensor for name, tensor in policy.items() if name != "temper"}
    policies.write_policy(out, networks, broken, {"task": TASK, "world": {}})
    with pytest.raises(released.PolicyError, match="do not belong together"):
        released.load(out)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder after two iterations."""
    out = tmp_path_factory.mktemp("belief") / "run"
    small = ("--n-envs=8", "--unroll=24", "--epochs=2", "--minibatches=2", "--ways=15", "--steps=384")
    line = ("--task", TASK, "--memory", "map", "--preset", "cpu", *small, "--evaluation-episodes=2")
    assert call(navigate.main, *line, "--out", str(out)) == 0
    return out


@pytest.mark.slow
def test_a_run_learns_is_scored_and_can_be_opened_again(run):
    first, last = log_without_timing(run)
    assert json.loads((run / "config.json").read_text())["kind"] == "belief"
    assert 0.0 < first["belief"] <= 1.0
    assert np.isfinite(last["loss"])
    assert (run / "curve.png").stat().st_size > 1000
    assert json.loads((run / "evaluation.json").read_text())["contacts"] == 0
    networks, policy, facts = policies.load_policy(run)
    assert facts["task"] == TASK
    # Weights that were 0 have learnt something.
    assert float(np.max(np.abs(policy["scan"]["hidden_1"]["kernel"]))) > 0.0
    assert make_agent(networks, policy).habits == CONFIG.habits


def test_a_teacher_for_a_belief_is_refused(capsys):
    line = ("--task", TASK, "--memory", "map", "--teacher", "oracle", "--out", "nowhere")
    assert call(navigate.main, *line) == 2
    assert "teacher = oracle teaches a policy with memory" in capsys.readouterr().err
