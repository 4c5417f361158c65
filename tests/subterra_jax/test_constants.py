"""Every constant that defines the benchmark, written down a second time.

The numbers below are literal: none is read from the code. Their source is the task design, as docs/tasks.md has it. A
number that a task does not use is not listed for it. Who changes one on purpose changes it here too, and the digest
with it, and scores from before are no longer comparable.
"""

import functools
import hashlib
import json
from typing import Any

import numpy as np
import pytest

import subterra_jax as st
from subterra_jax import tasks
from subterra_jax.procedural import open_world

Value = float | int | list[float] | None

ROBOT: dict[str, Value] = {
    "vehicle.speed_max": 2.0,
    "vehicle.yaw_rate_max": 1.5,
    "vehicle.radius": 0.4,
    "vehicle.period": 0.1,
    "lidar.range_max": 30.0,
    "lidar.range_sigma": 0.05,
    "lidar.n_beams": 16,
    "start.lateral": 0.5,
    "start.heading": 0.1,
}
ODOMETER: dict[str, Value] = {
    "odometry.distance_sigma": 0.01,
    "odometry.distance_bias_sigma": 0.02,
    "odometry.heading_sigma": 0.001,
    "odometry.heading_bias_sigma": 0.002,
}
TRAVERSE: dict[str, Value] = {
    **ROBOT,
    **ODOMETER,
    "odometry.wander": None,
    "odometry.backward_bias_sigma": None,
    "slip": None,
    "goal": None,
    "obstacles": None,
    "faults": None,
    "start.station": 0.0,
    "goal_coverage": 0.9,
    "reward.terminal": 1.0,
    "reward.coverage": 100.0,
    "reward.lateral": 0.1,
    "reward.jerk": 0.01,
}
WITH_GOAL: dict[str, Value] = {
    **ROBOT,
    **ODOMETER,
    "odometry.wander.sigma": 0.01,
    "odometry.wander.length": 30.0,
    "odometry.backward_bias_sigma": 0.02,
    "slip.gain_sigma": 0.02,
    "slip.yaw_sigma": 0.002,
    "slip.wander.sigma": 0.02,
    "slip.wander.length": 30.0,
    "reward.terminal": 4.0,
    "reward.precision": 4.0,
    "reward.miss": 0.05,
    "reward.crash": 1.0,
    "reward.progress": 0.05,
    "reward.time": 0.002,
    "reward.lateral": 0.01,
    "reward.jerk": 0.003,
    "goal.margin": 5.0,
    "goal.still_speed": 0.05,
    "goal.still_yaw": 0.5,
    "goal.still_steps": 10,
}
LONG: dict[str, Value] = {"goal.tolerance": 1.0}
SHORT: dict[str, Value] = {"goal.tolerance": 0.25}
LONG_GOALS: dict[str, Value] = {**LONG, "goal.low": 60.0, "goal.high": 320.0}
SHORT_GOALS: dict[str, Value] = {**SHORT, "goal.low": 10.0, "goal.high": 60.0}
AT_MOUTH: dict[str, Value] = {"start.station": 0.0, "start.station_sigma": 0.0}
HIDDEN_START: dict[str, Value] = {"start.station": 9.0, "start.station_sigma": 3.0}
RETURN: dict[str, Value] = {"start.station": 5.0, "start.station_sigma": 0.0, "goal.flag_reach": 2.0}
CLEAR: dict[str, Value] = {"obstacles": None, "faults": None}
BOXES: dict[str, Value] = {
    "obstacles.size_min": 0.3,
    "obstacles.size_max": 0.8,
    "obstacles.gap": 1.2,
    "obstacles.first": 8.0,
    "obstacles.trolley_length": 2.4,
    "obstacles.trolley_width": 1.2,
    "faults": None,
}
FAULTS: dict[str, Value] = {
    "faults.severity_low": 0,
    "faults.severity_high": 4,
    "faults.dropout_rate": 0.02,
    "faults.dropout_share": 0.75,
    "faults.dropout_steps": 40.0,
    "faults.dust_rate": 0.15,
    "faults.freeze_rate": 0.01,
    "faults.freeze_steps": 30.0,
    "faults.delay": 4.0,
    "faults.wet_share": 0.3,
    "faults.wet_loss": 0.3,
    "obstacles": None,
}
WALKING_MISSION: dict[str, Value] = {
    **ODOMETER,
    "odometry.distance_bias_sigma": 0.0,  # its legs measure the distance, with errors of their own
    "vehicle.speed_max": 0.8,
    "vehicle.yaw_rate_max": 0.8,
    "vehicle.radius": 0.4,
    "vehicle.period": 0.2,
    "lidar.range_max": 30.0,
    "lidar.range_sigma": 0.05,
    "lidar.n_beams": 16,
    "start.station": 2.0,
    "start.lateral": 0.3,
    "start.heading": 0.1,
    "goal_coverage": 0.9,
    "reward.terminal": 1.0,
    "reward.coverage": 100.0,
    "reward.lateral": 0.1,
    "reward.jerk": 0.01,
    "horizon": 4000,
}
WALKING: dict[str, Value] = {
    "command.low": [-0.4, -0.3, -0.8],
    "command.high": [1.2, 0.3, 0.8],
    "command.hold": 4.0,
    "command.still": 0.15,
    "command.corridor": 0.25,
    "randomisation.friction": [0.4, 1.0],
    "randomisation.mass": [0.8, 1.05],
    "randomisation.shift": [0.04, 0.02, 0.02],
    "randomisation.gain": [0.9, 1.1],
    "randomisation.push": 0.5,
    "randomisation.push_every": 5.0,
    "sensor.rate": 0.2,
    "sensor.gravity": 0.03,
    "sensor.angle": 0.02,
    "sensor.speed": 0.5,
    "reward.velocity": 2.0,
    "reward.yaw_rate": 1.0,
    "reward.width": 0.25,
    "reward.alive": 0.5,
    "reward.bounce": -1.0,
    "reward.roll": -0.05,
    "reward.tilt": -2.0,
    "reward.effort": -5e-6,
    "reward.jerk": -0.02,
    "reward.action": -0.02,
    "reward.slip": -0.05,
    "reward.fall": -4.0,
    "action_scale": [0.2, 0.3, 0.3],
    "horizon": 1000,
    "fall_height": 0.25,
    "fall_tilt": 1.0,
}
INSIDE: dict[str, Value] = {
    **WITH_GOAL,
    **LONG,
    "goal.margin": 40.0,
    "goal.low": 60.0,
    "goal.high": 320.0,
    "goal.flag_reach": 2.0,
    "start.station_sigma": 0.0,
    "told.pitch_error": 0.0,
}
HIDDEN: dict[str, Value] = {"start.station_sigma": 3.0}
DRAWN_FAULTS: dict[str, Value] = {
    **FAULTS,
    "faults.dropout_share": 0.5,
    "faults.delay": 2.4,
    "faults.spread": 2.0 / 3.0,
    "faults.origin_distance": 0.05,
    "faults.origin_heading": 0.005,
}
TABLE: dict[str, dict[str, Value]] = {
    "Subterra/Traverse-v0": {**TRAVERSE, "horizon": 3000},
    "Subterra/TraverseShort-v0": {**TRAVERSE, "horizon": 600},
    "Subterra/StopAt-v0": {**WITH_GOAL, **LONG_GOALS, **AT_MOUTH, **CLEAR, "horizon": 4000},
    "Subterra/StopAtShort-v0": {**WITH_GOAL, **SHORT_GOALS, **AT_MOUTH, **CLEAR, "horizon": 1000},
    "Subterra/StopAtOffset-v0": {**WITH_GOAL, **LONG_GOALS, **HIDDEN_START, **CLEAR, "horizon": 4000},
    "Subterra/StopAtOffsetShort-v0": {
        **WITH_GOAL,
        **SHORT_GOALS,
        "goal.low": 20.0,
        **HIDDEN_START,
        **CLEAR,
        "horizon": 1000,
    },
    "Subterra/Return-v0": {**WITH_GOAL, **LONG_GOALS, **RETURN, **CLEAR, "horizon": 8000},
    "Subterra/ReturnShort-v0": {**WITH_GOAL, **SHORT_GOALS, **RETURN, **CLEAR, "horizon": 2000},
    "Subterra/Obstructed-v0": {**WITH_GOAL, **LONG_GOALS, **AT_MOUTH, **BOXES, "horizon": 4000},
    "Subterra/ObstructedShort-v0": {**WITH_GOAL, **SHORT_GOALS, **AT_MOUTH, **BOXES, "horizon": 1000},
    "Subterra/Faulted-v0": {**WITH_GOAL, **LONG_GOALS, **AT_MOUTH, **FAULTS, "horizon": 4000},
    "Subterra/FaultedShort-v0": {**WITH_GOAL, **SHORT_GOALS, **AT_MOUTH, **FAULTS, "horizon": 1000},
    "Subterra/Relocalise-v0": {**WITH_GOAL, **LONG, **CLEAR, "goal.travel_max": 120.0, "horizon": 2000},
    "Subterra/RelocaliseShort-v0": {**WITH_GOAL, **SHORT, **CLEAR, "goal.travel_max": 40.0, "horizon": 1000},
    "Subterra/StopAt-v1": {**INSIDE, **CLEAR, "horizon": 4000},
    "Subterra/Return-v1": {**INSIDE, **CLEAR, "horizon": 8000},
    "Subterra/Obstructed-v1": {**INSIDE, **BOXES, "horizon": 4000},
    "Subterra/Faulted-v1": {**INSIDE, **DRAWN_FAULTS, "horizon": 4000},
    "Subterra/StopAtOffset-v1": {**INSIDE, **CLEAR, **HIDDEN, "horizon": 4000},
    "Subterra/ReturnOffset-v1": {**INSIDE, **CLEAR, **HIDDEN, "horizon": 8000},
    "Subterra/ObstructedOffset-v1": {**INSIDE, **BOXES, **HIDDEN, "horizon": 4000},
    "Subterra/FaultedOffset-v1": {**INSIDE, **DRAWN_FAULTS, **HIDDEN, "horizon": 4000},
    "Subterra/StopAtShort-v1": {
        **INSIDE,
        **CLEAR,
        "goal.low": 10.0,
        "goal.high": 60.0,
        "goal.tolerance": 0.25,
        "horizon": 1000,
    },
    "Subterra/Relocalise-v1": {
        **WITH_GOAL,
        **LONG,
        **CLEAR,
        "goal.margin": 95.0,
        "goal.travel_max": 60.0,
        "horizon": 2000,
    },
    "Subterra/B2Traverse-v0": WALKING_MISSION,
    "Subterra/B2Walk-v0": WALKING,
}
# m: the whole packaged tunnel, or its first metres.
LENGTHS = {"Subterra/TraverseShort-v0": 60.0} | {
    name: 65.0 for name in TABLE if "Short-v0" in name and "Trav" not in name
}
SHA256 = "c60f594132b7d16b611d10e51dc1adaafe8f00aac06ae8af253f8f70766bb891"
VERSION_1_SHA256 = "10843af873f83497ba645cf3d882f05ea2b9973a6571829b014f71f05ee68ace"
BENCHMARK_SHA256 = "83b420fe7ff1f64a0aee373733478697f68eade60d249f8c3393ff29f9b263bb"


