"""Starts, goals and success: docs/tasks.md, the table of tasks, "success" and "Stop"."""

import jax
import numpy as np
import pytest

import subterra_jax as st
from tests.subterra_jax.net.robots import (
    FEW,
    MANY,
    advanced,
    assert_covariance,
    assert_mean,
    begun,
    driven,
    made,
    placed,
    stand,
)

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
    state = begun(id, MANY)
    start, goal = (np.asarray(values, np.float64) for values in (state.goal.told, state.goal.station))
    way = goal - start
    assert low - 1e-3 <= way.min() < low + 0.01 * (high - low)
    assert high - 0.01 * (high - low) < way.max() <= high + 0.1
    assert_mean(way, 0.5 * (low + high))
    share = np.histogram(way, 10, (low - 1e-3, high + 0.1))[0] / len(way)
    assert np.abs(share - 0.1).max() < 4.0 * np.sqrt(0.1 * 0.9 / len(way))
    # The share of the room in front of the start is uniform from 0 to 1, whatever the way.
    room = LENGTH - 2.0 * MARGIN - way
    before = (start - MARGIN)[room > 5.0] / room[room > 5.0]
    assert before.min() > -0.01
    assert before.max() < 1.01
    assert_mean(before, 0.5)
    assert_mean(before**2, 1.0 / 3.0)


@pytest.mark.parametrize("id", ["Subterra/StopAt-v1", "Subterra/Return-v1"])
def test_robots_start_where_the_task_says(id):
    state = begun(id, MANY)
    np.testing.assert_allclose(state.station, state.goal.told, atol=1e-4)
    lateral = np.asarray(state.lateral, np.float64)
    # Uniform to either side: 0.5 m and 0.1 rad.
    off_axis = np.arcsin(np.asarray(jax.vmap(made(id)[0].privileged, (0, None))(state, made(id)[1])["heading_sin"]))
    for values, largest in ((lateral, 0.5), (off_axis, 0.1)):
        assert np.abs(values).max() < largest + 1e-5
        assert_covariance(values, values, largest**2 / 3.0)


def errors_about(tolerance, n):
    """Errors just inside and just outside of a tolerance, to either side, and which are inside."""
    error = np.tile([-tolerance - 0.02, -tolerance + 0.02, tolerance - 0.02, tolerance + 0.02], n // 4)
    return error, np.abs(error) < tolerance


@pytest.mark.parametrize("id", WITH_GOAL)
def test_a_stop_counts_within_1_metre_and_within_25_centimetres_in_the_short_tasks(id):
    tolerance = 0.25 if "Short" in id else 1.0
    state, report = begun(id, FEW), None
    error, inside = errors_about(tolerance, FEW)
    if "Relocalise" in id:
        state = placed(id, state, state.station)
        report = np.asarray(state.station) + error
    else:
        target = state.goal.station
        if "Return" in id:
            state, target = advanced(id, placed(id, state, target), np.zeros(2))[0], state.goal.told
        state = placed(id, state, target + error)
    _, _, early, before = stand(id, state, 9 if "Return" not in id else 8, report)
    assert not before["stopped"].any()
    assert not (early & ~before["contact"]).any()
    _, _, ended, info = stand(id, state, 10, report)
    free = ~info["contact"]
    assert free.mean() > (0.8 if "Obstructed" in id else 0.999)
    assert ended.all()
    assert info["stopped"][free].all()
    np.testing.assert_array_equal(info["success"], inside & free)


def test_a_report_of_the_wrong_direction_is_no_success():
    id = "Subterra/Relocalise-v1"
    state = begun(id, FEW)
    state = placed(id, state, state.station, backward=True)
    _, _, ended, info = stand(id, state, 10, np.asarray(state.station))
    assert ended.all()
    assert not info["success"].any()


def test_the_flag_is_raised_within_2_metres_of_the_goal():
    id = "Subterra/Return-v1"
    state = begun(id, FEW)
    error, inside = errors_about(2.0, FEW)
    _, _, _, info = stand(id, placed(id, state, state.goal.station + error), 1)
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
    state = placed(id, begun(id, FEW), 100.0)
    for k in range(10):
        state, _, _, _, info = advanced(id, state, command, key=k)
    # The speed that counts is the true one: it slips by 3 %.
    assert np.mean(info["stopped"]) == (1.0 if stands else 0.0)


def test_a_robot_that_has_not_reported_within_60_metres_has_failed():
    id, limit = "Subterra/Relocalise-v1", 60.0
    state, travelled, ended = begun(id, FEW), np.zeros(FEW), np.zeros(FEW, bool)
    # Back and forth over 20 m: the limit is of the distance, wherever it is driven.
    for k in range(round(limit / 20.0) + 1):
        state, series = driven(id, placed(id, state, 20.0), 100, key=k)
        for moved, terminated in zip(series["moved"], series["terminated"], strict=True):
            travelled = np.where(ended, travelled, travelled + moved)
            ended |= terminated > 0.0
        assert not series["success"].any()
    assert ended.all()
    # The step that ends an episode is the one that leads beyond the limit.
    assert travelled.min() > limit - 0.01
    assert travelled.max() < limit + 0.25
