"""Scan matching without a map: it finds a shift where walls have structure, and says so where they have none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax import lidar
from subterra_jax.baselines.agent import observed
from subterra_jax.baselines.registry import make_agent
from subterra_jax.baselines.scanmatch import (
    N_SHIFTS,
    AxisPose,
    MatchParams,
    add_scan,
    best_match,
    centre,
    empty_profile,
    mismatch,
    scan_matching,
)
from subterra_jax.baselines.stations import Driven
from subterra_jax.evaluation import evaluate, listed_episodes
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
    scan = lidar.scan(straight["smooth"], jnp.array([20.0, 0.0]), jnp.zeros(()), jnp.float32(20.0), BEAMS)
    once = add_scan(empty_profile(), pose_at(20.0), scan, PARAMS)
    turned = add_scan(once, pose_at(20.0 + 256 * 0.08), scan, PARAMS)
    np.testing.assert_allclose(turned.count.sum(), once.count.sum())
    assert int(jnp.max(turned.stamp)) > int(jnp.max(once.stamp))


@pytest.mark.slow
def test_scan_matching_beats_dead_reckoning_between_pockets():
    env, params = st.make("Subterra/StopAt-v1")
    episodes = listed_episodes(env, params, 50)
    found = evaluate(env, params, scan_matching(params), episodes)
    blind = evaluate(env, params, make_agent("fused", params), episodes)
    assert found.success.mean() > blind.success.mean() + 0.1


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
