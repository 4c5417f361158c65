"""Learnt localisers: their memory, the robot's metres against those of training, tensors, tasks, the way back."""

import dataclasses
from contextlib import nullcontext
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

import subterra_jax as st
from subterra_jax.baselines.agent import Observed
from subterra_jax.baselines.stations import Driven, Station
from subterra_jax.baselines.steering import Corridor
from subterra_jax.policies import PolicyError, check_fits, from_tensors, training_conditions
from subterra_jax.policies.locate import bends, map_filter, memory, streams
from subterra_jax.policies.locate.blocks import DELAY, Estimate
from subterra_jax.policies.locate.locator import Locator
from subterra_jax.policies.locate.map_strip import map_strip
from subterra_jax.policies.locate.profiles import BIN
from subterra_jax.policies.locate.ways import TwoWays
from subterra_jax.policies.trained import flat
from subterra_jax.tunnel import Tunnel
from tests.subterra_jax.patches import HALF, N_METRES, drive_past, map_of_walls, patches


def _ranges(driven, fraction=0.01):
    """Scans of 16 beams by a robot that keeps to the middle; the ends of the tunnel are out of sight."""
    angle = 2.0 * np.pi * np.arange(16) / 16
    side = np.where(np.abs(np.sin(angle)) < 0.1, np.nan, np.abs(np.sin(angle)))
    along = HALF * np.cos(angle) / side
    station = (1.0 + fraction) * driven[:, None] + along + np.where(np.sin(angle) > 0.0, 0.0, 7.3)
    noise = 0.02 * np.random.default_rng(5).standard_normal(station.shape)
    return np.where(np.isnan(side), 30.0, (HALF + patches(station) + noise) / np.where(np.isnan(side), 1.0, side))


def _looked_at(ranges, driven, walls):
    """Returns the points of a drive as they are recorded in training."""
    params = SimpleNamespace(lidar=SimpleNamespace(range_max=30.0, intensity=False))
    moved = jnp.asarray(np.diff(driven, prepend=driven[:1]))

    def step(bend, row):
        seen = Observed(row[0], row[0], distance=jnp.zeros(()), heading=jnp.zeros(()))
        points, bend = bends.look(bend, seen, walls, row[1], params)
        return bend, points

    return jax.lax.scan(step, jnp.zeros(()), (ranges, moved))[1]


@pytest.mark.parametrize(("front", "with_map"), [("match", True), pytest.param("wide", False, marks=pytest.mark.slow)])
def test_a_robot_makes_the_metres_of_its_training(front, with_map):
    rng = np.random.default_rng(7)
    speed = np.where(np.arange(240) % 9 < 7, 2.0, 0.7)  # not all metres have five steps
    speed[0] = 0.0
    driven = np.cumsum((0.1 * speed).astype(np.float32))  # in 32 bits, as the robot sums
    ranges = jnp.asarray(_ranges(driven), jnp.float32)
    read = jnp.asarray(np.cumsum(0.1 * speed * 1.02 + 0.01 * rng.standard_normal(240)) + 5.0, jnp.float32)
    walls = Corridor(jnp.float32(HALF), jnp.float32(HALF), jnp.float32(0.0))
    points = _looked_at(ranges, driven, walls)
    weights = memory.init(front, jax.random.key(4), with_map)
    n = int(driven[-1])
    record = streams.Record(jnp.asarray(driven, jnp.float32), read, points)
    whole = memory.sequence(weights, streams.metres(record, weights["match"], n))
    strip = map_of_walls(first=-3.0 - 0.7) if with_map else None  # reported 0.7 m too far back
    if strip is not None:
        age = jnp.arange(1.0, n + 1.0)
        passed, rate = memory.passed(whole, age), memory.log_rate(whole, age)
        seen, reported, sure = streams.profiles_of(record, n), jnp.float32(3.0), jnp.float32(0.0)
        beliefs = map_filter.sequence(weights["map"], seen, streams.BEFORE, strip.pick(0), reported, sure, passed, rate)
        whole = jax.vmap(map_filter.corrected, (0, 0, 0, None))(beliefs, whole, age, sure)
    params = SimpleNamespace(
        goal_kind="stop",
        tunnel=SimpleNamespace(first_node=jnp.zeros((), jnp.int32)),
        start=SimpleNamespace(station=3.0, station_sigma=0.0),
        vehicle=SimpleNamespace(period=0.1),
        lidar=SimpleNamespace(range_max=30.0, intensity=False),
    )
    locator, one, no = Locator(weights, strip), jnp.ones(()), jnp.zeros((), bool)

    def step(now, row):
        r, distance, v = row
        obs = Observed(r, r, distance=distance, heading=jnp.zeros(()))
        station, now = locator.update(now, obs, Driven(v, one, one, no, walls), params, None)
        return now, (now.metres, now.estimate.correction, station.station)

    first = Observed(ranges[0], ranges[0], distance=read[0], heading=jnp.zeros(()))
    _, (metres, correction, station) = jax.lax.scan(
        step, locator.begin(first, params), (ranges, read, jnp.asarray(speed, jnp.float32))
    )
    ends = np.flatnonzero(np.diff(np.asarray(metres)) > 0) + 1
    assert len(ends) == n
    np.testing.assert_allclose(np.asarray(correction)[ends], np.asarray(whole.correction), atol=2e-3)
    assert abs(float(station[-1]) - 3.0 - driven[-1]) < 2.0
    assert np.ptp(np.asarray(whole.correction)) > 0.02  # there is something to compare