def canonical(table: dict[str, dict[str, Value]]) -> str:
    """The table as JSON in one spelling: sorted, without spaces."""
    return json.dumps(table, sort_keys=True, separators=(",", ":"))


def read(params: object, name: str) -> object:
    """A constant by its dotted name; None where the task has no such part."""
    try:
        return functools.reduce(getattr, name.split("."), params)
    except AttributeError:
        return None


def halved(node: Any, path: list[str]) -> Any:
    """A number, or a tree of params with one of its numbers, half as large."""
    if not path:
        return node // 2 if np.issubdtype(np.asarray(node).dtype, np.integer) else node / 2
    return node.replace(**{path[0]: halved(getattr(node, path[0]), path[1:])})


def test_the_table_lists_every_task():
    assert set(TABLE) - {"Subterra/B2Traverse-v0", "Subterra/B2Walk-v0"} == set(st.TASKS)


def test_the_table_itself_is_the_one_that_was_agreed_on():
    assert hashlib.sha256(canonical(TABLE).encode()).hexdigest() == SHA256


@pytest.mark.parametrize("id", sorted(TABLE))
def test_a_task_has_the_constants_of_the_table(id):
    _, params = st.make(id)
    wrong = {}
    for name, expected in TABLE[id].items():
        value = read(params, name)
        if expected is None or value is None:
            right = expected is value
        else:
            # Parameters are float32.
            right = np.shape(value) == np.shape(expected) and bool(np.allclose(value, expected, rtol=1e-6, atol=0.0))
        if not right:
            wrong[name] = (value if value is None else np.asarray(value).tolist(), expected)
    assert not wrong, f"{id}: constant: (in the code, in the table): {wrong}"


