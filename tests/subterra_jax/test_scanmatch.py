"""Scan matching without a map, and the likelihood of a scan that is cast at a pose, against SciPy's least."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

import subterra_jax as st
from subterra_jax import lidar
from subterra_jax.baselines.agent import observed
from subterra_jax.baselines.exactscan import ExactParams, cast_beams, exact_likelihood
from subterra_jax.baselines.registry import make_agent
from subterra_jax.baselines.scanmatch import (
    BIN,
    N_BINS,
    N_SHIFTS,
    AxisPose,
    MatchParams,
    WallProfile,
    add_scan,
    best_match,
    centre,
    empty_profile,
    mismatch,
    solve_adjustment,
)
from subterra_jax.baselines.scanmodel import TunnelPose
from subterra_jax.baselines.stations import Driven
from subterra_jax.baselines.wallmap import wall_map
from tests.subterra_jax import tunnels

BEAMS, PARAMS = lidar.LidarParams(), MatchParams()
N_SEEN, N_MATCHED = 100, 25


def pose_at(station, half_width=2.825) -> AxisPose:
    zero = jnp.zeros(())
    return AxisPose(jnp.asarray(station, jnp.float32), zero, zero, zero, jnp.float32(half_width))


@jax.jit
def matched(tunnel, wrong, key):
    """Mismatch gathered over 5 m by one who is `wrong` about where it is, after 20 m on which it was right."""
    # Not a multiple of the bins, or always the same ones would be seen.
    station = 20.0 + 0.197 * jnp.arange(N_SEEN + N_MATCHED)
    noise = jax.random.normal(key, (N_SEEN + N_MATCHED, BEAMS.n_beams))

    def look(station, noise):
        position = jnp.stack([station, jnp.zeros(())])
        return lidar.add_noise(lidar.scan(tunnel, position, jnp.zeros(()), station, BEAMS), noise, BEAMS)

    scans = jax.vmap(look)(station, noise)
    add = lambda profile, one: (add_scan(profile, pose_at(one[0]), one[1], PARAMS), None)  # noqa: E731
    profile, _ = jax.lax.scan(add, empty_profile(), (station[:N_SEEN], scans[:N_SEEN]))

    def one(profile, now):
        pose = centre(pose_at(now[0] - wrong), now[1], PARAMS)
        cost = mismatch(profile, pose, now[1], PARAMS)
        return add_scan(profile, pose_at(now[0]), now[1], PARAMS), cost

    return best_match(jnp.sum(jax.lax.scan(one, profile, (station[N_SEEN:], scans[N_SEEN:]))[1], axis=0), PARAMS)


def test_an_offset_is_worth_as_much_as_one_residual_of_its_standard_deviation():
    change = solve_adjustment(jnp.full((1, 1), 0.1), jnp.zeros(1), jnp.full((1, 1), PARAMS.lateral_sigma**-2), PARAMS)
    np.testing.assert_allclose(change[:, 0], [-0.05, 0.0, 0.0], atol=1e-6)


@pytest.fixture(scope="module")
def straight(plan_of):
    plan = plan_of(tunnels.tunnel_arrays(tunnels.straight(80.0)))
    return {lining: st.Tunnel.from_plan(plan, lining) for lining in ("pockets", "smooth")}


@pytest.fixture(scope="module")
def found(straight):
    """Matches of ten drives by how wrong one was, m, and between which walls."""
    keys = jax.random.split(jax.random.key(0), 10)
    all_of = jax.jit(jax.vmap(matched, (None, None, 0)))
    return lambda lining, wrong: all_of(straight[lining], jnp.float32(wrong), keys)


@pytest.mark.parametrize("wrong", [-0.15, 0.0, 0.15])
def test_between_pockets_a_shift_is_found(found, wrong):
    shift = np.asarray(found("pockets", wrong).shift)
    assert np.median(shift) == pytest.approx(wrong, abs=0.05)
    assert np.mean(np.abs(shift - wrong) < 0.1) >= 0.8


def test_between_smooth_walls_there_is_less_information_than_between_pockets(found):
    pockets, smooth = found("pockets", 0.0), found("smooth", 0.0)
    assert np.mean(pockets.informative) >= 0.4
    assert np.mean(smooth.informative) <= 0.1
    assert np.median(pockets.information) > 1.5 * np.median(smooth.information)


def test_a_flat_cost_says_nothing():
    assert not bool(best_match(jnp.zeros(N_SHIFTS), PARAMS).informative)


def test_a_parabola_gives_its_vertex_and_its_curvature():
    shift = np.round(np.arange(-0.4, 0.401, 0.02), 2)
    found = best_match(jnp.asarray(2000.0 * (shift - 0.053) ** 2, jnp.float32), PARAMS)
    assert float(found.shift) == pytest.approx(0.053, abs=1e-3)
    assert float(found.information) == pytest.approx(4000.0, rel=1e-3)


def test_a_bin_that_stands_for_another_place_begins_anew(straight):
    add, place = jax.jit(add_scan), (np.array([20.0, 0.0], np.float32), np.float32(0.0), np.float32(20.0))
    scan = jax.jit(lidar.scan)(straight["smooth"], *place, BEAMS)
    once = add(empty_profile(), pose_at(20.0), scan, PARAMS)
    turned = add(once, pose_at(20.0 + 256 * 0.08), scan, PARAMS)
    np.testing.assert_allclose(turned.count.sum(), once.count.sum())
    assert int(jnp.max(turned.stamp)) > int(jnp.max(once.stamp))


@pytest.mark.parametrize("seen", [1.0, 4.0])
def test_a_brightness_counts_by_its_own_spread_and_that_of_the_mean_it_meets(seen):
    """The cost in closed form: every beam is off by 0.3 of a logarithm at every shift."""
    index = jnp.arange(N_BINS) + N_BINS * (jnp.arange(N_BINS) < N_BINS // 2)  # bins about station 20.48 m
    full = jnp.full((2, N_BINS), seen)
    profile = WallProfile(full * 0.5, full, jnp.broadcast_to(index, (2, N_BINS)), jnp.full((2, N_BINS), -9.0))
    ranges = jnp.full(16, 5.0)
    cost = mismatch(profile, pose_at(N_BINS * BIN), ranges, PARAMS, jnp.full(16, 0.8))
    variance = PARAMS.face_sigma**2 * (1.0 + 1.0 / seen)
    np.testing.assert_allclose(cost, 16 * 3.0 * np.log1p(0.3**2 / (6.0 * variance)), rtol=1e-5)


def test_of_a_lidar_in_three_dimensions_a_whole_level_ring_is_matched():
    env, params = st.make("Subterra/StopAtShort-v1", tunnel="control", sensor="spin16x64", estimates=True)
    matcher = make_agent("scan-matching", params).localiser
    obs, _ = env.reset(jax.random.key(0), params)
    rows, columns = params.lidar.shape
    still = Driven(jnp.zeros(()), jnp.ones(()), jnp.ones(()), jnp.zeros((), bool))

    def profile(flat):
        seen = observed(env, params, flat)
        return matcher.update(matcher.begin(seen, params), seen, still, params, None)[1].profile

    first = int(env.fields(params)["scan"].start)
    # One of the ring's beams that the 16 of a planar LiDAR leave out, and one of the ring below.
    between, below = (first + row * columns + columns // 4 + 1 for row in (rows // 2, rows // 2 - 1))
    assert int(profile(obs).count.sum()) > 32
    assert float(abs(profile(obs.at[between].add(-0.5)).total - profile(obs).total).max()) > 0.1
    np.testing.assert_array_equal(profile(obs.at[below].add(-0.5)).total, profile(obs).total)


EXACT, WIDTH, OFF = ExactParams(), 2.7, (0.01, 0.003)  # m; m and rad, a standard deviation each
likelihood, cast = jax.jit(exact_likelihood), jax.jit(cast_beams)


@pytest.fixture(scope="module", params=["straight", "bend"])
def place(request, plan_of):
    line = tunnels.straight(150.0) if request.param == "straight" else tunnels.arc(150.0, 300.0)
    plan = plan_of(tunnels.tunnel_arrays(line, half_width=WIDTH))
    params = st.make("Subterra/StopAt-v1", tunnel=plan, lining="smooth")[1]
    return wall_map(params.tunnel).pick(params.tunnel), params


def pose_of(station, lateral, heading) -> TunnelPose:
    return TunnelPose(*(jnp.atleast_1d(jnp.asarray(value, jnp.float32)) for value in (station, lateral, heading)))


def scan_at(place, lateral: float, heading: float):
    return cast(*place_at(place, lateral, heading), EXACT).expected[:, 0]


def place_at(place, lateral: float, heading: float):
    return place[0], pose_of(75.0, lateral, heading), place[1]


def gain(place, ranges, lateral: float, heading: float, exact: ExactParams = EXACT) -> float:
    walls, pose, params = place_at(place, lateral, heading)
    return float(likelihood(walls, pose, ranges, params, exact)[0])


def test_a_pose_that_is_a_little_off_loses_what_its_offset_and_heading_are_worth(place):
    ranges, lateral, heading = scan_at(place, 0.3, 0.2), 0.3 + OFF[0], 0.2 - OFF[1]
    whole = gain(place, ranges, 0.3, 0.2)
    # Half of half of two squares of one: the power and the normal density of a standard deviation each.
    assert whole - gain(place, ranges, lateral, heading) == pytest.approx(0.5, abs=0.3)
    tight = dataclasses.replace(EXACT, lateral_sigma=1e-5, heading_sigma=1e-5)
    assert whole - gain(place, ranges, lateral, heading, tight) > 3.0


@pytest.mark.parametrize("off", [OFF, (-0.015, 0.002), (0.0, -0.006)])
def test_it_is_the_least_over_offset_and_heading_that_an_optimiser_finds(place, off):
    walls, pose, params = place_at(place, 0.3 + off[0], 0.2 + off[1])
    ranges = scan_at(place, 0.3, 0.2) + 0.05 * np.random.default_rng(1).normal(size=16).astype(np.float32)
    beams = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64)[:, 0], cast(walls, pose, params, EXACT))
    lost, far = 0.1 * EXACT.lost, float(params.lidar.range_max)
    seen = np.asarray(ranges, np.float64) < far - 1e-3
    empty = beams.expected >= far - 1e-3

    def cost(x):
        rest = (np.asarray(ranges, np.float64) - beams.expected) * beams.slant + x[0] + x[1] * beams.along
        normal = np.exp(-0.5 * rest**2 / beams.variance) / np.sqrt(2.0 * np.pi * beams.variance) * np.abs(beams.slant)
        each = np.where(seen, np.log((1.0 - lost) * normal + lost / far), 0.0)
        each += np.where(seen, 0.0, np.where(empty, np.log1p(-0.5 * lost), np.log(0.5 * lost)))
        return -EXACT.power * (each.sum() - 0.5 * ((x[0] / 0.01) ** 2 + (x[1] / 0.003) ** 2))

    best = minimize(cost, [0.0, 0.0], method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-9}).fun
    found = gain(place, jnp.asarray(ranges), 0.3 + off[0], 0.2 + off[1])
    assert -best - 0.25 < found < -best + 1e-3


def test_a_box_before_a_wall_costs_what_a_false_echo_does_in_place_of_a_true_one(place):
    ranges = scan_at(place, 0.3, 0.2)
    boxed = ranges.at[3:5].set(1.5)
    lost = gain(place, ranges, 0.3, 0.2) - gain(place, boxed, 0.3, 0.2)
    beams = cast(*place_at(place, 0.3, 0.2), EXACT)
    true = np.abs(beams.slant[3:5, 0]) / np.sqrt(2.0 * np.pi * beams.variance[3:5, 0])
    # One echo in fifty is false, anywhere within 30 m as likely; the root of it counts.
    assert lost == pytest.approx(0.5 * np.sum(np.log(true / (0.02 / 30.0))), abs=0.3)
    # The other beams hold the pose: a station found by them alone is not pulled off.
    assert gain(place, boxed, 0.3, 0.2) > gain(place, boxed, 0.3 + 5 * OFF[0], 0.2 + 5 * OFF[1]) + 2.0


def test_a_beam_ends_as_unsure_as_its_range_is_and_as_the_tangent_leaves_its_wall(place):
    beams = cast(*place_at(place, 0.0, 0.0), EXACT)
    across, sigma = np.asarray(beams.expected[:, 0] * beams.slant[:, 0]), np.sqrt(np.asarray(beams.variance[:, 0]))
    square, ahead = 4, 1  # at 90 and 22.5 degrees
    assert sigma[square] == pytest.approx(np.hypot(0.05, 0.005 + 0.001 * WIDTH), rel=0.02)
    assert sigma[ahead] == pytest.approx(np.hypot(0.05 * 0.383, 0.005 + 0.001 * beams.expected[ahead, 0]), rel=0.06)
    assert across[square] == pytest.approx(WIDTH, abs=0.02)


def test_the_wall_that_a_slanting_beam_meets_runs_as_the_bend_does(place):
    walls, pose, params = place_at(place, 0.0, 0.0)
    beams, turn = cast(walls, pose, params, EXACT), 1e-3
    moved = cast(walls, dataclasses.replace(pose, heading=pose.heading + turn), params, EXACT)
    shifted = cast(walls, dataclasses.replace(pose, lateral=pose.lateral + turn), params, EXACT)
    ends = np.asarray(beams.expected)[:, 0] < float(params.lidar.range_max) - 1.0
    for other, lever in ((moved, beams.along), (shifted, 1.0)):
        # What a beam gains by a turn or a shift to its wall, it loses in range.
        gained = np.asarray((other.expected - beams.expected) * beams.slant + turn * lever)[:, 0]
        assert np.abs(gained[ends]).max() < 0.06 * turn * np.abs(np.asarray(lever)).max()
    assert lidar.bearings(16)[0] == 0.0
