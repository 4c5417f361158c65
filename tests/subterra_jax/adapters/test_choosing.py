"""Starts and goals that a caller chooses, and the sentences for those that cannot be."""

import jax
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.adapters.choosing import OptionError, read_choice
from subterra_jax.adapters.single import SubterraEnv
from subterra_jax.rules import Choice, GoalParams

pytestmark = pytest.mark.door

STOP, RETURN, RELOCALISE = "Subterra/StopAtShort-v1", "Subterra/Return-v1", "Subterra/Relocalise-v1"
# Room for goals from 5 to 60 m.
PIECE = st.load_tunnel("subterra-351").slice(0.0, 65.0)
WORLD = {"tunnel": PIECE, "goal": GoalParams(low=10.0, high=50.0, margin=5.0, tolerance=0.25)}
AHEAD = np.array([1.0, 0.0], np.float32)


@pytest.fixture(scope="module")
def env():
    return SubterraEnv(STOP, **WORLD)


def test_goal_and_start_are_where_they_were_asked_for(env):
    start = {"station": 20.0, "lateral": -0.25, "heading": np.pi}
    obs, _ = env.reset(seed=3, options={"goal": 40.0, "start": start})
    assert obs["goal"] == pytest.approx(40.0)
    state = env.state
    assert [float(state.station), float(state.lateral)] == pytest.approx([20.0, -0.25])
    info = env.step(AHEAD)[-1]
    assert info["station"] < 19.95, "it faces the mouth"
    assert info["lateral"] == pytest.approx(-0.25, abs=0.02)
    assert obs["odometry"][0] == 0.0, "the odometer does not know"
    assert obs["start"] == pytest.approx(20.0), "the task reports it"


def test_a_heading_turns_to_the_left(env):
    env.reset(seed=3, options={"start": {"station": 20.0, "lateral": 0.0, "heading": 0.5}})
    info = env.step(AHEAD)[-1]
    assert info["lateral"] == pytest.approx(0.1 * np.sin(0.5), abs=0.015)
    assert info["station"] == pytest.approx(20.0 + 0.1 * np.cos(0.5), abs=0.015)


def test_a_heading_counts_where_a_task_draws_the_direction():
    made, params = st.make(RELOCALISE, tunnel="control")
    keys = jax.random.split(jax.random.key(0), 16)

    def ahead(key, choice):
        draws = {**made.draw_reset(key, (), params), "choice": choice}
        return made.privileged(made.begin(draws, params), params)["heading_cos"]

    both = jax.vmap(ahead, (0, None))
    assert set(np.sign(both(keys, Choice(station=20.0))).tolist()) == {-1.0, 1.0}
    np.testing.assert_allclose(both(keys, Choice(station=20.0, heading=0.0)), 1.0, atol=1e-4)


def test_what_is_not_chosen_is_drawn_as_ever_and_the_next_episode_is_free(env):
    drawn, _ = env.reset(seed=3)
    free, bias = env.state, float(env.state.odometry.distance_bias)
    second, _ = env.reset()
    asked, _ = env.reset(seed=3, options={"goal": 40.0})
    assert float(env.state.odometry.distance_bias) == bias
    np.testing.assert_array_equal(env.state.position, free.position)
    np.testing.assert_allclose(asked["ranges"], drawn["ranges"], atol=1e-3)
    assert asked["goal"] != drawn["goal"]
    np.testing.assert_array_equal(env.reset()[0]["goal"], second["goal"])


def test_a_stop_at_a_chosen_goal_succeeds(env):
    env.reset(seed=0, options={"goal": 12.0, "start": {"station": 12.0, "lateral": 0.0, "heading": 0.0}})
    for _ in range(10):
        *_, terminated, _, info = env.step(np.zeros(2))
    assert terminated
    assert info["success"]
    assert info["goal_error"] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(("task", "field"), [(RETURN, "told"), (RELOCALISE, "station")])
def test_a_rule_whose_state_depends_on_the_start_brings_it_along(task, field):
    made, params = st.make(task, tunnel="control")
    draws = {**made.draw_reset(jax.random.key(0), (), params), "choice": Choice(station=17.0)}
    state = made.begin(draws, params)
    assert float(state.station) == pytest.approx(17.0)
    assert float(getattr(state.goal, field)) == pytest.approx(17.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gaol": 3.0}, r"no option 'gaol' in a reset of Subterra/StopAtShort-v1; there are 'goal' and 'start'"),
        ({"start": {"speed": 1.0}}, r"no 'speed' in options\['start'\]; there are station, lateral, heading"),
        ({"goal": 62.0}, r"options\['goal'\] must lie from 5.00 to 60.00 m here, got 62"),
        ({"goal": -1.0}, "must lie from 5.00 to 60.00 m here, got -1"),
        ({"goal": np.inf}, "must lie from 5.00 to 60.00 m here, got inf"),
        ({"start": 66.0}, r"options\['start'\] must lie from 0.00 to 65.00 m here, got 66"),
        ({"start": {"heading": 4.0}}, "heading in .* must lie from -3.14 to 3.14 rad here, got 4"),
        ({"goal": "far"}, r"options\['goal'\] must be one number, got 'far'"),
        ({"goal": [3.0, 4.0]}, "must be one number, got"),
        ({"start": {"station": 20.0, "lateral": 2.5}}, "at 20 m, 2.5 m to the left .* would touch a wall"),
        ({"start": {"station": 20.0, "lateral": -9.0}}, "would touch a wall"),
        ({"start": {"lateral": 9.0}}, "at the drawn station, 9 m to the left .* would touch a wall"),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence_and_nothing_changes(env, options, message):
    env.reset(seed=1)
    before = jax.tree.leaves(env.state)
    with pytest.raises(OptionError, match=message) as caught:
        env.reset(options=options)
    assert isinstance(caught.value, st.SubterraError)
    assert "\n" not in str(caught.value)
    for leaf, was in zip(jax.tree.leaves(env.state), before, strict=True):
        np.testing.assert_array_equal(leaf, was)


@pytest.mark.parametrize("task", ["Subterra/TraverseShort-v1", RELOCALISE])
def test_a_task_without_a_goal_says_so(task):
    with pytest.raises(OptionError, match=f"{task} has no goal to choose; its options may hold 'start' alone"):
        read_choice(*st.make(task, tunnel="control"), {"goal": 10.0})
