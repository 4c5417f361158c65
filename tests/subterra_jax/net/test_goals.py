"""Starts, goals, success and truth: docs/tasks.md, the table of tasks, "success", "Stop", "No absolute pose"."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.baselines import registry
from subterra_jax.evaluation import Episodes, evaluate
from subterra_jax.recorder import RecorderConfig, record
from subterra_jax.recorder.trace import drive
from tests.subterra_jax import tunnels
from tests.subterra_jax.net import robots
from tests.subterra_jax.net.robots import FEW, MANY
from tests.subterra_jax.placing import PROBES

WITH_GOAL = tuple(name for name in st.TASKS if "Traverse" not in name)
LENGTH, MARGIN = 351.05, 40.0  # m: of the tunnel, and between a mouth and starts and goals


@pytest.mark.parametrize(
    ("id", "low", "high"),
    [
        ("Subterra/StopAt-v1", 60.0, 271.0),
        ("Subterra/Return-v1", 60.0, 271.0),
        ("Subterra/Obstructed-v1", 60.0, 271.0),
        ("Subterra/Faulted-v1", 60.0, 271.0),
        ("Subterra/StopAtShort-v1", 10.0, 60.0),
    ],
)
def test_goals_lie_anywhere_in_their_range_from_the_start_and_starts_anywhere_in_the_room_left(id, low, high):
    state = robots.fresh(id, MANY)
    start, goal = (np.asarray(values, np.float64) for values in (state.goal.reported, state.goal.station))
    way = goal - start
    assert low - 1e-3 <= way.min() < low + 0.01 * (high - low)
    assert high - 0.01 * (high - low) < way.max() <= high + 0.1
    robots.assert_mean(way, 0.5 * (low + high))
    fraction = np.histogram(way, 10, (low - 1e-3, high + 0.1))[0] / len(way)
    assert np.abs(fraction - 0.1).max() < 4.0 * np.sqrt(0.1 * 0.9 / len(way))
    # The fraction of the room in front of the start is uniform from 0 to 1, whatever the way.
    room = LENGTH - 2.0 * MARGIN - way
    before = (start - MARGIN)[room > 5.0] / room[room > 5.0]
    assert before.min() > -0.01
    assert before.max() < 1.01
    robots.assert_mean(before, 0.5)
    robots.assert_mean(before**2, 1.0 / 3.0)


@pytest.mark.parametrize("id", ["Subterra/StopAt-v1", "Subterra/Return-v1"])
def test_robots_start_where_the_task_says(id):
    state = robots.fresh(id, MANY)
    np.testing.assert_allclose(state.station, state.goal.reported, atol=1e-4)
    lateral = np.asarray(state.lateral, np.float64)
    # Uniform to either side: 0.5 m and 0.1 rad.
    off_axis = np.arcsin(np.asarray(robots.known(robots.made(id)[0], state, robots.made(id)[1])["heading_sin"]))
    for values, largest in ((lateral, 0.5), (off_axis, 0.1)):
        assert np.abs(values).max() < largest + 1e-5
        robots.assert_covariance(values, values, largest**2 / 3.0)


def errors_about(tolerance, n):
    """Errors just inside and just outside of a tolerance, to either side, and which are inside."""
    error = np.tile([-tolerance - 0.02, -tolerance + 0.02, tolerance - 0.02, tolerance + 0.02], n // 4)
    return error, np.abs(error) < tolerance


@pytest.mark.parametrize("id", WITH_GOAL)
def test_a_stop_counts_within_1_metre_and_within_25_centimetres_in_the_short_tasks(id):
    tolerance = 0.25 if "Short" in id else 1.0
    state, report = robots.fresh(id, FEW), None
    error, inside = errors_about(tolerance, FEW)
    if "Relocalise" in id:
        state = robots.placed(id, state, state.station)
        report = np.asarray(state.station) + error
    else:
        target = state.goal.station
        if "Return" in id:
            state, target = robots.advanced(id, robots.placed(id, state, target), np.zeros(2))[0], state.goal.reported
        state = robots.placed(id, state, target + error)
    _, _, early, before = robots.stand(id, state, 9 if "Return" not in id else 8, report)
    assert not before["stopped"].any()
    assert not (early & ~before["contact"]).any()
    _, _, ended, info = robots.stand(id, state, 10, report)
    free = ~info["contact"]
    assert free.mean() > (0.8 if "Obstructed" in id else 0.999)
    assert ended.all()
    assert info["stopped"][free].all()
    np.testing.assert_array_equal(info["success"], inside & free)


def test_a_report_of_the_wrong_direction_is_no_success():
    id = "Subterra/Relocalise-v1"
    state = robots.fresh(id, FEW)
    state = robots.placed(id, state, state.station, backward=True)
    _, _, ended, info = robots.stand(id, state, 10, np.asarray(state.station))
    assert ended.all()
    assert not info["success"].any()


def test_the_flag_is_raised_within_2_metres_of_the_goal():
    id = "Subterra/Return-v1"
    state = robots.fresh(id, FEW)
    error, inside = errors_about(2.0, FEW)
    _, _, _, info = robots.stand(id, robots.placed(id, state, state.goal.station + error), 1)
    np.testing.assert_array_equal(info["flag"], inside)


@pytest.mark.parametrize(
    ("command", "stands"),
    [
        ((0.043, 0.0), True),
        ((0.058, 0.0), False),
        *(((0.0, side * rate), rate < 0.5) for rate in (0.48, 0.52) for side in (-1, 1)),
    ],
)
def test_below_5_centimetres_and_half_a_radian_a_second_is_standing(command, stands):
    id = "Subterra/StopAt-v1"
    state = robots.placed(id, robots.fresh(id, FEW), 100.0)
    for k in range(10):
        state, _, _, _, info = robots.advanced(id, state, command, key=k)
    # The speed that counts is the true one: it slips by 3 %.
    assert np.mean(info["stopped"]) == (1.0 if stands else 0.0)


def test_a_robot_that_has_not_reported_within_60_metres_has_failed():
    id, limit = "Subterra/Relocalise-v1", 60.0
    state, travelled, ended = robots.fresh(id, FEW), np.zeros(FEW), np.zeros(FEW, bool)
    # Back and forth over 20 m: the limit is of the distance, wherever it is driven.
    for k in range(round(limit / 20.0) + 1):
        state, series = robots.driven(id, robots.placed(id, state, 20.0), 100, key=k)
        for moved, terminated in zip(series["moved"], series["terminated"], strict=True):
            travelled = np.where(ended, travelled, travelled + moved)
            ended |= terminated > 0.0
        assert not series["success"].any()
    assert ended.all()
    # The step that ends an episode is the one that leads beyond the limit.
    assert travelled.min() > limit - 0.01
    assert travelled.max() < limit + 0.25


def test_nine_tenths_covered_in_contact_with_a_wall_are_no_success():
    id = "Subterra/Traverse-v1"
    _, params, *_ = robots.made(id)
    threshold, n = 0.9 * float(params.tunnel.length), FEW
    lateral = np.where(np.arange(n) < n // 2, 0.0, 2.6)  # the walls are 2.8 m away, the robot's radius is 0.4 m
    state = robots.placed(id, robots.fresh(id, n), threshold - 0.1, lateral).replace(
        furthest=jnp.full(n, threshold - 0.1)
    )
    _, _, terminated, truncated, info = robots.advanced(id, state, np.array([2.0, 0.0]))
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
    state = robots.fresh(id, n)
    if "Obstructed" not in id:
        return state
    return state.replace(obstacles=state.obstacles.replace(start=jnp.zeros(n)))


def test_where_a_beam_ends_on_a_box_the_robot_would_touch_it():
    id, plain = "Subterra/Obstructed-v1", "Subterra/StopAt-v1"
    station = np.random.default_rng(0).uniform(20.0, 300.0, FEW)
    state, empty = (robots.placed(name, among_boxes(name, FEW), station) for name in (id, plain))
    seen, walls = (robots.observed(name, there)["ranges"] for name, there in ((id, state), (plain, empty)))
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
        _, _, terminated, _, info = robots.advanced(name, there, np.zeros(2))
        return np.asarray(terminated), {key: np.asarray(value) for key, value in info.items()}

    terminated, info = standing_there(id, state)
    # The beam is noisy by 5 cm.
    assert info["clearance"].max() < 0.25
    assert info["contact"].all()
    assert terminated.all()
    assert not info["success"].any()
    # It is the boxes that are touched: most of these places are free without them.
    assert standing_there(plain, empty)[1]["contact"].mean() < 0.3


def test_boxes_are_as_many_and_as_large_as_stated():
    id, points = "Subterra/Obstructed-v1", 150
    _, params, *_ = robots.made(id)
    state, rng, inside = among_boxes(id, MANY), np.random.default_rng(0), np.zeros(MANY)
    for k in range(points):
        there = robots.placed(id, state, rng.uniform(30.0, 315.0, MANY), rng.uniform(-3.0, 3.0, MANY))
        inside += np.asarray(robots.advanced(id, there, np.zeros(2), key=k)[4]["clearance"]) == 0.0
    # One thing in every 15 m: a box of sides U(0.3, 0.8) m, or, in one of the 22 places after the first, the trolley of
    # 2.4 m by 1.2 m. A point within 3 m of the axis lies inside of it with this chance:
    n_places = float(params.tunnel.length) // 15.0 - 1.0
    assert n_places == 22.0
    area = 0.55**2 + (2.4 * 1.2 - 0.55**2) / n_places
    robots.assert_mean(inside / points, area / (15.0 * 6.0))


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
