"""The front end of learnt localisers against known walls: level beams, strips of a spinning LiDAR, bends."""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from subterra_jax.baselines.agent import Observed
from subterra_jax.baselines.steering import Corridor
from subterra_jax.lidar3d.beams import level_ring
from subterra_jax.parts import make_sensor
from subterra_jax.policies.locate import bends, matching, streams, strips
from subterra_jax.policies.locate.blocks import DELAY
from subterra_jax.policies.locate.profiles import N_BEARINGS, Points, add_points, blank
from tests.subterra_jax.patches import HALF, N_METRES, drive_past, patches


@pytest.mark.parametrize("fraction", [-0.03, 0.0, 0.02])
def test_the_untrained_front_end_finds_the_error_of_the_command(fraction):
    record = jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype != bool else x, drive_past(fraction))
    blocks = _metres(record, N_METRES)
    total = np.asarray(blocks.evidence)[DELAY + 10 :].sum(axis=0)
    assert matching.FRACTIONS[total.argmax()] == pytest.approx(fraction, abs=0.0045)
    assert total.max() - total.mean() > 3.0


def test_smooth_walls_tell_nothing():
    record = drive_past(0.02, sigma=0.0)
    record = record.replace(points=record.points.replace(out=jnp.zeros_like(record.points.out)))
    blocks = _metres(record, N_METRES)
    assert np.ptp(np.asarray(blocks.evidence), axis=1).max() < 0.2


def _image(station, sensor, low=-9.0, high=9.0):
    """The image of a spinning sensor between upright walls whose relief lies between two heights, m."""
    ray = np.asarray(sensor.directions)
    side = np.maximum(np.abs(ray[:, 1]), 1e-6)
    depth = np.zeros(len(ray))
    goes_on = (HALF / side * ray[:, 2] > low) & (HALF / side * ray[:, 2] < high)
    for deeper in np.linspace(0.0, 0.06, 13):  # into a patch, until its floor or its far edge
        along = (HALF + deeper) / side * ray[:, 0]
        goes_on &= patches(station + along + np.where(ray[:, 1] > 0.0, 0.0, 7.3)) > deeper - 1e-9
        depth = np.where(goes_on, deeper, depth)
    reach = (HALF + depth) / side
    return np.minimum(reach, 30.0)


@partial(jax.jit, static_argnums=2)
def _sense(image, yaw, name):
    """The strips of an image between walls to either side of a robot that is turned, rad."""
    sensor, half = make_sensor(name), jnp.float32(HALF)
    return strips.sense(_seen(image, sensor), Corridor(half, half, yaw), SimpleNamespace(lidar=sensor))


@partial(jax.jit, static_argnums=1)
def _metres(record, n):
    return streams.metres(record, matching.init(jax.random.key(0)), n)


def _seen(image, sensor):
    scan = jnp.asarray(image, jnp.float32)
    level = level_ring(scan, sensor.shape)
    return Observed(scan, level, distance=jnp.zeros(()), heading=jnp.zeros(()), entries={"scan": scan})


def test_a_spinning_lidar_sees_strips_of_the_wall_at_their_heights():
    sensor = make_sensor("spin16x64")
    flat_walls = _sense(_image(3.0, sensor, 0.0, 0.0), np.float32(0.0), "spin16x64")
    points = _sense(_image(3.0, sensor, 0.5, 0.8), np.float32(0.0), "spin16x64")
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
    image = np.minimum(HALF / np.maximum(np.abs(turned[:, 1]), 1e-6), 30.0)
    points = _sense(image, np.float32(yaw), "spin16x64")
    np.testing.assert_allclose(np.asarray(points.out)[np.asarray(points.seen)], 0.0, atol=1e-4)
    assert np.mean(points.seen) > 0.9


@pytest.mark.parametrize("fraction", [-0.02, 0.02])
def test_strips_above_the_level_ring_tell_the_error_of_the_command(fraction):
    sensor = make_sensor("spin16x64")
    driven = np.float32(0.2) * np.arange(5 * 30 + 2)
    images = np.stack([_image((1.0 + fraction) * d, sensor, 0.25, 9.0) for d in driven])
    points = jax.jit(jax.vmap(lambda image: _sense(image, np.float32(0.0), "spin16x64")))(images)
    record = streams.Record(jnp.asarray(driven), jnp.asarray((1.0 + fraction) * driven), points)
    blocks = _metres(record, 30)
    total = np.asarray(blocks.evidence)[DELAY + 8 :].sum(axis=0)
    assert matching.FRACTIONS[total.argmax()] == pytest.approx(fraction, abs=0.0045)
    level = record.replace(points=jax.tree.map(lambda leaf: leaf[:, : 4 * strips.RAYS], points))
    blind = _metres(level, 30)
    assert np.ptp(np.asarray(blind.evidence), axis=1).max() < 0.2, "at the level of the sensor the wall is smooth"


@pytest.mark.parametrize("radius", [80.0, -200.0])
def test_a_bend_is_found_and_its_points_are_put_along_the_axis(radius):
    angle = np.deg2rad(22.5) * np.arange(1, 8)
    beam = np.stack([np.cos(angle), np.sin(angle)])
    along, out, station = [], [], []
    for side in (1.0, -1.0):
        # Where a beam from the middle meets the circle of the wall, about a centre at (0, radius).
        reach_wall = abs(radius - side * HALF)
        dot = side * beam[1] * radius
        root = np.sqrt(dot**2 - radius**2 + reach_wall**2)
        both = np.stack([dot - root, dot + root])
        reach = np.where(both > 0.0, both, np.inf).min(axis=0)
        x, y = reach * beam[0], side * reach * beam[1]
        along.append(x)
        out.append(side * y - HALF)
        station.append(radius * np.arctan2(np.sign(radius) * x, np.sign(radius) * (radius - y)))
    points = Points(*(jnp.asarray(np.stack(rows), jnp.float32) for rows in (along, out)), jnp.ones((2, 7), bool))
    bend, follow = jnp.zeros(()), jax.jit(bends.follow)
    for _ in range(120):
        bend = follow(bend, points, np.float32(0.2))
    assert float(bend) == pytest.approx(1.0 / radius, rel=0.05)
    walls = Corridor(jnp.float32(HALF), jnp.float32(HALF), jnp.float32(0.0))
    straight = bends.straighten(points, walls, bend)
    before, after = (np.abs(np.asarray(p.along) - np.stack(station)).max() for p in (points, straight))
    assert after < 0.015 < 0.07 < before
    assert np.abs(np.asarray(straight.out)).max() < 0.03


def test_a_robot_that_stands_learns_no_bend_from_a_niche():
    points = Points(jnp.ones((2, 7)), jnp.zeros((2, 7)).at[0, :3].set(0.9), jnp.ones((2, 7), bool))
    assert float(bends.follow(jnp.zeros(()), points, jnp.zeros(()))) == 0.0


def test_a_point_adds_to_the_bins_about_it_and_beyond_the_ends_only_where_they_wrap():
    shape = (2, N_BEARINGS)
    points = Points(jnp.zeros(shape), jnp.ones(shape), jnp.ones(shape, bool))
    cut, wrapped = (add_points(blank(10, 2), points, jnp.zeros(shape), wrapped=on).weight for on in (False, True))
    np.testing.assert_array_equal(cut[..., 0], 1.0)
    assert (cut[..., 1] > 0.0).all()
    assert not cut[..., 9].any()
    np.testing.assert_array_equal(wrapped[..., 9], wrapped[..., 1])
