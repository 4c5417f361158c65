"""Learnt localisers: the front end against known walls, and the robot's metres against those of training."""

import dataclasses
from contextlib import nullcontext
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.baselines.agent import Observed
from subterra_jax.baselines.stations import Driven
from subterra_jax.baselines.steering import Corridor
from subterra_jax.lidar3d.beams import level_ring
from subterra_jax.parts import make_sensor
from subterra_jax.policies import PolicyError, check_fits, from_tensors, training_conditions
from subterra_jax.policies.locate import bends, kalman, map_filter, matching, memory, streams, strips
from subterra_jax.policies.locate.agent import check_tensors, flat
from subterra_jax.policies.locate.blocks import DELAY, N_RAW, Block, Estimate
from subterra_jax.policies.locate.locator import Locator
from subterra_jax.policies.locate.map_strip import MapStrip, map_strip
from subterra_jax.policies.locate.profiles import BIN, Points
from subterra_jax.policies.locate.ways import TwoWays
from subterra_jax.tunnel import Tunnel

_HALF, _N = 2.7, 40  # m; metres


def _relief(station):
    """Patches 6 cm deep at random, the same everywhere they are looked at from."""
    edges = np.cumsum(np.random.default_rng(3).uniform(0.3, 1.5, 200)) - 20.0
    return np.where(np.searchsorted(edges, station) % 2 == 0, 0.06, 0.0)


def _drive(share, sigma=0.02, seed=0):
    """A robot in the middle of a straight tunnel that drives (1 + share) times what is commanded."""
    driven = 0.2 * np.arange(5 * _N + 2)
    angle = np.deg2rad(22.5) * np.arange(1, 8)
    along = np.broadcast_to(_HALF / np.tan(angle), (len(driven), 2, 7))
    station = (1.0 + share) * driven[:, None, None] + along + np.array([0.0, 7.3])[:, None]
    noise = sigma * np.random.default_rng(seed).standard_normal(station.shape)
    points = Points(jnp.asarray(along), jnp.asarray(_relief(station) + noise), jnp.ones(station.shape, bool))
    return streams.Record(jnp.asarray(driven), jnp.asarray((1.0 + share) * driven), points)


@pytest.mark.parametrize("share", [-0.03, 0.0, 0.02])
def test_the_untrained_front_end_finds_the_error_of_the_command(share):
    record = jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype != bool else x, _drive(share))
    blocks = jax.jit(lambda r: streams.metres(r, matching.init(jax.random.key(0)), _N))(record)
    total = np.asarray(blocks.evidence)[DELAY + 10 :].sum(axis=0)
    assert matching.SHARES[total.argmax()] == pytest.approx(share, abs=0.0045)
    assert total.max() - total.mean() > 3.0


def test_smooth_walls_tell_nothing():
    record = _drive(0.02, sigma=0.0)
    record = record.replace(points=record.points.replace(out=jnp.zeros_like(record.points.out)))
    blocks = streams.metres(record, matching.init(jax.random.key(0)), _N)
    assert np.ptp(np.asarray(blocks.evidence), axis=1).max() < 0.2


def _image(station, sensor, low=-9.0, high=9.0):
    """The image of a spinning sensor between upright walls whose relief lies between two heights, m."""
    ray = np.asarray(sensor.directions)
    side = np.maximum(np.abs(ray[:, 1]), 1e-6)
    depth = np.zeros(len(ray))
    goes_on = (_HALF / side * ray[:, 2] > low) & (_HALF / side * ray[:, 2] < high)
    for deeper in np.linspace(0.0, 0.06, 13):  # into a patch, until its floor or its far edge
        along = (_HALF + deeper) / side * ray[:, 0]
        goes_on &= _relief(station + along + np.where(ray[:, 1] > 0.0, 0.0, 7.3)) > deeper - 1e-9
        depth = np.where(goes_on, deeper, depth)
    reach = (_HALF + depth) / side
    return np.minimum(reach, 30.0)