LAYOUT = {"action_low": [0.0, -1.5], "action_high": [2.0, 1.5]}


def test_tensors_of_a_localiser_come_back_as_an_agent_or_are_refused():
    tensors = flat(memory.init("match", jax.random.key(0)))
    from_tensors("locate", LAYOUT, tensors, "one").try_out()
    name = next(iter(tensors))
    for wrong, error, message in (
        ({k: v for k, v in tensors.items() if k != name}, KeyError, name),
        ({**tensors, name: jnp.zeros((2, 3))}, ValueError, r"is \(2, 3\)"),
        ({**tensors, "extra": jnp.zeros(3)}, ValueError, "extra is of no"),
    ):
        with pytest.raises(error, match=message):
            from_tensors("locate", LAYOUT, wrong, "one").try_out()


def _trained(env, params):
    tensors = flat(memory.init("match", jax.random.key(0)))
    here = dataclasses.replace(training_conditions(env, params), fields=None)
    return from_tensors("locate", LAYOUT, tensors, "one", here)


@pytest.mark.parametrize(
    ("task", "sensor", "sentence"),
    [
        ("Relocalise-v1", None, "one: a localiser on its way to a goal, without a map; .* asks to report"),
        ("Traverse-v1", None, "asks to cover"),
        pytest.param("StopAt-v1", "spin16x64", "trained with 16 beams, .* has 1024", marks=pytest.mark.slow),
        ("Return-v1", None, None),
        ("Faulted-v1", None, None),
        ("Obstructed-v1", None, None),
    ],
)
def test_a_localiser_drives_where_it_can_and_is_refused_in_a_sentence_elsewhere(task, sensor, sentence):
    agent = _trained(*st.make("Subterra/StopAt-v1"))
    env, params = st.make(f"Subterra/{task}", **({} if sensor is None else {"sensor": sensor}))
    with nullcontext() if sentence is None else pytest.raises(PolicyError, match=sentence):
        check_fits(agent, env, params, agent.name)


def test_another_number_of_beams_or_another_control_period_is_named():
    env, params = st.make("Subterra/StopAt-v1")
    agent = _trained(env, params)
    check_fits(agent, *st.make("Subterra/StopAt-v1", hidden_start=True), agent.name)  # given another, sensed alike
    slippery = params.replace(slip=params.slip.replace(gain_sigma=0.5))
    for other, sentence in (
        (slippery, "trained under constants"),
        (params.replace(lidar=params.lidar.replace(n_beams=32)), "trained with 16 beams, Subterra/StopAt-v1 has 32"),
        (params.replace(lidar=params.lidar.replace(n_beams=20)), "needs 16 level beams or a multiple of them"),
        (params.replace(vehicle=params.vehicle.replace(period=0.05)), "a control period of 0.1 s, .* has 0.05 s"),
    ):
        with pytest.raises(PolicyError, match=sentence):
            check_fits(agent, env, other, agent.name)
    read = dataclasses.replace(agent, conditions=dataclasses.replace(agent.conditions, fields=("odometry", "ranges")))
    with pytest.raises(PolicyError, match=r"one: trained on the fields odometry, ranges; .* has ranges, odom"):
        check_fits(read, env, params, agent.name)


def _way(ways, driven, direction, flagged, now, params):
    """Takes one step of 0.2 m past smooth walls."""
    walls = Corridor(jnp.float32(HALF), jnp.float32(HALF), jnp.float32(0.0))
    ranges = jnp.full(16, 30.0)
    obs = Observed(ranges, ranges, distance=jnp.float32(driven), heading=jnp.zeros(()), goal=jnp.float32(63.0))
    step = Driven(jnp.float32(2.0), jnp.ones(()), jnp.float32(direction), jnp.asarray(flagged), walls)
    return ways.update(now, obs, step, params, None)


@struct.dataclass
class Begun:
    begin: jax.Array


class Still:
    """A localiser that has counted 7 m from 50 m on."""

    def begin(self, obs, params):
        return Begun(jnp.float32(50.0))

    def update(self, before, obs, driven, params, known):
        return Station(jnp.float32(57.0), jnp.zeros(()), jnp.ones(())), before


@pytest.mark.parametrize(("flagged", "station", "sigma"), [(True, 61.1, 0.1), (False, 57.0, 1.0)])
def test_a_flag_that_is_told_moves_the_count_to_a_tenth_of_a_metre_behind_its_place(flagged, station, sigma):
    goal, vehicle = SimpleNamespace(flag_reach=2.0), SimpleNamespace(period=0.1)
    ways, params = TwoWays(Still()), SimpleNamespace(goal=goal, vehicle=vehicle)
    estimate, _ = _way(ways, 7.0, 1.0, flagged, ways.begin(None, params), params)
    assert float(estimate.station) == pytest.approx(station, abs=1e-5)
    assert float(jnp.exp(estimate.log_sigma)) == pytest.approx(sigma, abs=1e-6)


