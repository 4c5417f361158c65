"""Measured sleepers and floors, and the planes by which balls and wheels meet them."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.host import rover
from subterra_jax.physics import ground
from subterra_jax.physics.ground import RAIL_HALF, RAIL_OFFSET, TrackError, join_tracks, move_anchor, read_track
from subterra_jax.physics.rotations import rotate
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.shell import make_bricks
from tests.recorded import check, named
from tests.subterra_jax.tunnels import straight, tunnel_arrays

FORWARD = jnp.array([1.0, 0.0, 0.0])
HEAD = RAIL_OFFSET - RAIL_HALF[0]  # from the axis to the inner face of a rail, m
turned = jax.jit(jax.vmap(rotate, in_axes=(0, None)))
follow = jax.jit(move_anchor)


def sleepers(count, grade=0.0, protrusion=0.05):
    """Bricks of sleepers every 0.7 m along x with a grade, and one slab of ballast under them."""
    along = np.array([np.cos(grade), 0.0, np.sin(grade)])
    up = np.array([-np.sin(grade), 0.0, np.cos(grade)])
    at = 0.7 * np.arange(1, count + 1)[:, None] * along
    rows = make_bricks(at - 0.1 * up, np.zeros(count), np.tile([0.125, 1.25, 0.1], (count, 1)), 0.2)
    slab = make_bricks(np.array([4.0 * along - (protrusion + 0.1) * up]), np.zeros(1), np.array([[5.0, 2.0, 0.1]]))
    for row in (*rows, *slab):
        row[3:6], row[9:12] = np.linalg.norm(row[3:6]) * along, np.linalg.norm(row[9:12]) * up
    return np.concatenate([slab, rows])


@pytest.fixture(scope="module")
def floor(plan_of):
    return plan_of(tunnel_arrays(straight(20.0)))


@pytest.fixture(scope="module")
def railway(floor):
    return dataclasses.replace(floor, shell=SimpleNamespace(track=sleepers(26, protrusion=0.06)))


def test_the_packaged_tunnel_has_its_586_sleepers_as_measured():
    plan = st.load_tunnel()
    track = read_track(plan)
    assert track.station.shape == (586,)
    assert np.ptp(np.diff(track.station)) > 0.05, "they were laid by rule, not measured"
    assert np.mean(np.diff(track.station)) == pytest.approx(0.6, abs=0.002)
    centre = np.column_stack([np.interp(track.station, plan.station, plan.centre[:, i]) for i in range(2)])
    assert np.linalg.norm(np.asarray(track.position[:, :2]) - centre, axis=1).max() < 0.1
    assert float(track.protrusion[0]) == pytest.approx(0.06, abs=0.02)
    assert (np.asarray(track.rails) == 1.0).all()


def test_sleepers_are_taken_with_grade_and_protrusion(floor):
    found = read_track(dataclasses.replace(floor, shell=SimpleNamespace(track=sleepers(12, grade=0.02))))
    np.testing.assert_allclose(found.station, 0.7 * np.cos(0.02) * np.arange(1, 13), atol=1e-5)
    np.testing.assert_allclose(found.protrusion, 0.05, atol=1e-5)
    np.testing.assert_allclose(turned(found.quaternion, FORWARD)[3], [np.cos(0.02), 0.0, np.sin(0.02)], atol=1e-6)


def test_a_tunnel_without_sleepers_has_its_floor_with_the_grade(floor):
    found = read_track(dataclasses.replace(floor, elevation=0.03 * floor.station))
    assert float(found.protrusion.max()) == float(found.rails.max()) == 0.0
    np.testing.assert_allclose(found.position[:, 2], 0.03 * found.station, atol=1e-6)
    np.testing.assert_allclose(turned(found.quaternion, FORWARD)[5, 2], np.sin(np.arctan(0.03)), atol=1e-6)


def test_a_tunnel_of_three_metres_is_too_short(plan_of):
    with pytest.raises(TrackError, match="too short for a robot with mass"):
        read_track(plan_of(tunnel_arrays(straight(3.0))))


def test_each_tunnel_of_a_stack_keeps_its_rows_to_itself(floor, railway):
    stack = join_tracks([read_track(floor), read_track(railway)])
    n = int(stack.last[0]) + 1
    assert int(stack.nearest(jnp.float32(0.7), 0)) == 1
    assert int(stack.nearest(jnp.float32(0.7), 1)) == n
    anchor, _ = follow(stack, jnp.int32(n), jnp.array([-0.6, 0.0, 0.0]))
    assert int(anchor) == n, "it went over into another tunnel"


def test_the_anchor_follows_the_robot_and_places_add_up_to_a_tenth_of_a_millimetre():
    long = read_track(st.load_tunnel("metro"))
    anchor, local = jnp.int32(1500), jnp.zeros(3)
    start = np.asarray(long.position[1500], np.float64)
    walked, ahead = np.zeros(3), np.asarray(turned(long.quaternion, FORWARD), np.float64)
    for k in range(600):
        stride = 0.04 * ahead[anchor]
        walked += stride
        anchor, local = follow(long, anchor, local + stride.astype(np.float32))
        assert np.linalg.norm(local) < 0.5, k
    assert 1530 < int(anchor) < 1550
    np.testing.assert_allclose(np.asarray(long.position[anchor], np.float64) + local, start + walked, atol=1e-4)


@pytest.fixture(scope="module")
def gaps(floor, railway):
    """Distances, m, of a ball of 5 cm, or the rover's wheel, from the nearest two things, and their directions."""
    tunnel = Tunnel.from_plan(floor)
    stack = join_tracks([read_track(floor), read_track(railway)])

    def measured(laid, offset, wheel, yaw):
        anchor = stack.nearest(jnp.float32(7.0), laid)
        there = jnp.concatenate(
            [jnp.array([7.0, 0.0, 0.0]) - stack.position[anchor] + offset, jnp.array([1.0, 0, 0, 0])]
        )
        window, _ = ground.look_around(stack, tunnel, anchor, there, np.zeros((1, 3)))
        radius, half = (rover.WHEEL_RADIUS, rover.WHEEL_HALF) if wheel else (0.05, None)
        axle = jnp.stack([-jnp.sin(yaw), jnp.cos(yaw), 0.0])
        points, normals = ground.touched_planes(window, there[:3], axle, radius, half)
        return jnp.sum((there[:3] - points) * normals, axis=1) - radius, normals, window.gap

    run = jax.jit(measured, static_argnums=2)

    def least(laid, x, y, z, wheel=False, yaw=0.0):
        gap, normal, _ = run(laid, jnp.array([x, y, z]), wheel, jnp.float32(yaw))
        order = np.argsort(gap)
        return np.asarray(gap)[order], np.asarray(normal)[order]

    return least


