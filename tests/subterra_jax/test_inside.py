"""Events inside an episode: hidden starts, ways back, late readings; the floor of what chance reaches."""

import dataclasses
import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

import subterra_jax as st
from subterra_jax.baselines.navigator import Navigator
from subterra_jax.baselines.stations import FusedCount
from subterra_jax.baselines.steering import CentreLine
from subterra_jax.evaluation import Episodes, evaluate
from subterra_jax.evaluation.floor import floor, is_above, way_back_variance, way_out_variance
from subterra_jax.parts import Part
from subterra_jax.parts.odometer import OdometryParams
from subterra_jax.parts.slip import SlipParams, WanderParams
from subterra_jax.rules import Choice

N = 2000


def begin(id, n=N, **overrides):
    """Environment, params and the first states of many episodes in a smooth bore."""
    env, params = st.make(id, tunnel="control", **overrides)

    @jax.jit
    def states(params):
        return jax.vmap(env.begin, (0, None))(env.draw_reset(jax.random.key(3), (n,), params), params)

    return env, params, states(params)


def test_a_hidden_start_is_off_by_three_metres_and_a_known_one_by_nothing():
    _, _, known = begin("Subterra/StopAt-v1")
    _, _, hidden = begin("Subterra/StopAt-v1", hidden_start=True)
    np.testing.assert_allclose(known.station, known.goal.reported, rtol=1e-6)
    off = np.asarray(hidden.station - hidden.goal.reported)
    assert off.std() == pytest.approx(2.97, rel=0.06)  # cut off at three standard deviations
    assert abs(off.mean()) < 0.25
    assert np.abs(off).max() <= 9.001


def test_the_way_back_ends_at_the_station_that_was_told():
    env, params = st.make("Subterra/Return-v1", tunnel="control", hidden_start=True)
    _, state = env.reset(jax.random.key(0), params)
    raised = {**state.parts, "goal": state.goal.replace(flag=jnp.ones(()), still=jnp.full((), 99, jnp.int32))}
    stands = lambda where: env.step(  # noqa: E731
        jax.random.key(1), state.replace(station=where, parts=raised), jnp.zeros(2), params
    )[-1]["goal_error"]
    assert float(stands(state.station)) == pytest.approx(float(state.station - state.goal.reported), abs=0.02)


def test_a_chosen_start_is_told_and_keeps_the_distance_of_the_goal():
    env, params = st.make("Subterra/StopAt-v1", tunnel="control", hidden_start=True)
    draws = env.draw_reset(jax.random.key(0), (), params)
    drawn, placed = env.begin(draws, params), env.begin({**draws, "choice": Choice(station=50.0)}, params)
    assert float(placed.station) == float(placed.goal.reported) == 50.0
    kept = float(placed.goal.station) - 50.0
    assert kept == pytest.approx(float(drawn.goal.station - drawn.goal.reported), abs=1e-3)


def test_a_heading_counts_where_a_task_draws_the_direction():
    made, params = st.make("Subterra/Relocalise-v1", tunnel="control")
    keys = jax.random.split(jax.random.key(0), 16)

    def ahead(key, choice):
        draws = {**made.draw_reset(key, (), params), "choice": choice}
        return made.privileged(made.begin(draws, params), params)["heading_cos"]

    both = jax.vmap(ahead, (0, None))
    assert set(np.sign(both(keys, Choice(station=20.0))).tolist()) == {-1.0, 1.0}
    np.testing.assert_allclose(both(keys, Choice(station=20.0, heading=0.0)), 1.0, atol=1e-4)


@pytest.mark.parametrize(("task", "field"), [("Subterra/Return-v1", "reported"), ("Subterra/Relocalise-v1", "station")])
def test_a_rule_whose_state_depends_on_the_start_brings_it_along(task, field):
    made, params = st.make(task, tunnel="control")
    draws = {**made.draw_reset(jax.random.key(0), (), params), "choice": Choice(station=17.0)}
    state = made.begin(draws, params)
    assert float(state.station) == pytest.approx(17.0)
    assert float(getattr(state.goal, field)) == pytest.approx(17.0)


def test_an_ablation_may_tell_a_wrong_ring_length():
    reported = st.rules.ReportParams(pitch_error=0.01)
    env, params = st.make("Subterra/StopAt-v1", tunnel="subterra-351", reported=reported)
    flat, _ = env.reset(jax.random.key(0), params)
    pitch = float(flat[env.fields(params)["ring_pitch"]][0])
    assert pitch == pytest.approx(1.01 * float(params.tunnel.ring_pitch))


def test_no_box_stands_at_the_start_and_many_stand_ahead():
    env, params, state = begin("Subterra/Obstructed-v1", 300)
    boxes = jax.vmap(lambda one: env.boxes(one, params)[0])(state)
    apart = np.linalg.norm(np.asarray(boxes.centre) - np.asarray(state.position)[:, None], axis=-1)
    reach = np.linalg.norm(np.asarray(boxes.half), axis=-1)
    assert (apart - reach).min() > 6.0
    assert np.mean((apart < 40.0).any(axis=1)) > 0.9


def test_sizes_of_faults_are_drawn_over_their_ranges_and_not_observed():
    env, params, state = begin("Subterra/Faulted-v1")
    scale = np.asarray(state.faults.scale)
    assert scale.min() == pytest.approx(1.0 / 3.0, abs=0.01)
    assert scale.max() == pytest.approx(5.0 / 3.0, abs=0.01)
    np.testing.assert_allclose(np.corrcoef(scale.T), np.eye(scale.shape[1]), atol=0.1)
    assert set(env.fields(params)) == {"ranges", "odometry", "goal", "ring_pitch", "start"}


