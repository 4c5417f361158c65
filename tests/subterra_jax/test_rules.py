"""The rules of the tasks, and the digests of everything that a score depends on."""

import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax import tasks
from subterra_jax.host.task_ids import PLANAR
from subterra_jax.lidar import LidarParams
from subterra_jax.params import digest, plain, task_figures
from subterra_jax.parts.odometer import OdometryParams
from subterra_jax.parts.slip import SlipParams, WanderParams
from subterra_jax.parts.unicycle import VehicleParams
from subterra_jax.procedural import open_world
from subterra_jax.rules import GoalParams, RewardParams, StartParams
from tests.recorded import check

TABLE = Path(__file__).with_name("values.csv")
EXACT = {
    "slip": SlipParams(0.0, 0.0, WanderParams(0.0)),
    "odometry": OdometryParams(0.0, 0.0, 0.0, 0.0, WanderParams(0.0)),
}
CENTRED = StartParams(lateral=0.0, heading=0.0)
_compiled = {}


def drive(env, params, commands, key=0):
    """Step through commands until the episode ends; the infos and the flags of the last step."""
    name = (env, jax.tree.structure(params))
    reset, step = _compiled.setdefault(name, (jax.jit(env.reset), jax.jit(env.step)))
    obs, state = reset(jax.random.key(key), params)
    infos = []
    for k, command in enumerate(commands):
        action = jnp.zeros(env.action_size).at[: len(command)].set(jnp.array(command))
        obs, state, reward, terminated, truncated, info = step(jax.random.key(k), state, action, params)
        infos.append({**jax.tree.map(np.asarray, info), "reward": float(reward)})
        if terminated or truncated:
            break
    return obs, state, infos, bool(terminated), bool(truncated)


def straight(id, **overrides):
    """A task on a straight piece, with exact motion and odometry; it starts 5 m from the mouth with a goal 12 m on."""
    piece = st.Tunnel.from_plan(st.load_tunnel("subterra-351").slice(0.0, 22.0), "smooth")
    return st.make(id, tunnel=piece, goal=GoalParams(12.0, 12.0, margin=5.0, tolerance=0.5), **EXACT, **overrides)


def to(distance):
    """Commands that drive a distance at 1 m/s and then stand."""
    return [(1.0, 0.0)] * round(distance * 10) + [(0.0, 0.0)] * 12


def test_standing_still_at_once_is_a_failure():
    env, params = straight("Subterra/StopAtShort-v1", start=CENTRED)
    _, _, infos, terminated, _ = drive(env, params, [(0.0, 0.0)] * 20)
    assert terminated
    assert len(infos) == 10
    assert not infos[-1]["success"]


def test_coming_back_counts_only_after_the_flag():
    env, params = straight("Subterra/Return-v1", start=CENTRED)
    turn = [(0.0, 1.5)] * 20 + [(0.0, (np.pi - 3.0) * 10)]
    out, back = [(1.0, 0.0)] * 120, [(1.0, 0.0)] * 120
    _, _, infos, terminated, _ = drive(env, params, out + turn + back + [(0.0, 0.0)] * 12)
    flags = [bool(info["flag"]) for info in infos]
    assert flags.index(True) in (99, 100)  # the flag is raised 2 m before the goal
    assert all(flags[flags.index(True) :])
    assert terminated
    assert infos[-1]["success"], infos[-1]
    # Stopping at the start without having been there is none.
    _, _, infos, *_ = drive(env, params, [(0.0, 0.0)] * 12)
    assert abs(float(infos[-1]["goal_error"])) < 0.1
    assert not infos[-1]["success"]


def test_relocalisation_begins_anywhere_and_either_way():
    env, params = st.make("Subterra/Relocalise-v1", tunnel="control")
    _, state = jax.jit(jax.vmap(env.reset, (0, None)))(jax.random.split(jax.random.key(0), 1000), params)
    station = np.asarray(state.station)
    length = float(params.tunnel.length)
    assert station.min() >= 95.0
    assert station.max() <= length - 95.0
    assert np.abs(np.histogram(station, 5, (95.0, length - 95.0))[0] - 200).max() < 60
    forward = np.asarray(jax.vmap(env.privileged, (0, None))(state, params)["heading_cos"]) > 0
    assert abs(forward.mean() - 0.5) < 0.06


def test_an_estimate_is_scored_and_moves_nothing():
    plain, params = st.make("Subterra/StopAtShort-v1", tunnel="subterra-351")
    judged, _ = st.make("Subterra/StopAtShort-v1", tunnel="subterra-351", estimates=True)
    _, a, _, *_ = drive(plain, params, [(1.0, 0.1)] * 3)
    _, b, infos, *_ = drive(judged, params, [(1.0, 0.1, 7.0, -1.0)] * 3)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)
    assert float(infos[-1]["estimate_error"]) == pytest.approx(7.0 - float(b.station), abs=1e-5)
    assert float(infos[-1]["estimate_log_sigma"]) == -1.0


def test_privileged_state_tells_what_observations_do_not():
    env, params = st.make("Subterra/StopAtShort-v1", tunnel="subterra-351")
    _, state = jax.jit(env.reset)(jax.random.key(0), params)
    known = env.privileged(state, params)
    assert float(known["to_goal"]) == pytest.approx(float(state.goal.station - state.station))
    assert float(known["heading_cos"]) == pytest.approx(1.0, abs=0.01)
    assert {"slip", "yaw_slip", "distance_bias"} <= set(known)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"goal": None}, "goal must be GoalParams"),
        ({"reward": RewardParams()}, "reward must be GoalRewardParams"),
        ({"tunnel": st.Tunnel.from_plan(st.load_tunnel().slice(0.0, 80.0), "smooth")}, "needs a tunnel of 90 m"),
    ],
)
def test_a_task_that_cannot_be_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        st.make("Subterra/StopAtShort-v1", **arguments)
    least = {"lidar": LidarParams(n_beams=1), "vehicle": VehicleParams(radius=0.8, speed_max=6.0)}  # just so long
    st.make("Subterra/StopAtShort-v1", tunnel=st.tunnel.from_centreline([[0.0, 0.0], [90.0, 0.0]], 2.5), **least)


HIDDEN_START_SIGMA = 3.0
BENCHMARK_SHA256 = "3a8ff9d869e9545b6181f188d9f14a2350003a07350190652b70c8b101e50ebd"


def walking_digest(id):
    """The digest of a walking task's numbers, whatever its policy."""
    _, params = st.make(id)
    leaves = jax.tree_util.tree_flatten_with_path(params)[0]
    named = {jax.tree_util.keystr(path, simple=True, separator="."): plain(leaf) for path, leaf in leaves}
    numbers = {name: value for name, value in named.items() if not re.search(r"\b(tunnel|track|tensors)\.", name)}
    return digest(numbers | {"beams": params.lidar.n_beams if id.endswith("Traverse-v1") else None})


def test_digests_are_those_that_results_are_comparable_under():
    planar = {id: st.constants_digest(*st.make(id, tunnel="control"))[:16] for id in PLANAR}
    walking = {id: walking_digest(id)[:16] for id in st.list_tasks() if id.startswith("Subterra/B2")}
    assert {*walking, *planar} == {id for id in st.list_tasks() if id.startswith("Subterra/")}
    check(TABLE, "digest", walking | planar)
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


def halved(node: Any, path: list[str]) -> Any:
    """A number, or a tree of params with one of its numbers, half as large."""
    if not path:
        return node // 2 if np.issubdtype(np.asarray(node).dtype, np.integer) else node / 2
    return node.replace(**{path[0]: halved(getattr(node, path[0]), path[1:])})


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
