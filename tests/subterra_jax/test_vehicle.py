"""Motion along exact arcs, contact with the walls, and the foot on the centreline."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import reference
from subterra_jax.parts import unicycle as vehicle
from subterra_jax.tunnel import Tunnel, foot
from subterra_jax.tunnel.sources import load_tunnel
from tests.subterra_jax import tunnels

PARAMS = jax.tree.map(jnp.asarray, vehicle.VehicleParams())
clearance, foot_of_each = jax.jit(vehicle.clearance), jax.jit(jax.vmap(foot, (None, 0, 0)))


def touching(tunnel, position, station):
    """Whether a robot at a place is in contact."""
    clear = clearance(tunnel, jnp.array(position, jnp.float32), jnp.float32(station))
    return bool(vehicle.in_contact(tunnel, clear, jnp.float32(station), PARAMS))


@pytest.mark.parametrize("command", [(2.0, 0.0), (1.0, 1.5), (2.0, -0.3), (0.0, 1.0), (1.7, 1e-4)])
def test_a_constant_command_is_followed_along_its_exact_arc(command):
    v, w = command
    position, heading = jnp.array([3.0, -1.0]), jnp.float32(0.5)
    for _ in range(10):
        position, heading = vehicle.follow_arc(position, heading, jnp.array(command), PARAMS.period)
    if w == 0.0:
        expected = np.array([3.0, -1.0]) + v * np.array([np.cos(0.5), np.sin(0.5)])
    else:
        expected = np.array([3.0, -1.0]) + v / w * np.array(
            [np.sin(0.5 + w) - np.sin(0.5), np.cos(0.5) - np.cos(0.5 + w)]
        )
    np.testing.assert_allclose(position, expected, atol=2e-5)
    assert float(heading) == pytest.approx(0.5 + w, abs=1e-5)


def test_headings_stay_within_half_a_turn():
    heading = jnp.float32(0.0)
    for _ in range(100):
        _, heading = vehicle.follow_arc(jnp.zeros(2), heading, jnp.array([0.0, 1.5]), PARAMS.period)
        assert abs(float(heading)) <= np.float32(np.pi)
    assert float(heading) == pytest.approx((15.0 + np.pi) % (2 * np.pi) - np.pi, abs=1e-4)


@pytest.mark.parametrize(
    ("action", "obeyed"),
    [
        ((1.0, 0.5), (1.0, 0.5)),
        ((9.0, -9.0), (2.0, -1.5)),
        ((-1.0, 1.4), (0.0, 1.4)),
        ((np.nan, 1.0), (0.0, 1.0)),
        ((np.inf, -np.inf), (2.0, -1.5)),
        ((-np.inf, np.nan), (0.0, 0.0)),
    ],
)
def test_actions_are_clipped_and_never_rejected(action, obeyed):
    np.testing.assert_array_equal(vehicle.clip_action(jnp.array(action), PARAMS), np.float32(obeyed))


@pytest.mark.parametrize("lining", ["smooth", "pockets"])
def test_clearance_is_the_distance_to_the_nearest_of_all_segments(lining):
    plan = load_tunnel()
    tunnel, rng = Tunnel.from_plan(plan, lining), np.random.default_rng(0)
    poses = reference.random_poses(plan, 2000, rng, gap=0.15)
    edge = reference.random_poses(plan, 500, rng, gap=0.15, near_mouths=True)
    position, station = np.concatenate([poses.position, edge.position]), np.concatenate([poses.station, edge.station])
    measured = np.asarray(jax.jit(jax.vmap(vehicle.clearance, (None, 0, 0)))(tunnel, position, station))
    truth = reference.clearance(plan.lining(lining).segments, position)
    near = truth < 0.79
    assert near.sum() > 200
    np.testing.assert_allclose(measured[near], truth[near], atol=1e-5)
    assert (measured[~near] > 0.78).all()


@pytest.mark.parametrize(("lateral", "touches"), [(2.424, False), (2.426, True), (-2.424, False), (-2.426, True)])
def test_contact_begins_where_the_footprint_meets_the_wall(plan_of, lateral, touches):
    tunnel = Tunnel.from_plan(plan_of(tunnels.tunnel_arrays(tunnels.straight(20.0))), "smooth")
    assert touching(tunnel, [10.1, lateral], 10.1) is touches


@pytest.mark.parametrize(("station", "touches"), [(-0.39, False), (-0.41, True), (20.39, False), (20.41, True)])
def test_a_robot_wholly_outside_a_mouth_is_in_contact(plan_of, station, touches):
    tunnel = Tunnel.from_plan(plan_of(tunnels.tunnel_arrays(tunnels.straight(20.0))), "smooth")
    assert touching(tunnel, [station, 0.0], station) is touches


@pytest.mark.parametrize("radius", [60.0, 300.0])
def test_the_foot_on_the_centreline_is_found_from_the_previous_station(plan_of, radius):
    pieces = tunnels.s_bend(150.0, radius)
    tunnel = Tunnel.from_plan(plan_of(tunnels.tunnel_arrays(pieces)), "smooth")
    truth, rng = tunnels.Plan(pieces), np.random.default_rng(0)
    station, lateral = rng.uniform(0.0, 150.0, 1000), rng.uniform(-2.4, 2.4, 1000)
    near = station + rng.uniform(-0.2, 0.2, 1000)
    found = foot_of_each(tunnel, np.float32(truth.point(station, lateral)), np.float32(near))
    np.testing.assert_allclose(found.station, station, atol=1.5e-3)
    np.testing.assert_allclose(found.lateral, lateral, atol=1.5e-3)
    np.testing.assert_allclose(found.half_width, 2.825, atol=1e-5)