def _seen(image, sensor):
    scan = jnp.asarray(image, jnp.float32)
    level = level_ring(scan, sensor.shape)
    return Observed(scan, level, distance=jnp.zeros(()), heading=jnp.zeros(()), entries={"scan": scan})


def test_a_spinning_lidar_sees_strips_of_the_wall_at_their_heights():
    sensor = make_sensor("spin16x64")
    params = SimpleNamespace(lidar=sensor)
    walls = Corridor(jnp.float32(_HALF), jnp.float32(_HALF), jnp.float32(0.0))
    flat_walls = strips.sense(_seen(_image(3.0, sensor, 0.0, 0.0), sensor), walls, params)
    points = strips.sense(_seen(_image(3.0, sensor, 0.5, 0.8), sensor), walls, params)
    assert points.seen.shape == (2 * len(strips.HEIGHTS) * strips.RAYS, 7)
    assert points.n_sides == strips.n_sides(sensor) == 12
    assert np.mean(points.seen) > 0.9, "the farthest returns lie beyond reach"
    np.testing.assert_allclose(np.where(flat_walls.seen, flat_walls.out, 0.0), 0.0, atol=1e-4)
    out = np.asarray(points.out).reshape(len(strips.HEIGHTS), 2, strips.RAYS, 7)
    assert np.ptp(out[strips.HEIGHTS.index(0.62)]) > 0.05, "the highest strip shows the patches"
    for height in (0.12, -0.37, -0.62):
        assert np.ptp(out[strips.HEIGHTS.index(height)]) < 1e-3
    left, right = (np.asarray(points.along).reshape(len(strips.HEIGHTS), 2, strips.RAYS, 7)[:, i] for i in (0, 1))
    there = np.asarray(points.seen).reshape(left.shape[0], 2, strips.RAYS, 7).all(axis=1)
    np.testing.assert_allclose(left[there], right[there], atol=0.1, err_msg="of two rings as near either may be taken")
    assert np.all(np.diff(left[0, 0]) < 0.0), "bearings go from ahead to behind"


