"""Walls with a face: brightness fixed to the wall, intensities and Doppler of the batch."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.baselines import scanmatch
from subterra_jax.baselines.agent import observed
from subterra_jax.baselines.steering import CentreLine
from subterra_jax.host.errors import TunnelError
from subterra_jax.host.texture import RING, brightness, texture_seed, wall_angle
from subterra_jax.lidar import LidarParams
from subterra_jax.parts.brightness import normal_beside
from subterra_jax.policies.locate import bends, strips
from tests.subterra_jax.placing import observe, placed

TASK, HALF = "Subterra/TraverseShort-v1", 2.8


def straight(**changes):
    station = np.linspace(0.0, 40.0, 81)
    plan = st.tunnel.from_centreline(np.stack([station, np.zeros(81)], axis=-1), HALF, lidar_height=0.7)
    return dataclasses.replace(plan, **changes)


def some_places(n=4000):
    rng = np.random.default_rng(0)
    return rng.uniform(0.0, 300.0, n).astype(np.float32), rng.uniform(-np.pi, np.pi, n).astype(np.float32)


def test_a_wall_is_equally_bright_for_numpy_and_jax_and_plain_at_dial_0():
    places = some_places()
    seen = brightness(np, *places, 7, 1.0)
    np.testing.assert_allclose(jax.jit(lambda s, a: brightness(jnp, s, a, jnp.int32(7), 1.0))(*places), seen, rtol=1e-4)
    assert 0.2 < np.log(seen).std() < 0.35
    assert np.log(seen).max() < 1.2
    assert (brightness(np, *places, 7, 0.0) == 1.0).all()
    half = np.log(brightness(np, *places, 7, 0.5))
    np.testing.assert_allclose(half, 0.5 * np.log(seen), atol=1e-5)
    assert abs(np.corrcoef(seen, brightness(np, *places, 8, 1.0))[0, 1]) < 0.05


def test_noise_of_a_channel_is_normal_and_of_its_own():
    first = jax.random.normal(jax.random.key(0), (20_000,))
    others = np.stack([first, *(normal_beside(first, channel) for channel in (1, 2))])
    np.testing.assert_allclose(others.mean(axis=1), 0.0, atol=0.03)
    np.testing.assert_allclose(others.std(axis=1), 1.0, atol=0.02)
    np.testing.assert_allclose(np.corrcoef(others), np.eye(3), atol=0.03)


def test_neighbours_are_alike_also_across_the_seam_and_joints_are_dark():
    station, angle = some_places()
    far = np.log(brightness(np, station, angle, 7, 1.0))
    likeness = [np.corrcoef(far, np.log(brightness(np, station + d, angle, 7, 1.0)))[0, 1] for d in (0.05, 0.3, 1.0)]
    assert likeness[0] > 0.8 > 0.5 > likeness[1] > 0.2 > likeness[2] > 0.02
    odd = station[np.floor(station / RING) % 2 == 1]  # of the others, a joint runs there
    sides = [np.log(brightness(np, odd, np.full_like(odd, a), 7, 1.0)) for a in (np.pi - 1e-4, 1e-4 - np.pi)]
    assert np.corrcoef(*sides)[0, 1] > 0.8
    joint = RING * np.floor(station / RING)
    assert far.mean() - np.log(brightness(np, joint, angle, 7, 1.0)).mean() > 0.3
    np.testing.assert_allclose(wall_angle(np, np.array([0.0, 2.0, -2.0]), 1.5), [0.0, np.pi / 2, -np.pi / 2])


@pytest.mark.parametrize("radius", [1e5, 60.0])
def test_planar_intensities_are_those_of_the_wall_also_in_a_bend(radius):
    turn, bearing = np.linspace(0.0, 40.0, 81) / radius, 2.0 * np.pi * np.arange(16) / 16 + 0.3
    line = radius * np.stack([np.sin(turn), 1.0 - np.cos(turn)], axis=-1)
    plan = st.tunnel.from_centreline(line, HALF)
    env, params = st.make(TASK, tunnel=plan, lidar=LidarParams(range_sigma=0.0, intensity=True, texture=1.0))
    state = placed(env, params, 15.0, 0.4, 0.3).replace(position=jnp.asarray(line[30], jnp.float32))
    seen = observe(env, state, params)
    x, y = line[30][:, None] + seen["ranges"] * np.stack([np.cos(bearing), np.sin(bearing)])
    turned, left = np.arctan2(x, radius - y), radius - np.hypot(x, radius - y)
    factor = brightness(np, radius * turned, wall_angle(np, left, 0.7), texture_seed(plan.name), 1.0)
    expected = 150.0 * 0.3 * np.abs(np.sin(bearing - turned)) * factor
    met = seen["ranges"] < 12.0
    assert (np.abs(seen["intensity"] - expected)[met] < 0.2 * expected[met] + 1.5).all()
    assert np.corrcoef(seen["intensity"][met], expected[met])[0, 1] > 0.97


@pytest.fixture(scope="module")
def images():
    """By dial, images of two sweeps 0.5 m apart, unrolled in 5 cm cells, freed of what a plain wall shows."""
    made = {}
    env, params = st.make(TASK, tunnel=straight(), sensor="vlp16", intensity=True, texture=1.0)
    rays, state = np.asarray(params.lidar.directions, np.float64), placed(env, params, 15.0)
    for dial in (0.0, 0.5, 1.0):
        params, pair = params.replace(lidar=params.lidar.replace(texture=dial)), []
        for key, x in enumerate((15.0, 15.5)):
            there = state.replace(position=jnp.array([x, 0.0]), station=jnp.float32(x))
            seen = observe(env, there, params, key)
            points = rays * seen["scan"][:, None] + (x, 0.0, 0.7)
            near = (seen["intensity"] > 0.0) & (np.abs(points[:, 0] - x) < 3.0) & (np.abs(points[:, 2] - 1.1) < 0.9)
            near &= np.abs(points[:, 1]) > HALF - 0.1  # the walls stand upright
            pair.append(unroll(points[near], seen["intensity"][near] / np.abs(rays[near, 1])))
        made[dial] = pair
    return made


def unroll(points, value):
    cell = np.floor(points[:, [0, 2]] / 0.05).astype(int) * (1, 2) + np.stack([points[:, 1] * 0, points[:, 1] > 0], 1)
    keys, where = np.unique(cell.astype(int), axis=0, return_inverse=True)
    return dict(
        zip(map(tuple, keys.tolist()), np.bincount(where.ravel(), value) / np.bincount(where.ravel()), strict=True)
    )


def test_two_sweeps_have_the_wall_in_common_by_the_dial(images):
    found = []
    for one, other in images.values():
        both = sorted(one.keys() & other.keys())
        assert len(both) > 500
        found.append(np.corrcoef([one[k] for k in both], [other[k] for k in both])[0, 1])
    print("correlation by dial", dict(zip(images, np.round(found, 3), strict=True)))
    assert found[0] <= 0.05
    assert found[2] >= 0.6
    assert found[0] < found[1] < found[2]


def test_doppler_is_the_speed_of_each_range():
    env, params = st.make(TASK, tunnel=straight(), sensor="spin16x64", doppler=True)

    @jax.jit
    def drive(params):
        state = placed(env, params, 15.0, 0.3, 0.2)
        return env.advance(state, jnp.array([1.5, 0.0]), env.draw_step(jax.random.key(1), (), params), params)[0]

    state = drive(params)
    seen = observe(env, state, params)
    cos, sin = np.cos(0.2), np.sin(0.2)
    rays = np.asarray(params.lidar.directions)
    speed = float(np.hypot(*(np.asarray(state.position) - (15.0, 0.3)))) / float(params.vehicle.period)
    back = seen["scan"] < 30.0
    assert speed > 0.5
    assert cos > sin
    error = seen["doppler"][back] + speed * rays[back, 0]
    assert abs(error.mean()) < 0.01
    assert 0.02 < error.std() < 0.04
    assert (seen["doppler"][~back] == 0.0).all()


def test_wrong_wishes_are_refused_in_one_sentence():
    with pytest.raises(ValueError, match="between 0 and 1, got"):
        st.make(TASK, tunnel=straight(), intensity=True, texture=1.5)
    with pytest.raises(TunnelError, match="no field 'texture'"):
        st.make(TASK, tunnel=straight(texture=None), intensity=True, texture=0.5)
    with pytest.raises(ValueError, match="Doppler"):
        st.make(TASK, tunnel=straight(), doppler=True)
    env, params = st.make(TASK, tunnel=straight(texture=None), intensity=True)
    assert env.fields(params)["intensity"].stop - env.fields(params)["intensity"].start == 16


def test_a_bound_of_the_station_is_that_of_a_numeric_reference():
    taper, station = 0.02, np.linspace(0.0, 40.0, 81)
    xy = np.stack([station, np.zeros(81)], axis=-1)
    plan = st.tunnel.from_centreline(xy, HALF + taper * station, lidar_height=0.7)
    env, params = st.make(TASK, tunnel=plan, intensity=True, texture=1.0)
    found = st.localisability(env, params, step=4.0)
    at = np.flatnonzero(found.station == 18.0)[0]
    bearing = 2.0 * np.pi * np.array([k for k in range(16) if k not in (0, 8)]) / 16
    side, places = np.sign(np.sin(bearing)), np.linspace(-0.08, 0.08, 5)

    def look(x):
        reach = (HALF + taper * x) / (np.abs(np.sin(bearing)) - taper * np.cos(bearing))
        where = x + reach * np.cos(bearing)
        angle = wall_angle(np, side * (HALF + taper * where), np.full(14, 0.7))
        slant = np.abs(np.sin(bearing))
        return reach, np.round(45.0 * slant * brightness(np, where, angle, texture_seed(plan.name), 1.0))

    ranges, shown = (np.array(rows) for rows in zip(*(look(18.0 + p) for p in places), strict=True))
    expected = 0.0
    for values, noise in ((ranges, 0.05**2), (shown, (0.05 * shown.mean(axis=0)) ** 2 + 1.0 / 12.0)):
        slope, level = np.polyfit(places, values, 1)
        expected = expected + np.sum(
            slope**2 / (noise + np.mean((values - level - np.outer(places, slope)) ** 2, axis=0))
        )
        if values is ranges:
            assert found.by_range[at] == pytest.approx(expected**-0.5, rel=0.02)
    assert found.bound[at] == pytest.approx(expected**-0.5, rel=0.15)  # a rounded brightness may fall to either side
    plain = st.localisability(*st.make(TASK, tunnel=straight(), intensity=True), step=20.0)
    assert np.isinf(plain.by_range[0])
    assert np.isinf(plain.bound[0])


def test_scan_matching_finds_the_shift_by_brightness_alone():
    env, params = st.make(TASK, tunnel=straight(), intensity=True, texture=1.0)
    zero, settings = jnp.zeros(()), scanmatch.MatchParams()

    @jax.jit
    def sensing(x, key):
        state = placed(env, params, x)
        flat = env.observe(state, env.draw_step(jax.random.key(key), (), params), params)
        pose = scanmatch.AxisPose(jnp.float32(x), zero, zero, zero, jnp.float32(HALF))
        obs = observed(env, params, flat)
        return pose, obs, scanmatch.log_face(pose, obs, params)

    add, mismatch = (jax.jit(f, static_argnums=3) for f in (scanmatch.add_scan, scanmatch.mismatch))
    faces, cost, plain = scanmatch.empty_profile(), 0.0, 0.0
    walls = scanmatch.empty_profile()
    for k in range(25):
        pose, obs, face = sensing(12.0 + 0.2 * k, k)
        faces, walls = (add(seen, pose, obs.ranges, settings, *f) for seen, f in ((faces, (face,)), (walls, ())))
    for k in range(20):
        pose, obs, face = sensing(18.0 + 0.2 * k, 50 + k)
        off = dataclasses.replace(pose, station=pose.station + np.float32(0.1))
        cost = cost + mismatch(faces, off, obs.ranges, settings, face)
        plain = plain + mismatch(walls, off, obs.ranges, settings)
    found, none = (scanmatch.best_match(total, settings) for total in (cost, plain))
    assert bool(found.informative)
    assert float(found.shift) == pytest.approx(-0.1, abs=0.03)
    assert not bool(none.informative)


def test_brightness_makes_further_sides_for_the_learnt_localiser():
    env, params = st.make(TASK, tunnel=straight(), intensity=True)

    @jax.jit
    def look(params):
        flat = env.observe(placed(env, params, 20.0), env.draw_step(jax.random.key(3), (), params), params)
        obs = observed(env, params, flat)
        return bends.look(jnp.zeros(()), obs, CentreLine().begin(obs, params), jnp.zeros(()), params)[0]

    points = look(params)
    assert points.n_sides == strips.n_sides(params.lidar) == 4
    assert bool(points.seen[2:].any())
    shown = np.asarray(points.out[2:])[np.asarray(points.seen[2:])]
    assert np.abs(shown).mean() < 0.015  # an even wall: 5 % of noise and whole numbers, on the scale of 0.1 m
