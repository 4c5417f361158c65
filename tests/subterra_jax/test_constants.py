"""The constants that define the benchmark are those of today: by digest.

Who changes one on purpose, as docs/tasks.md has it, changes it here too, and scores from before are no longer
comparable. A digest holds every number of a task under its key, its rule and its parts.
"""

import re
from typing import Any

import jax
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax import tasks
from subterra_jax.host.task_ids import PLANAR
from subterra_jax.params import digest, plain, task_figures
from subterra_jax.procedural import open_world
from subterra_jax.rules import StartParams

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
WALKING = {"Subterra/B2Traverse-v1": "7fe4ac807ec38ee0", "Subterra/B2Walk-v1": "517ad6beb9d94cfd"}
HIDDEN_START_SIGMA = 3.0
BENCHMARK_SHA256 = "f396508d37329b3bfdfd0b11ad7e8da59c47b80d67d6efb177b004999848e6fa"


def halved(node: Any, path: list[str]) -> Any:
    """A number, or a tree of params with one of its numbers, half as large."""
    if not path:
        return node // 2 if np.issubdtype(np.asarray(node).dtype, np.integer) else node / 2
    return node.replace(**{path[0]: halved(getattr(node, path[0]), path[1:])})


def test_every_task_is_listed():
    assert {*WALKING, *DIGESTS} == {id for id in st.list_tasks() if id.startswith("Subterra/")}


@pytest.mark.parametrize("id", DIGESTS)
def test_the_digest_of_a_task_is_the_one_that_results_are_comparable_under(id):
    assert st.constants_digest(*st.make(id, tunnel="control"))[:16] == DIGESTS[id]


@pytest.mark.parametrize("id", WALKING)
def test_a_walking_task_has_its_numbers_whatever_its_policy(id):
    _, params = st.make(id)
    leaves = jax.tree_util.tree_flatten_with_path(params)[0]
    named = {jax.tree_util.keystr(path, simple=True, separator="."): plain(leaf) for path, leaf in leaves}
    numbers = {name: value for name, value in named.items() if not re.search(r"\b(tunnel|track|tensors)\.", name)}
    numbers["beams"] = params.lidar.n_beams if id.endswith("Traverse-v1") else None
    assert digest(numbers)[:16] == WALKING[id], numbers


def test_a_renamed_field_keeps_its_key(monkeypatch):
    env, params = st.make("Subterra/StopAt-v1", tunnel="control")
    monkeypatch.setattr("subterra_jax.params.RENAMED", {"goal.low": "goal.least", "slip": "skid"})
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
