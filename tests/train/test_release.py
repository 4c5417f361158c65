import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import load_file

import subterra_jax as st
from subterra_jax import policies
from subterra_jax.baselines import registry
from subterra_jax.baselines.agent import Observed
from subterra_jax.parts.unicycle import VehicleParams
from subterra_jax.policies import senses
from tests.train.conftest import TASK, call
from train import evaluate, learning, release
from train.feedforward import networks, rollout
from train.policies import facts_file, make_agent, open_agent, write_policy
from train.recurrent.config import RecurrentConfig
from train.recurrent.drive import make_layout
from train.recurrent.network import RecurrentNetworks, without_critic

GOAL_TASK = "Subterra/StopAtShort-v1"


@pytest.fixture(scope="module")
def perceptron():
    nets = networks.Networks(networks.Layout(18, (0.0, -1.5), (2.0, 1.5), 4, (16, 8), 0.5, 0.01))
    data = 3.0 * jax.random.normal(jax.random.PRNGKey(0), (50, 18)) + 1.0
    weights = jax.tree.map(lambda x: x + 0.1, nets.init(jax.random.PRNGKey(1))["policy"])
    return nets, networks.Policy(weights, learning.update_statistics(learning.start_statistics((18,)), data))


@pytest.fixture(scope="module")
def gru():
    env, params = st.make(GOAL_TASK)
    nets = RecurrentNetworks(make_layout(env, params, RecurrentConfig(hidden=12, bins=20)))
    weights = jax.tree.map(lambda x: x + 0.05, jax.jit(nets.init)(jax.random.PRNGKey(1)))
    return nets, without_critic(weights)


@pytest.fixture(scope="module")
def among_boxes():
    env, params = st.make("Subterra/Obstructed-v1")
    nets = RecurrentNetworks(make_layout(env, params, RecurrentConfig(hidden=12, bins=20)))
    weights = jax.tree.map(lambda x: x + 0.05, jax.jit(nets.init)(jax.random.PRNGKey(1)))
    return nets, without_critic(weights)


@pytest.fixture
def released(gru, tmp_path):
    out = tmp_path / "mine.safetensors"
    write_policy(out, *gru, {"task": GOAL_TASK, "world": {"lining": "pockets"}})
    return out


def readings(n_steps):
    """Observations of an episode with a goal, made up."""
    rng = np.random.default_rng(0)
    for step in range(n_steps):
        ranges = jnp.asarray(rng.uniform(1.0, 6.0, 16), jnp.float32)
        distance, heading = jnp.float32(0.19 * step), jnp.float32(0.1 * rng.normal())
        flat = jnp.concatenate([ranges, jnp.stack([distance, heading, 40.0, 1.35])])
        yield Observed(flat, ranges, distance, heading, jnp.float32(40.0), jnp.float32(1.35))


def test_a_perceptron_drives_without_the_trainer_as_it_does_with_it(perceptron):
    nets, policy = perceptron
    agent, stack, memory = make_agent(nets, policy), None, None
    for obs in readings(6):
        seen = Observed(obs.flat[:18], obs.ranges, obs.distance, obs.heading)
        stack = (
            rollout.start_stack(seen.flat, 4)
            if stack is None
            else rollout.push_frame(stack, seen.flat, jnp.zeros((), bool))
        )
        memory = agent.begin(None, seen, None) if memory is None else memory
        action, memory = agent.act(None, memory, seen, None, None)
        np.testing.assert_allclose(action[:2], nets.act(policy, stack), rtol=1e-5)
        assert np.isnan(action[2])


