"""The constants that define the benchmark are those of today: by digest, and of walking by a second list.

Who changes one on purpose, as docs/tasks.md has it, changes it here too, and scores from before are no longer
comparable. A digest holds every number of a task under its key, its rule and its parts.
"""

import functools
from typing import Any

import numpy as np
import pytest

import subterra_jax as st
from subterra_jax import digest, tasks
from subterra_jax.digest import task_figures
from subterra_jax.host.task_ids import PLANAR
from subterra_jax.procedural import open_world
from subterra_jax.rules import StartParams

Value = float | int | list[float] | None

WALKING_MISSION: dict[str, Value] = {
    "odometry.distance_sigma": 0.0,  # its legs and its gyroscope err by themselves
    "odometry.heading_sigma": 0.0,
    "odometry.heading_bias_sigma": 0.002,
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
TABLE: dict[str, dict[str, Value]] = {"Subterra/B2Traverse-v1": WALKING_MISSION, "Subterra/B2Walk-v1": WALKING}
DIGESTS = {
    "Subterra/Traverse-v1": "425ea144b6809fb4",
    "Subterra/TraverseShort-v1": "b9b53e90bb772d38",
    "Subterra/StopAt-v1": "561121aa0c3ff011",
    "Subterra/StopAtShort-v1": "7384db4fcdf0819e",
    "Subterra/Return-v1": "5101ca828506f2a1",
    "Subterra/Obstructed-v1": "247a99b0490ad2b8",
    "Subterra/Faulted-v1": "181729850a60a5dd",
    "Subterra/Relocalise-v1": "16bc3a11113586e4",
}
HIDDEN_START_SIGMA = 3.0
BENCHMARK_SHA256 = "f396508d37329b3bfdfd0b11ad7e8da59c47b80d67d6efb177b004999848e6fa"


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


def test_every_task_is_listed():
    assert {*TABLE, *DIGESTS} == {id for id in st.list_tasks() if id.startswith("Subterra/")}


@pytest.mark.parametrize("id", DIGESTS)
def test_the_digest_of_a_task_is_the_one_that_results_are_comparable_under(id):
    assert st.constants_digest(*st.make(id, tunnel="control"))[:16] == DIGESTS[id]


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


def test_a_renamed_field_keeps_its_key(monkeypatch):
    env, params = st.make("Subterra/StopAt-v1", tunnel="control")
    monkeypatch.setattr(digest, "RENAMED", {"goal.low": "goal.least", "slip": "skid"})
    found = task_figures(env, params)
    assert {"goal.least", "skid.gain_sigma"} <= set(found["numbers"])
    assert "goal.low" not in found["numbers"]
    assert "skid" in found["parts"]


def test_the_digest_of_the_benchmark_is_the_one_that_results_are_comparable_under():
    assert st.constants_digest() == BENCHMARK_SHA256


def test_a_hidden_start_is_off_by_the_agreed_length_and_nothing_else_changes():
    for id in PLANAR:
        if id.split("/")[1] in ("Traverse-v1", "TraverseShort-v1", "Relocalise-v1"):
            with pytest.raises(ValueError, match=f"{id} reports no start that could be hidden; these do: .*StopAt-v1"):
                st.make(id, tunnel="control", hidden_start=True)
            continue
        plain, hidden = (task_figures(*st.make(id, "control", hidden_start=wish))["numbers"] for wish in (False, True))
        assert hidden == {**plain, "start.station_sigma": HIDDEN_START_SIGMA}
    with pytest.raises(ValueError, match="hidden_start and start exclude each other"):
        st.make("Subterra/StopAt-v1", "control", hidden_start=True, start=StartParams(lateral=0.1))


def test_half_of_a_number_of_the_open_world_is_another_digest(monkeypatch):
    for name, value in (("LENGTH", (150.0, 3000.0)), ("HELD_OUT", {}), ("GRADE_SD", 0.005), ("_HALF", 0.25),
                        ("MOUNT_TILT", 0.01)):  # fmt: skip
        with monkeypatch.context() as patched:
            patched.setattr(open_world, name, value)
            tasks._benchmark_digest.cache_clear()
            assert st.constants_digest() != BENCHMARK_SHA256, name
    tasks._benchmark_digest.cache_clear()


@pytest.mark.parametrize("id", [f"Subterra/{name}-v1" for name in ("Traverse", "Obstructed", "Faulted", "Relocalise")])
def test_half_of_any_constant_is_another_digest(id):
    env, params = st.make(id, tunnel="subterra-351")
    before = st.constants_digest(env, params)
    assert st.constants_digest(*st.make(id, tunnel=params.tunnel)) == before
    for name, value in task_figures(env, params)["numbers"].items():
        if not value or name == "vehicle.radius":  # half a radius is refused
            continue
        field, *path = name.split(".")
        changed = halved(getattr(params, field), path)
        assert st.constants_digest(*st.make(id, tunnel=params.tunnel, **{field: changed})) != before, name
