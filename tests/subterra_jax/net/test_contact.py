"""Contact: docs/tasks.md, "Contact"."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.baselines import registry
from subterra_jax.evaluation import Episodes, evaluate
from subterra_jax.recorder.trace import drive
from tests.subterra_jax import tunnels
from tests.subterra_jax.net.robots import FEW, MANY, advanced, assert_mean, begun, driven, made, observed, placed


def test_nine_tenths_covered_in_contact_with_a_wall_are_no_success():
    id = "Subterra/Traverse-v1"
    _, params, *_ = made(id)
    threshold, n = 0.9 * float(params.tunnel.length), FEW
    lateral = np.where(np.arange(n) < n // 2, 0.0, 2.6)  # the walls are 2.8 m away, the robot's radius is 0.4 m
    state = placed(id, begun(id, n), threshold - 0.1, lateral).replace(furthest=jnp.full(n, threshold - 0.1))
    _, _, terminated, truncated, info = advanced(id, state, np.array([2.0, 0.0]))
    info = {name: np.asarray(value) for name, value in info.items()}
    np.testing.assert_array_equal(info["contact"], lateral > 0.0)
    assert (info["coverage"] >= 0.9).all()
    np.testing.assert_array_equal(info["success"], lateral == 0.0)
    np.testing.assert_array_equal(info["reward_terminal"], 1.0 * (lateral == 0.0))
    assert np.asarray(terminated).all()
    assert not np.asarray(truncated).any()


@pytest.fixture(scope="module")
def blocked(plan_of):
    """A straight tunnel of 60 m with a wall across it: who covers nine tenths touches it in that very step."""
    arrays = tunnels.tunnel_arrays(tunnels.straight(60.0))
    across = np.array([[54.39, -2.8, 54.39, 2.8]])
    return plan_of(arrays | {"furniture_smooth": across, "furniture_pockets": across})


@pytest.mark.parametrize("name", ["dead-reckoning"])
def test_neither_evaluation_nor_trace_counts_coverage_in_contact_as_success(blocked, name):
    env, params = st.make("Subterra/Traverse-v1", tunnel=blocked, lining="smooth")
    one = np.zeros(4, np.int32)
    episodes = Episodes(np.arange(4, dtype=np.uint32), one, one, one)
    records = evaluate(env, params, registry.make_agent(name, params), episodes)
    assert (records.coverage >= 0.9).any()
    assert records.contact.all()
    assert not records.success.any()
    trace = drive(env, params, registry.make_agent(name, params), 0)
    assert (trace.contact, trace.success) == (True, False)


def among_boxes(id, n):
    """Robots at their starts, and boxes as if all had begun at the mouth."""
    state = begun(id, n)
    if "Obstructed" not in id:
        return state
    return state.replace(obstacles=state.obstacles.replace(start=jnp.zeros(n)))


def test_where_a_beam_ends_on_a_box_the_robot_would_touch_it():
    id, plain = "Subterra/Obstructed-v1", "Subterra/StopAt-v1"
    station = np.random.default_rng(0).uniform(20.0, 300.0, FEW)
    state, empty = (placed(name, among_boxes(name, FEW), station) for name in (id, plain))
    seen, walls = (observed(name, there)["ranges"] for name, there in ((id, state), (plain, empty)))
    robot, beam = np.nonzero((seen < walls - 0.5) & (seen < 6.0))
    assert len(robot) > 200
    robot, beam = np.resize(robot, FEW), np.resize(beam, FEW)
    heading = np.asarray(state.heading)[robot] + beam * (2.0 * np.pi / 16.0)
    reach = seen[robot, beam][:, None]
    hit = np.asarray(state.position)[robot] + reach * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    along = station[robot] + reach[:, 0] * np.cos(beam * (2.0 * np.pi / 16.0))

    def standing_there(name, state):
        there = jax.tree.map(lambda leaf: leaf[robot], state)
        there = there.replace(position=jnp.asarray(hit), station=jnp.asarray(along, jnp.float32))
        _, _, terminated, _, info = advanced(name, there, np.zeros(2))
        return np.asarray(terminated), {key: np.asarray(value) for key, value in info.items()}

    terminated, info = standing_there(id, state)
    # The beam is noisy by 5 cm.
    assert info["clearance"].max() < 0.25
    assert info["contact"].all()
    assert terminated.all()
    assert not info["success"].any()
    # It is the boxes that are touched: most of these places are free without them.
    assert standing_there(plain, empty)[1]["contact"].mean() < 0.3


def test_a_robot_that_drives_blindly_among_boxes_runs_into_them():
    contacts = {}
    for id in ("Subterra/StopAt-v1", "Subterra/Obstructed-v1"):
        _, series = driven(id, placed(id, among_boxes(id, MANY), 10.0), 150)
        contacts[id] = series["contact"].any(axis=0).mean()
    assert contacts["Subterra/StopAt-v1"] == 0.0
    assert 0.3 < contacts["Subterra/Obstructed-v1"] < 0.99


def test_boxes_are_as_many_and_as_large_as_stated():
    id, points = "Subterra/Obstructed-v1", 150
    _, params, *_ = made(id)
    state, rng, inside = among_boxes(id, MANY), np.random.default_rng(0), np.zeros(MANY)
    for k in range(points):
        there = placed(id, state, rng.uniform(30.0, 315.0, MANY), rng.uniform(-3.0, 3.0, MANY))
        inside += np.asarray(advanced(id, there, np.zeros(2), key=k)[4]["clearance"]) == 0.0
    # One thing in every 15 m: a box of sides U(0.3, 0.8) m, or, in one of the 22 places after the first, the trolley of
    # 2.4 m by 1.2 m. A point within 3 m of the axis lies inside of it with this chance:
    n_places = float(params.tunnel.length) // 15.0 - 1.0
    assert n_places == 22.0
    area = 0.55**2 + (2.4 * 1.2 - 0.55**2) / n_places
    assert_mean(inside / points, area / (15.0 * 6.0))