def test_walls_turned_by_a_heading_are_straight_again():
    sensor, yaw = make_sensor("spin16x64"), 0.1
    turned = np.asarray(sensor.directions) @ np.array(
        [[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]
    )
    image = np.minimum(_HALF / np.maximum(np.abs(turned[:, 1]), 1e-6), 30.0)
    walls = Corridor(jnp.float32(_HALF), jnp.float32(_HALF), jnp.float32(yaw))
    points = strips.sense(_seen(image, sensor), walls, SimpleNamespace(lidar=sensor))
    np.testing.assert_allclose(np.asarray(points.out)[np.asarray(points.seen)], 0.0, atol=1e-4)
    assert np.mean(points.seen) > 0.9


@pytest.mark.parametrize("share", [-0.02, 0.02])
def test_strips_above_the_level_ring_tell_the_error_of_the_command(share):
    sensor = make_sensor("spin16x64")
    params = SimpleNamespace(lidar=sensor)
    walls = Corridor(jnp.float32(_HALF), jnp.float32(_HALF), jnp.float32(0.0))
    driven = np.float32(0.2) * np.arange(5 * 30 + 2)
    images = np.stack([_image((1.0 + share) * d, sensor, 0.25, 9.0) for d in driven])
    points = jax.vmap(lambda image: strips.sense(_seen(image, sensor), walls, params))(jnp.asarray(images))
    record = streams.Record(jnp.asarray(driven), jnp.asarray((1.0 + share) * driven), points)
    blocks = jax.jit(lambda r: streams.metres(r, matching.init(jax.random.key(0)), 30))(record)
    total = np.asarray(blocks.evidence)[DELAY + 8 :].sum(axis=0)
    assert matching.SHARES[total.argmax()] == pytest.approx(share, abs=0.0045)
    level = record.replace(points=jax.tree.map(lambda leaf: leaf[:, : 4 * strips.RAYS], points))
    blind = streams.metres(level, matching.init(jax.random.key(0)), 30)
    assert np.ptp(np.asarray(blind.evidence), axis=1).max() < 0.2, "at the level of the sensor the wall is smooth"


@pytest.mark.parametrize("radius", [80.0, -200.0])
def test_a_bend_is_found_and_its_points_are_put_along_the_axis(radius):
    angle = np.deg2rad(22.5) * np.arange(1, 8)
    beam = np.stack([np.cos(angle), np.sin(angle)])
    along, out, station = [], [], []
    for side in (1.0, -1.0):
        # Where a beam from the middle meets the circle of the wall, about a centre at (0, radius).
        reach_wall = abs(radius - side * _HALF)
        dot = side * beam[1] * radius
        root = np.sqrt(dot**2 - radius**2 + reach_wall**2)
        both = np.stack([dot - root, dot + root])
        reach = np.where(both > 0.0, both, np.inf).min(axis=0)
        x, y = reach * beam[0], side * reach * beam[1]
        along.append(x)
        out.append(side * y - _HALF)
        station.append(radius * np.arctan2(np.sign(radius) * x, np.sign(radius) * (radius - y)))
    points = Points(*(jnp.asarray(np.stack(rows), jnp.float32) for rows in (along, out)), jnp.ones((2, 7), bool))
    bend = jnp.zeros(())
    for _ in range(120):
        bend = bends.follow(bend, points, jnp.float32(0.2))
    assert float(bend) == pytest.approx(1.0 / radius, rel=0.05)
    walls = Corridor(jnp.float32(_HALF), jnp.float32(_HALF), jnp.float32(0.0))
    straight = bends.straighten(points, walls, bend)
    before, after = (np.abs(np.asarray(p.along) - np.stack(station)).max() for p in (points, straight))
    assert after < 0.015 < 0.07 < before
    assert np.abs(np.asarray(straight.out)).max() < 0.03


def test_a_robot_that_stands_learns_no_bend_from_a_niche():
    points = Points(jnp.ones((2, 7)), jnp.zeros((2, 7)).at[0, :3].set(0.9), jnp.ones((2, 7), bool))
    assert float(bends.follow(jnp.zeros(()), points, jnp.zeros(()))) == 0.0


def _random_blocks(n, key=1):
    rng = np.random.default_rng(key)
    evidence = 2.0 * rng.standard_normal((n, len(matching.SHARES)))
    evidence[:DELAY] = 0.0
    return Block(
        jnp.asarray(evidence, jnp.float32),
        jnp.asarray(0.03 * rng.standard_normal(n), jnp.float32),
        jnp.full(n, 5.0),
        jnp.asarray(rng.standard_normal((n, N_RAW)), jnp.float32),
    )


@pytest.mark.parametrize(
    "network",
    [
        "gru",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("kalman", "s5", "transformer", "transformer-kalman")),
    ],
)
def test_a_memory_gives_the_same_metre_by_metre_as_all_at_once(network):
    weights = memory.init(network, "match", jax.random.key(2))
    blocks = _random_blocks(35)
    whole = memory.sequence(network, weights, blocks)
    one = lambda state, block: memory.step(network, weights, state, block)  # noqa: E731
    stepped = jax.lax.scan(one, memory.start(network, weights), blocks)[1]
    for name in ("correction", "share", "log_scale"):
        np.testing.assert_allclose(getattr(whole, name), getattr(stepped, name), atol=2e-4)


def test_the_filter_trusts_sharp_evidence_over_its_own_odometry():
    weights = kalman.init(jax.random.key(0))
    sharp = -0.5 * ((jnp.asarray(matching.SHARES) - 0.02) / 0.002) ** 2
    n = 60
    evidence = jnp.broadcast_to(sharp, (n, len(matching.SHARES))).at[:DELAY].set(0.0)
    blocks = Block(evidence, jnp.full(n, 0.05), jnp.full(n, 5.0), jnp.zeros((n, N_RAW)))
    with_walls = kalman.sequence(weights, blocks)
    blind = kalman.sequence(weights, blocks.replace(evidence=jnp.zeros_like(evidence)))
    assert with_walls.correction[-1] == pytest.approx(0.02 * n, abs=0.1)
    assert blind.correction[-1] == pytest.approx(0.05 * n * 0.6, abs=0.5)
    assert with_walls.log_scale[-1] < blind.log_scale[-1] - 1.0