@pytest.mark.parametrize("trained", ["gru", pytest.param("among_boxes", marks=pytest.mark.slow)])
def test_a_gru_drives_and_estimates_without_the_trainer_as_it_does_with_it(request, trained):
    nets, weights = request.getfixturevalue(trained)
    agent, start = make_agent(nets, weights), jnp.float32(5.0)
    assert (agent.shown.boxes, agent.n_beams) == (trained == "among_boxes", 16)
    memory, hidden, reckoning = agent.blank(), jnp.zeros((1, 12)), senses.start((1,), 16, nets.layout.shown)
    answer, look, advance = jax.jit(agent.answer), jax.jit(senses.look), jax.jit(senses.advance)

    @jax.jit
    def think(seen, hidden):
        hidden, _ = nets.remember(weights, seen.features[None], hidden, jnp.zeros((1, 1), bool))
        thought = nets.think(weights, hidden, seen.ahead)
        return hidden, thought.error, thought.log_sigma, nets.action(thought.parameters[..., :2])

    for obs in readings(12):
        odometry = jnp.stack([obs.distance, obs.heading])
        part = {"ranges": obs.ranges, "odometry": odometry, "goal": obs.goal[None], "ring_pitch": obs.ring_pitch[None]}
        seen = look({name: value[None] for name, value in part.items()}, start, reckoning)
        hidden, error, log_sigma, wanted = think(seen, hidden)
        action, memory = answer(memory, obs, start)
        np.testing.assert_allclose(action[:2], wanted[0], rtol=2e-4, atol=2e-5)
        there = start + seen.station[0] + error[0] + 0.1 * max(float(wanted[0, 0]), 0.0)
        np.testing.assert_allclose(action[2], there, rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(action[3], log_sigma[0], rtol=1e-4, atol=1e-5)
        reckoning = advance(seen.reckoning, wanted, jnp.zeros(1, bool))


def test_released_tensors_are_what_the_safetensors_library_reads_and_act_alike(gru, released):
    agent, facts = policies.load(released)
    assert facts["kind"] == "gru"
    for name, tensor in load_file(released).items():
        np.testing.assert_array_equal(agent.tensors[name], tensor)
    obs = next(readings(1))
    for one, other in zip(
        agent.answer(agent.blank(), obs, jnp.float32(0.0))[0],
        make_agent(*gru).answer(agent.blank(), obs, jnp.float32(0.0))[0],
        strict=True,
    ):
        assert one == other
    again = released.with_name("again.safetensors")
    write_policy(again, *gru, {"task": GOAL_TASK, "world": {}})
    assert again.read_bytes() == released.read_bytes()


def test_loading_a_policy_needs_nothing_but_jax(released):
    code = (
        "import sys, subterra_jax.policies as p\n"
        f"agent, facts = p.load({str(released)!r})\n"
        "print(agent.name, sorted({'train', 'brax', 'orbax', 'safetensors', 'optax'} & set(sys.modules)))"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout == "mine []\n"


@pytest.mark.parametrize("share", [0.0, 0.0005, 0.01, 0.5, 0.999])
def test_a_policy_cut_short_is_a_clear_error(released, share):
    content = released.read_bytes()
    released.write_bytes(content[: int(share * len(content))])
    with pytest.raises(policies.PolicyError, match=r"mine.*damaged policy"):
        policies.load(released)


def test_tensors_that_are_not_those_of_the_facts_are_refused(released, perceptron):
    facts = json.loads(facts_file(released).read_text())
    write_policy(released, *perceptron, {"task": TASK, "world": {}})
    other = json.loads(facts_file(released).read_text())
    facts_file(released).write_text(json.dumps(facts))
    with pytest.raises(policies.PolicyError, match="another SHA-256"):
        policies.load(released)
    facts_file(released).write_text(json.dumps({**facts, "tensors_sha256": other["tensors_sha256"]}))
    with pytest.raises(policies.PolicyError, match="do not belong together"):
        policies.load(released)


def test_a_policy_is_refused_where_it_cannot_drive(released, perceptron):
    agent, _ = policies.load(released)
    policies.check_fits(agent, *st.make(GOAL_TASK), released)
    for task in (TASK, "Subterra/Relocalise-v1"):
        with pytest.raises(policies.PolicyError, match=f"which {task} does not ask for"):
            policies.check_fits(agent, *st.make(task), released)
    with pytest.raises(policies.PolicyError, match="observations of 18 numbers"):
        policies.check_fits(make_agent(*perceptron), *st.make(GOAL_TASK), "mine")


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
    assert call(release.main, str(trained), "--out", str(tmp_path / "corridor.bin")) == 2
    assert "must end in .safetensors" in capsys.readouterr().err


def with_period(task: str, period: float):
    return st.make(task, vehicle=VehicleParams(period=period))


def test_a_policy_is_refused_where_the_control_period_is_another_than_it_was_trained_with(trained, tmp_path):
    agent, _ = open_agent(trained, None)
    constants = st.constants_digest(*st.make(TASK))
    assert agent.conditions == policies.Conditions(TASK, 0.1, 16, ("ranges", "odometry"), constants)
    policies.check_fits(agent, *st.make(TASK), "mine")
    with pytest.raises(policies.PolicyError, match=r"mine: trained with a control period of 0\.1 s, .* has 0\.05 s"):
        policies.check_fits(agent, *with_period(TASK, 0.05), "mine")
    out = tmp_path / "mine.safetensors"
    assert call(release.main, str(trained), "--out", str(out), "--episodes=1") == 0
    assert json.loads(facts_file(out).read_text())["trained_under"]["period"] == 0.1
    again, _ = policies.load(out)
    assert again.conditions == agent.conditions
    with pytest.raises(policies.PolicyError, match=r"0\.1 s, .* has 0\.05 s"):
        policies.check_fits(again, *with_period(TASK, 0.05), out)


@pytest.mark.parametrize(("name", "period"), [("Traverse-v1", 0.1), ("B2Traverse-v1", 0.2)])
def test_policies_released_before_conditions_were_kept_imply_their_period(name, period):
    agent, facts = policies.load(name)
    assert "trained_under" not in facts
    assert agent.conditions.period == period
    with pytest.raises(policies.PolicyError, match=f"control period of {period} s, .* has 0.05 s"):
        policies.check_fits(agent, *with_period(facts["task"], 0.05), name)


def test_a_released_policy_among_the_agents_is_refused_as_well():
    policies.register_released()
    _, params = with_period("Subterra/Traverse-v1", 0.05)
    with pytest.raises(policies.PolicyError, match=r"Traverse-v1: trained with .* 0\.1 s, this task has 0\.05 s"):
        registry.make_agent("policy:Traverse-v1", params)


@pytest.mark.parametrize(
    ("conditions", "message"),
    [
        ({"period": 0.1, "n_beams": 24}, "mine: trained with 24 beams, Subterra/TraverseShort-v1 has 16"),
        (
            {"period": 0.1, "constants": "0123456789abcdef"},
            "mine: trained under constants 0123456789ab of Subterra/TraverseShort-v1, which has [0-9a-f]{12} here",
        ),
        (
            {"period": 0.1, "fields": ["odometry", "ranges"]},
            "mine: trained on the fields odometry, ranges; Subterra/TraverseShort-v1 has ranges, odometry",
        ),
    ],
)
def test_other_beams_and_fields_are_refused_with_both_sides_named(perceptron, conditions, message):
    trained_under = policies.Conditions.from_facts({"task": TASK, "trained_under": conditions})
    agent = make_agent(*perceptron, conditions=trained_under)
    with pytest.raises(policies.PolicyError, match=message):
        policies.check_fits(agent, *st.make(TASK), "mine")
