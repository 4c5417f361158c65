"""Planar LiDAR: analytic rooms, and float64 brute force over every segment of the same walls."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import reference
from subterra_jax import lidar
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.sources import load_tunnel
from tests.subterra_jax import tunnels

PARAMS = lidar.LidarParams()


@partial(jax.jit, static_argnames="n_beams")
def device_scan(tunnel, position, heading, station, n_beams=16):
    params = lidar.LidarParams(n_beams=n_beams)
    return jax.vmap(partial(lidar.scan, params=params), (None, 0, 0, 0))(tunnel, position, heading, station)


def device_scans(tunnel: Tunnel, poses: reference.Poses, chunk: int = 2500) -> np.ndarray:
    parts = np.array_split(np.arange(len(poses.station)), max(1, len(poses.station) // chunk))
    return np.concatenate(
        [np.asarray(device_scan(tunnel, poses.position[i], poses.heading[i], poses.station[i])) for i in parts]
    )


def check_exact(plan: TunnelPlan, lining: str, n_poses: int, **kwargs: bool) -> reference.Agreement:
    poses = reference.random_poses(plan, n_poses, np.random.default_rng(1), **kwargs)
    ranges = device_scans(Tunnel.from_plan(plan, lining), poses)
    result = reference.agreement(plan.lining(lining).segments, poses, ranges)
    print(f"\n{plan.name} {lining}: {result}")
    assert result.n_wrong == 0
    assert result.max_error < 1e-3
    assert result.n_ambiguous <= 1e-4 * result.n_rays
    return result


@pytest.fixture(scope="module")
def room(plan_of):
    """A room of 4 m × 2 m: two walls, and an end wall at either mouth."""
    arrays = tunnels.tunnel_arrays(tunnels.straight(4.0), half_width=1.0)
    arrays["furniture_smooth"] = np.array([[0.0, 1.0, 0.0, -1.0], [4.0, 1.0, 4.0, -1.0]])
    return plan_of(arrays)


def scan_at(plan: TunnelPlan, x: float, y: float, heading: float, n_beams: int = 16) -> np.ndarray:
    tunnel = Tunnel.from_plan(plan, "smooth")
    position, headings = np.array([[x, y]], np.float32), np.array([heading], np.float32)
    ranges = np.asarray(device_scan(tunnel, position, headings, np.array([x], np.float32), n_beams))[0]
    truth = reference.scan(plan.lining("smooth").segments, position, headings, n_beams)[0]
    np.testing.assert_allclose(ranges, truth, atol=1e-5)
    return ranges


def test_the_middle_of_a_room_of_4_by_2_metres_gives_2_1_and_the_diagonal(room):
    ranges = scan_at(room, 2.0, 0.0, 0.0)
    np.testing.assert_allclose(ranges[[0, 2, 4, 6, 8, 12]], [2, 2**0.5, 1, 2**0.5, 2, 1], atol=1e-5)


def test_beams_count_counter_clockwise_from_straight_ahead(room):
    ranges = scan_at(room, 1.0, 0.25, 0.0)
    np.testing.assert_allclose(ranges[[0, 4, 8, 12]], [3.0, 0.75, 1.0, 1.25], atol=1e-5)
    turned = scan_at(room, 1.0, 0.25, np.pi / 2)
    np.testing.assert_allclose(turned[[0, 4, 8, 12]], [0.75, 1.0, 1.25, 3.0], atol=1e-5)


@pytest.mark.parametrize("n_beams", [1, 5, 8, 64])
def test_any_number_of_beams_is_exact(room, n_beams):
    assert scan_at(room, 1.3, -0.2, 0.7, n_beams).shape == (n_beams,)


def test_a_beam_out_of_a_mouth_reports_exactly_range_max(plan_of):
    plan = plan_of(tunnels.tunnel_arrays(tunnels.straight(10.0)))
    ranges = scan_at(plan, 5.0, 0.0, 0.0)
    assert ranges[0] == PARAMS.range_max
    assert ranges[8] == PARAMS.range_max
    assert ranges[4] == pytest.approx(2.825, abs=1e-5)


@pytest.mark.parametrize("n_candidates", [1, 3])
@pytest.mark.parametrize("fused", [True, False])
def test_a_beam_along_a_row_of_deep_recesses_is_exact(fused, n_candidates):
    """Refuges in masonry, each in a box as thick as it is long: a beam along the wall enters up to 16 of them."""
    plan = load_tunnel("open:masonry:train:0").slice(100.0, 120.0)
    tunnel = dataclasses.replace(Tunnel.from_plan(plan), n_candidates=n_candidates)
    params = lidar.LidarParams(fused=fused)
    poses = reference.random_poses(plan, 500, np.random.default_rng(1))
    scan = jax.jit(jax.vmap(partial(lidar.scan, params=params), (None, 0, 0, 0)))
    ranges = np.asarray(scan(tunnel, poses.position, poses.heading, poses.station))
    result = reference.agreement(plan.lining(plan.default_lining).segments, poses, ranges)
    assert (result.n_wrong, result.n_ambiguous) == (0, 0)


def test_noise_has_its_size_stays_in_range_and_spares_beams_without_a_hit():
    true = jnp.array([10.0, 30.0, 0.01, 29.99])
    noise = jax.random.normal(jax.random.key(0), (20_000, 4))
    noisy = np.asarray(jax.vmap(lidar.add_noise, (None, 0, None))(true, noise, PARAMS))
    assert noisy[:, 0].std() == pytest.approx(0.05, rel=0.03)
    assert noisy[:, 0].mean() == pytest.approx(10.0, abs=3 * 0.05 / 20_000**0.5)
    assert (noisy[:, 1] == 30.0).all()
    assert noisy.min() >= 0.0
    assert noisy.max() <= 30.0


@pytest.mark.parametrize(
    ("name", "lining", "n_poses"),
    [
        pytest.param("subterra-351", "pockets", 100_000, marks=pytest.mark.slow),
        ("subterra-351", "pockets", 20_000),
        ("subterra-351", "smooth", 20_000),
        ("subterra-351", "furnished", 20_000),
        ("metro", "smooth", 10_000),
    ],
)
def test_the_packaged_tunnels_are_exact_at_random_poses(name, lining, n_poses):
    check_exact(load_tunnel(name), lining, n_poses)


@pytest.mark.parametrize("lining", ["pockets", "smooth"])
@pytest.mark.parametrize(
    ("pieces", "rough", "correlation"),
    [
        (tunnels.straight(80.0), 0.0, 1.0),
        (tunnels.arc(150.0, -60.0), 0.015, 1.0),
        (tunnels.s_bend(150.0, 60.0), 0.0, 1.0),
        (tunnels.s_bend(200.0, 300.0), 0.015, 0.1),
        (tunnels.s_bend(200.0, 1000.0), 0.03, 3.0),
    ],
    ids=["straight", "arc of 60 m, rough", "S of 60 m, clean", "S of 300 m, white noise", "S of 1 km, wavy"],
)
def test_procedural_tunnels_are_exact_at_random_poses_and_near_their_mouths(
    plan_of, pieces, rough, correlation, lining
):
    plan = plan_of(tunnels.tunnel_arrays(pieces, roughness=rough, correlation=correlation, seed=3))
    check_exact(plan, lining, 5000)
    check_exact(plan, lining, 2000, near_mouths=True)


def test_a_sparse_wall_of_long_segments_is_exact(plan_of):
    check_exact(plan_of(tunnels.tunnel_arrays(tunnels.s_bend(150.0, 80.0), wall_step=7.5)), "smooth", 3000)


def test_a_recess_wide_enough_for_the_robot_is_seen_from_within(plan_of):
    arrays = tunnels.tunnel_arrays(tunnels.straight(40.0))
    niche = np.array([[15.0, 2.825], [15.0, 4.5], [17.5, 4.5], [17.5, 2.825]])
    left = arrays["left_smooth"]
    keep = (left[:, 0] < 15.0) | (left[:, 0] > 17.5)
    at = int(np.sum(left[:, 0] < 15.0))
    arrays["left_smooth"] = np.insert(left[keep], at, niche, axis=0)
    arrays["left_station_smooth"] = arrays["left_smooth"][:, 0]
    plan = plan_of(arrays)
    rng = np.random.default_rng(0)
    position = np.column_stack([rng.uniform(15.3, 17.2, 2000), rng.uniform(0.0, 4.2, 2000)]).astype(np.float32)
    poses = reference.Poses(position, rng.uniform(-3.0, 3.0, 2000).astype(np.float32), position[:, 0])
    ranges = device_scans(Tunnel.from_plan(plan, "smooth"), poses)
    result = reference.agreement(plan.lining("smooth").segments, poses, ranges)
    assert (result.n_wrong, result.max_error < 1e-3) == (0, True)