def test_the_digest_of_the_benchmark_is_the_one_that_results_are_comparable_under():
    assert st.constants_digest() == BENCHMARK_SHA256
    assert st.constants_digest(version="v1") == VERSION_1_SHA256


def test_half_of_a_number_of_the_open_world_is_another_digest(monkeypatch):
    for name, value in (("LENGTH", (150.0, 3000.0)), ("HELD_OUT", {}), ("GRADE_SD", 0.005), ("_HALF", 0.25)):
        with monkeypatch.context() as patched:
            patched.setattr(open_world, name, value)
            tasks._benchmark_digest.cache_clear()
            assert st.constants_digest(version="v1") != VERSION_1_SHA256, name
            assert st.constants_digest() == BENCHMARK_SHA256, "version 0 has no open world in it"
    tasks._benchmark_digest.cache_clear()


@pytest.mark.parametrize(
    "id",
    [
        "Subterra/Traverse-v0",
        "Subterra/StopAtOffsetShort-v0",
        "Subterra/Return-v0",
        "Subterra/Obstructed-v0",
        "Subterra/Faulted-v0",
        "Subterra/Relocalise-v0",
        "Subterra/FaultedOffset-v1",
        "Subterra/Obstructed-v1",
        "Subterra/Relocalise-v1",
    ],
)
def test_half_of_any_constant_is_another_digest(id):
    env, params = st.make(id)
    digest = st.constants_digest(env, params)
    assert st.constants_digest(*st.make(id, tunnel=params.tunnel)) == digest
    for name, value in TABLE[id].items():
        if not value or name == "vehicle.radius":  # half a radius is refused
            continue
        field, *path = name.split(".")
        changed = halved(getattr(params, field), path)
        assert st.constants_digest(*st.make(id, tunnel=params.tunnel, **{field: changed})) != digest, name


@pytest.mark.parametrize("id", sorted(LENGTHS))
def test_a_short_task_happens_in_the_first_metres_of_the_tunnel(id):
    assert float(st.make(id)[1].tunnel.length) == pytest.approx(LENGTHS[id])