def _beliefs(weights, fraction, reported, sigma, strip, passed):
    record = jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype != bool else x, drive_past(fraction))
    return _sequence(weights, record, strip, np.float32(reported), np.float32(sigma), passed)


@jax.jit
def _sequence(weights, record, strip, reported, sigma, passed):
    whole, rate = streams.profiles_of(record, N_METRES), jnp.zeros(N_METRES)
    beliefs = map_filter.sequence(weights, whole, streams.BEFORE, strip.pick(0), reported, sigma, passed, rate)
    return beliefs, map_filter.place(jax.tree.map(lambda leaf: leaf[-1], beliefs))


# The relief is met from station 0 of `patches` on; the map begins 50 m before.
@pytest.mark.parametrize(("offset", "fraction"), [(0.0, 0.0), (3.0, 0.0), (-4.2, 0.02), (2.0, -0.03)])
def test_a_map_tells_how_far_the_start_is_off(offset, fraction):
    weights = map_filter.init(jax.random.key(0))
    passed = (
        np.maximum(np.arange(N_METRES) - DELAY + 1.0, 0.0) * fraction
    )  # what a perfect localiser says of the metres passed
    beliefs, (found, sigma, believed) = _beliefs(
        weights, fraction, 50.0 - offset, 3.0, map_of_walls(first=-50.0), passed.astype(np.float32)
    )
    assert float(found) == pytest.approx(offset, abs=0.15)
    assert float(sigma) < 0.5
    assert bool(believed)
    assert float(beliefs.log_odds[-1]) > float(beliefs.log_odds[0]) + 2.0


def test_a_map_of_another_tunnel_is_not_believed():
    weights = map_filter.init(jax.random.key(0))
    beliefs, (_, _, believed) = _beliefs(
        weights, 0.0, 50.0, 0.0, map_of_walls(first=-50.0, seed=8, side=4.1), np.zeros(N_METRES, np.float32)
    )
    last = jax.tree.map(lambda leaf: leaf[-1], beliefs)
    assert not bool(believed)
    plain = Estimate(jnp.float32(1.0), jnp.float32(0.02), jnp.float32(-1.0))
    kept = map_filter.corrected(last, plain, jnp.float32(N_METRES), jnp.float32(0.0))
    assert float(kept.correction) == 1.0
    assert float(kept.log_scale) == pytest.approx(-1.0)


def test_a_belief_widens_as_the_localiser_says_and_the_truth_is_looked_up_between_its_cells():
    weights = map_filter.init(jax.random.key(0)) | {"leak": jnp.array(-30.0)}
    two_metres = jnp.zeros(len(map_filter.SHIFTS)).at[map_filter.SIDE + 10].set(1.0)
    fresh = map_filter.MapBelief(two_metres, jnp.zeros(()))
    now = map_filter.advance(weights, fresh, jnp.zeros_like(two_metres), jnp.float32(0.5))
    assert np.asarray(now.fraction) @ (map_filter.SHIFTS - 2.0) ** 2 == pytest.approx(0.003 * np.e, rel=1e-3)
    beside = 0.003 * np.e / map_filter.CELL**2 / 2
    found = [float(map_filter.likelihood(now, jnp.float32(2.05), jnp.asarray(right))) for right in (True, False)]
    between = 0.75 * (1.0 - 2.0 * beside) + 0.25 * beside
    np.testing.assert_allclose(found, np.log([0.5 * between, 0.5]), rtol=1e-3)


def test_a_strip_gives_the_walls_of_its_tunnel_and_says_where_it_ends():
    strip = map_of_walls(n_metres=20)
    wall, inside = strip.pick(0).sample(jnp.float32(-1.0), 300)
    station = -1.0 + BIN * np.arange(300)
    np.testing.assert_array_equal(np.asarray(inside), (station > 0.049) & (station < 19.94))
    near = np.abs(np.asarray(wall[0]) - HALF - patches(station)) < 1e-6
    assert np.mean(near[np.asarray(inside)]) > 0.7, "only at the edges of patches two bins are mixed"


def test_the_strip_of_a_stack_holds_the_walls_of_each_tunnel():
    tunnels = [st.load_tunnel("control"), st.load_tunnel("subterra-351")]
    _, params = st.make("Subterra/StopAt-v1", tunnel=[Tunnel.from_plan(one) for one in tunnels])
    strip = map_strip(params.tunnel)
    for index in range(2):
        here = strip.of(params.tunnel.pick(index))
        wall, inside = here.sample(jnp.float32(100.0), 50)
        alone = map_strip(Tunnel.from_plan(tunnels[index])).pick(0).sample(jnp.float32(100.0), 50)[0]
        assert bool(inside.all())
        np.testing.assert_allclose(wall, alone, atol=1e-6)
    assert np.ptp(np.asarray(wall)) > 0.05, "pockets stand in the plane of subterra-351"
