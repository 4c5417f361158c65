"""The floor: known answers, and a station that was reported is noticed above it."""

import dataclasses
import math
from typing import Any, ClassVar

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
        told, counted = FusedCount().update(memory[0], obs, driven, params, known)
        wrong = memory[1] + 0.02 * (obs.entries["gossip"][0] - told.station - memory[1])
        return told.replace(station=told.station + wrong), (counted, wrong)


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