def test_frozen_and_late_readings_carry_noise_and_begin_anywhere():
    env, params = st.make("Subterra/Faulted-v1", tunnel="control")
    worst = params.replace(faults=params.faults.replace(severity_low=4, severity_high=4, freeze_rate=0.2))
    where = env.fields(params)["odometry"]

    @jax.jit
    def readings(key, command):
        first, state = env.reset(key, worst)

        def step(state, key):
            flat, state, *_ = env.step(key, state, jnp.stack([command, 0.0]), worst)
            return state, (flat[where], state.faults.freeze_left)

        _, (seen, frozen) = jax.lax.scan(step, state, jax.random.split(key, 60))
        return jnp.concatenate([first[where][None], seen]), frozen

    command = jnp.repeat(jnp.array([0.0, 2.0]), 48)
    seen, frozen = jax.vmap(readings)(jax.random.split(jax.random.key(1), 96), command)
    change = np.diff(np.asarray(seen), axis=1)
    assert (np.asarray(frozen) > 0.0).mean() > 0.3
    assert not (change == 0.0).any(), "an exact zero"
    assert not (np.asarray(seen)[:, 0] == 0.0).any(), "a first reading of 0 tells that nothing is late"
    assert change[:48, :, 0].std() == pytest.approx(0.01, rel=0.05), "frozen or not, the noise of one step"


NONE = WanderParams(sigma=0.0)
DISTANCE = np.array([60.0, 150.0, 270.0])


def task(name, **overrides):
    """Params of a task in the smooth bore."""
    return st.make(f"Subterra/{name}-v1", tunnel="control", **overrides)[1]


def test_commands_alone_drift_by_their_slip():
    params = task(
        "StopAt",
        slip=SlipParams(gain_sigma=0.02, wander=NONE),
        odometry=OdometryParams(distance_sigma=1e3, wander=NONE, backward_bias_sigma=0.0),
    )
    np.testing.assert_allclose(np.sqrt(way_out_variance(DISTANCE, params)), 0.02 * DISTANCE, rtol=1e-3)


def test_a_way_back_cancels_what_lasts_and_a_flag_tells_a_hidden_start_in_part():
    lasting = {
        "slip": SlipParams(gain_sigma=0.02, wander=NONE),
        "odometry": OdometryParams(distance_sigma=1e3, wander=NONE, backward_bias_sigma=0.0),
    }
    known = way_back_variance(DISTANCE, task("Return", **lasting))
    assert (known < 1e-3).all(), "a slip that stays cancels on the way back"
    hidden = way_back_variance(DISTANCE, task("Return", hidden_start=True, **lasting))
    # The flag tells the sum of start and slip; what it leaves of the slip acts on the way back.
    left = 1.0 / (1.0 / (0.02 * DISTANCE) ** 2 + 1.0 / 3.0**2)
    np.testing.assert_allclose(np.sqrt(hidden), np.sqrt(left), rtol=0.02)


def test_two_measurements_of_one_scale_make_one_better_by_the_root_of_two():
    params = task("StopAtShort", odometry=OdometryParams(distance_sigma=1e-6, wander=NONE, backward_bias_sigma=0.0))
    goal = params.goal.replace(low=40.0, high=40.0)
    steady = params.replace(slip=params.slip.replace(wander=params.slip.wander.replace(sigma=0.0)), goal=goal)
    # Each is good to 2 %.
    assert floor(steady) == pytest.approx(math.erf(0.25 / (math.sqrt(2.0) * 0.8 / math.sqrt(2.0))), rel=2e-3)


def test_hidden_starts_and_wet_rail_lower_the_floor():
    dry = floor(task("StopAt"))
    assert 0.25 < floor(task("StopAt", hidden_start=True)) / dry < 0.75
    wet = task("Faulted")
    assert floor(wet) < 0.7 * dry
    none = wet.replace(faults=wet.faults.replace(severity_high=0))
    assert floor(none) == pytest.approx(dry, abs=0.015)
    assert floor(task("Relocalise")) == pytest.approx(0.5 * 2.0 / 161.0)


@dataclasses.dataclass(frozen=True)
class Gossip(Part):
    """A leak: the true station with 1 m of noise."""

    name: ClassVar[str] = "gossip"

    def normals(self, params):
        return 1

    def observe(self, own, sensing, noise, params):
        return {"gossip": sensing.station + noise.normal}

    def space(self, params):
        return {"gossip": (-np.inf, np.inf)}


@struct.dataclass
class Listener:
    """Dead reckoning, corrected by the gossip of the last five seconds."""

    privileged: bool = struct.field(pytree_node=False, default=False)

    def begin(self, obs: Any, params: Any) -> Any:
        return FusedCount().begin(obs, params), jnp.zeros(())

    def update(self, memory: Any, obs: Any, driven: Any, params: Any, known: Any) -> Any:
        reported, counted = FusedCount().update(memory[0], obs, driven, params, known)
        wrong = memory[1] + 0.02 * (obs.entries["gossip"][0] - reported.station - memory[1])
        return reported.replace(station=reported.station + wrong), (counted, wrong)


def test_a_station_told_with_a_metre_of_noise_is_noticed_above_the_floor():
    near = st.rules.GoalParams(low=100.0, high=120.0)
    env, params = st.make("Subterra/StopAt-v1", tunnel="control", parts=[Gossip()], estimates=True, goal=near)
    n = 64
    zero = np.zeros(n, np.int32)
    episodes = Episodes(np.arange(n, dtype=np.uint32) + 5, zero, zero, zero)
    bound = floor(params)
    for localiser, leaks in ((FusedCount(), False), (Listener(), True)):
        success = evaluate(env, params, Navigator(localiser, CentreLine()), episodes).success.mean()
        assert is_above(success, bound, n) == leaks, (type(localiser).__name__, success, bound)