@pytest.mark.parametrize("name", ["subterra-351", "metro"])
def test_what_lies_about_a_robot_is_what_it_was(name):
    """Sleepers, rails, walls and drop under four feet, on a grade, in bends and beside the walls."""
    plan = st.load_tunnel(name)
    track, tunnel = read_track(plan), Tunnel.from_plan(plan)
    feet = jnp.array([[0.35, 0.2, -0.5], [0.35, -0.2, -0.5], [-0.35, 0.9, -0.5], [-0.35, -2.2, -0.4]])

    def look(station, aside, yaw):
        anchor = track.nearest(station, 0)
        qpos = jnp.array([0.1, aside, 0.55, jnp.cos(yaw / 2), 0.0, 0.02, jnp.sin(yaw / 2)])
        return ground.look_around(track, tunnel, anchor, qpos, feet), move_anchor(track, anchor, 9.0 * qpos[:3])

    places = [jnp.array(row, jnp.float32) for row in ((60.0, 150.0, 240.3), (0.0, 1.1, -1.9), (0.0, 0.6, 2.9))]
    check(__file__, name, named(jax.jit(jax.vmap(look))(*places)), 1e-3)


def test_a_ball_is_as_far_as_geometry_says_from_floor_sleeper_and_rail(gaps):
    """x = 0 is the middle of a sleeper whose top is at z = 0."""
    gap, normal = gaps(0, 0.1, 0.3, 0.2)
    assert gap[0] == pytest.approx(0.15, abs=1e-5)
    np.testing.assert_allclose(normal[0], [0.0, 0.0, 1.0], atol=1e-5)
    assert gap[1] > 0.5, "a floor has neither sleepers nor rails"
    gap, _ = gaps(1, 0.05, 0.3, 0.08)  # over the sleeper
    np.testing.assert_allclose(gap, [0.03, 0.09], atol=1e-5)
    gap, normal = gaps(1, 0.13, 0.0, 0.04)  # beside and above its edge
    assert gap[0] == pytest.approx(0.0, abs=1e-5)
    np.testing.assert_allclose(normal[0], [0.6, 0.0, 0.8], atol=1e-4)
    gap, normal = gaps(1, 0.35, HEAD - 0.06, 0.02)  # between two sleepers, by the rail
    np.testing.assert_allclose(gap, [0.01, 0.03], atol=1e-5)
    np.testing.assert_allclose(normal[0], [0.0, -1.0, 0.0], atol=1e-5)
    gap, normal = gaps(1, 0.0, -RAIL_OFFSET, 0.25)  # on the other rail
    assert gap[0] == pytest.approx(0.25 - 0.186 - 0.05, abs=1e-5)
    gap, _ = gaps(1, 0.02, 0.0, -0.01)  # its middle is in the sleeper
    assert gap[0] == pytest.approx(-0.06, abs=1e-5)


def test_a_wheel_is_as_narrow_as_its_tread_beside_a_rail_and_as_high_as_its_radius_over_a_sleeper(gaps):
    radius, half = rover.WHEEL_RADIUS, rover.WHEEL_HALF
    gap, _ = gaps(1, 0.0, HEAD - half - 0.02, radius + 0.01, wheel=True)
    np.testing.assert_allclose(gap, [0.01, 0.02], atol=1e-5)
    gap, _ = gaps(1, 0.0, HEAD - radius - 0.02, radius + 0.01, wheel=True, yaw=np.pi / 2)
    np.testing.assert_allclose(gap, [0.01, 0.02], atol=1e-5)
    gap, _ = gaps(0, 0.0, 0.0, radius, wheel=True)
    assert gap[0] == pytest.approx(0.0, abs=1e-5)