def test_a_network_or_front_that_does_not_exist_is_named():
    with pytest.raises(ValueError, match="no network 'lstm'"):
        memory.init("lstm", "match", jax.random.key(0))
    with pytest.raises(ValueError, match="needs the evidence"):
        memory.init("kalman", "scans", jax.random.key(0))


def _ranges(driven, share=0.01):
    """Scans of 16 beams by a robot that keeps to the middle; the ends of the tunnel are out of sight."""
    angle = 2.0 * np.pi * np.arange(16) / 16
    side = np.where(np.abs(np.sin(angle)) < 0.1, np.nan, np.abs(np.sin(angle)))
    along = _HALF * np.cos(angle) / side
    station = (1.0 + share) * driven[:, None] + along + np.where(np.sin(angle) > 0.0, 0.0, 7.3)
    noise = 0.02 * np.random.default_rng(5).standard_normal(station.shape)
    return np.where(np.isnan(side), 30.0, (_HALF + _relief(station) + noise) / np.where(np.isnan(side), 1.0, side))


def _looked_at(ranges, driven, walls):
    """Returns the points of a drive as they are recorded in training."""
    params = SimpleNamespace(lidar=SimpleNamespace(range_max=30.0))
    moved = jnp.asarray(np.diff(driven, prepend=driven[:1]))

    def step(bend, row):
        seen = Observed(row[0], row[0], distance=jnp.zeros(()), heading=jnp.zeros(()))
        points, bend = bends.look(bend, seen, walls, row[1], params)
        return bend, points

    return jax.lax.scan(step, jnp.zeros(()), (ranges, moved))[1]


@pytest.mark.parametrize(
    ("network", "front", "with_map"),
    [
        ("kalman", "match", False),
        ("gru", "match", True),
        pytest.param("s5", "scans", False, marks=pytest.mark.slow),
    ],
)
def test_a_robot_makes_the_metres_of_its_training(network, front, with_map):
    rng = np.random.default_rng(7)
    speed = np.where(np.arange(240) % 9 < 7, 2.0, 0.7)  # not all metres have five steps
    speed[0] = 0.0
    driven = np.cumsum((0.1 * speed).astype(np.float32))  # in 32 bits, as the robot sums
    ranges = jnp.asarray(_ranges(driven), jnp.float32)
    read = jnp.asarray(np.cumsum(0.1 * speed * 1.02 + 0.01 * rng.standard_normal(240)) + 5.0, jnp.float32)
    walls = Corridor(jnp.float32(_HALF), jnp.float32(_HALF), jnp.float32(0.0))
    points = _looked_at(ranges, driven, walls)
    weights = memory.init(network, front, jax.random.key(4), with_map)
    n = int(driven[-1])
    record = streams.Record(jnp.asarray(driven, jnp.float32), read, points)
    whole = memory.sequence(network, weights, streams.metres(record, weights.get("match"), n))
    strip = _strip(first=-3.0 - 0.7) if with_map else None  # told 0.7 m too far back
    if strip is not None:
        age = jnp.arange(1.0, n + 1.0)
        passed, rate = memory.passed(whole, age), memory.log_rate(whole, age)
        seen, told, sure = streams.profiles_of(record, n), jnp.float32(3.0), jnp.float32(0.0)
        beliefs = map_filter.sequence(weights["map"], seen, streams.BEFORE, strip.pick(0), told, sure, passed, rate)
        whole = jax.vmap(map_filter.corrected, (0, 0, 0, None))(beliefs, whole, age, sure)
    params = SimpleNamespace(
        errand="stop",
        tunnel=SimpleNamespace(first_node=jnp.zeros((), jnp.int32)),
        start=SimpleNamespace(station=3.0, station_sigma=0.0),
        vehicle=SimpleNamespace(period=0.1),
        lidar=SimpleNamespace(range_max=30.0),
    )
    locator, one, no = Locator(weights, network, strip), jnp.ones(()), jnp.zeros((), bool)

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


