"""The likelihood of a scan that is cast at a pose: against the least over offset and heading that SciPy finds."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

import subterra_jax as st
from subterra_jax import lidar
from subterra_jax.baselines.exactscan import ExactParams, cast_beams, exact_likelihood
from subterra_jax.baselines.scanmodel import TunnelPose
from subterra_jax.baselines.wallmap import wall_map
from tests.subterra_jax import tunnels

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
