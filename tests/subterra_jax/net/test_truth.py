"""Truth: docs/tasks.md, "No absolute pose is in it"; an agent receives only the inputs that it declares."""

import jax
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.baselines import registry
from subterra_jax.evaluation import Episodes, evaluate
from subterra_jax.recorder import RecorderConfig, record
from tests.subterra_jax.net.robots import begun, driven, made
from tests.subterra_jax.placing import PROBES


def probe(name):
    """Name under which a probe can be asked for."""
    if f"probe {name}" not in registry.names():
        registry.register(f"probe {name}", lambda params: PROBES[name][0])
    return f"probe {name}"


@pytest.mark.parametrize("name", PROBES)
def test_the_evaluation_gives_an_agent_what_it_declares_and_no_more(name):
    agent, speed = PROBES[name]
    env, params = st.make("Subterra/TraverseShort-v1", horizon=3)
    one = np.zeros(2, np.int32)
    records = evaluate(env, params, agent, Episodes(np.arange(2, dtype=np.uint32), one, one, one))
    np.testing.assert_allclose(records.travelled / records.time, speed, rtol=1e-4)


@pytest.mark.parametrize("name", ["nothing", "truth"])
def test_the_recorder_gives_an_agent_what_it_declares_and_no_more(name, tmp_path):
    trace = record(RecorderConfig(out=tmp_path / "one", task="TraverseShort", agent=probe(name), steps=3))
    np.testing.assert_allclose(trace.command[:, 0], PROBES[name][1], rtol=1e-4)


def test_the_truth_that_is_handed_out_is_the_truth():
    id = "Subterra/StopAt-v1"
    env, params, *_ = made(id)
    state, _ = driven(id, begun(id, 50), 50)
    known = jax.vmap(env.privileged, (0, None))(state, params)
    np.testing.assert_array_equal(known["station"], state.station)
    np.testing.assert_allclose(known["to_goal"], state.goal.station - state.station, atol=1e-4)
    assert set(env.fields(params)) == {"ranges", "odometry", "goal", "ring_pitch", "start"}