@pytest.mark.parametrize("network", memory.NETWORKS)
def test_tensors_of_a_localiser_come_back_as_an_agent_or_are_refused(network):
    tensors = flat(memory.init(network, "match", jax.random.key(0)))
    layout = {"network": network, "action_low": [0.0, -1.5], "action_high": [2.0, 1.5]}
    agent = from_tensors("locate", layout, tensors, "one")
    check_tensors(agent)
    name = next(iter(tensors))
    with pytest.raises(KeyError, match=name):
        check_tensors(from_tensors("locate", layout, {k: v for k, v in tensors.items() if k != name}, "one"))
    with pytest.raises(ValueError, match=r"is \(2, 3\)"):
        check_tensors(from_tensors("locate", layout, {**tensors, name: jnp.zeros((2, 3))}, "one"))
    with pytest.raises(ValueError, match="extra is of no"):
        check_tensors(from_tensors("locate", layout, {**tensors, "extra": jnp.zeros(3)}, "one"))


def _trained(env, params):
    layout = {"network": "kalman", "action_low": [0.0, -1.5], "action_high": [2.0, 1.5]}
    tensors = flat(memory.init("kalman", "match", jax.random.key(0)))
    here = dataclasses.replace(training_conditions(env, params), fields=None)
    return from_tensors("locate", layout, tensors, "one", here)


@pytest.mark.parametrize(
    ("task", "sensor", "sentence"),
    [
        ("Relocalise-v1", None, "one: a localiser on its way to a goal, without a map; .* asks to report"),
        ("Traverse-v0", None, "asks to cover"),
        pytest.param("StopAt-v1", "spin16x64", "trained with 16 beams, .* has 1024", marks=pytest.mark.slow),
        ("Return-v1", None, None),
        ("Faulted-v1", None, None),
        ("ObstructedOffset-v1", None, None),
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
    for other, sentence in (
        (params.replace(lidar=params.lidar.replace(n_beams=32)), "trained with 16 beams, Subterra/StopAt-v1 has 32"),
        (params.replace(lidar=params.lidar.replace(n_beams=20)), "needs 16 level beams or a multiple of them"),
        (params.replace(vehicle=params.vehicle.replace(period=0.05)), "a control period of 0.1 s, .* has 0.05 s"),
    ):
        with pytest.raises(PolicyError, match=sentence):
            check_fits(agent, env, other, agent.name)


def _way(ways, driven, direction, flagged, now, params):
    """Takes one step of 0.2 m past smooth walls."""
    walls = Corridor(jnp.float32(_HALF), jnp.float32(_HALF), jnp.float32(0.0))
    ranges = jnp.full(16, 30.0)
    obs = Observed(ranges, ranges, distance=jnp.float32(driven), heading=jnp.zeros(()), goal=jnp.float32(63.0))
    step = Driven(jnp.float32(2.0), jnp.ones(()), jnp.float32(direction), jnp.asarray(flagged), walls)
    return ways.update(now, obs, step, params, None)


def test_a_way_back_begins_at_the_place_that_the_flag_tells():
    params = SimpleNamespace(
        errand="return",
        start=SimpleNamespace(station=50.0, station_sigma=0.0),
        vehicle=SimpleNamespace(period=0.1),
        lidar=SimpleNamespace(range_max=30.0),
        goal=SimpleNamespace(flag_reach=2.0),
    )
    ways = TwoWays(Locator(memory.init("kalman", "match", jax.random.key(0)), "kalman"))
    advance = jax.jit(lambda driven, direction, flagged, now: _way(ways, driven, direction, flagged, now, params))
    obs = Observed(jnp.zeros(16), jnp.zeros(16), distance=jnp.zeros(()), heading=jnp.zeros(()))
    now, stations = ways.begin(obs, params), []
    for k in range(140):
        # The wheels slip by 2 %: 65 commanded steps bring it to the flag, 13.26 m on.
        estimate, now = advance(0.204 * (k + 1), 1.0 if k < 70 else -1.0, k == 65, now)
        stations.append(float(estimate.station))
    assert stations[64] == pytest.approx(63.1, abs=0.3)
    assert stations[65] == pytest.approx(61.1, abs=1e-3), "the flag is 2 m before the goal, 0.1 m late"
    assert stations[139] == pytest.approx(stations[70] - 0.2 * 69, abs=0.4)


def _strip(first=0.0, n_metres=160, seed=3, side=7.3):
    """The map of two walls with the relief of `_relief`; the right one shows it `side` metres on."""
    centre = BIN * (np.arange(10 * n_metres) + 0.5)
    left, right = (_patches(first + centre + off, seed) for off in (0.0, side))
    one = lambda value: jnp.full(1, value, jnp.int32)  # noqa: E731
    return MapStrip(jnp.asarray(_HALF + np.stack([left, right]), jnp.float32), one(0), one(10 * n_metres), one(0))


def _patches(station, seed):
    edges = np.cumsum(np.random.default_rng(seed).uniform(0.3, 1.5, 200)) - 20.0
    return np.where(np.searchsorted(edges, station) % 2 == 0, 0.06, 0.0)


def _beliefs(weights, share, told, sigma, strip, passed):
    record = jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype != bool else x, _drive(share))
    whole = streams.profiles_of(record, _N)
    rate = jnp.full(_N, 0.0)
    scalar = jnp.float32
    return map_filter.sequence(
        weights, whole, streams.BEFORE, strip.pick(0), scalar(told), scalar(sigma), jnp.asarray(passed), rate
    )


# The relief is met from station 0 of `_relief` on; the map begins 50 m before.
@pytest.mark.parametrize(("offset", "share"), [(0.0, 0.0), (3.0, 0.0), (-4.2, 0.02), (2.0, -0.03)])
def test_a_map_tells_how_far_the_start_is_off(offset, share):
    weights = map_filter.init(jax.random.key(0))
    passed = np.maximum(np.arange(_N) - DELAY + 1.0, 0.0) * share  # what a perfect localiser says of the metres passed
    beliefs = _beliefs(weights, share, 50.0 - offset, 3.0, _strip(first=-50.0), passed.astype(np.float32))
    found, sigma, believed = map_filter.place(jax.tree.map(lambda leaf: leaf[-1], beliefs))
    assert float(found) == pytest.approx(offset, abs=0.15)
    assert float(sigma) < 0.5
    assert bool(believed)
    assert float(beliefs.log_odds[-1]) > float(beliefs.log_odds[0]) + 2.0


def test_a_map_of_another_tunnel_is_not_believed():
    weights = map_filter.init(jax.random.key(0))
    beliefs = _beliefs(weights, 0.0, 50.0, 0.0, _strip(first=-50.0, seed=8, side=4.1), np.zeros(_N, np.float32))
    last = jax.tree.map(lambda leaf: leaf[-1], beliefs)
    assert not bool(map_filter.place(last)[2])
    plain = Estimate(jnp.float32(1.0), jnp.float32(0.02), jnp.float32(-1.0))
    kept = map_filter.corrected(last, plain, jnp.float32(_N), jnp.float32(0.0))
    assert float(kept.correction) == 1.0
    assert float(kept.log_scale) == pytest.approx(-1.0)


def test_a_strip_gives_the_walls_of_its_tunnel_and_says_where_it_ends():
    strip = _strip(n_metres=20)
    wall, inside = strip.pick(0).sample(jnp.float32(-1.0), 300)
    station = -1.0 + BIN * np.arange(300)
    np.testing.assert_array_equal(np.asarray(inside), (station > 0.049) & (station < 19.94))
    near = np.abs(np.asarray(wall[0]) - _HALF - _patches(station, 3)) < 1e-6
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
