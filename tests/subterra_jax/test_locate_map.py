"""Learnt localisers with a map: hidden starts, maps of other tunnels, and the map itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.policies.locate import map_filter, streams
from subterra_jax.policies.locate.blocks import DELAY, Estimate
from subterra_jax.policies.locate.map_strip import map_strip
from subterra_jax.policies.locate.profiles import BIN
from subterra_jax.tunnel import Tunnel
from tests.subterra_jax.patches import HALF, N_METRES, drive_past, map_of_walls, patches


def _beliefs(weights, share, told, sigma, strip, passed):
    record = jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype != bool else x, drive_past(share))
    return _sequence(weights, record, strip, np.float32(told), np.float32(sigma), passed)


@jax.jit
def _sequence(weights, record, strip, told, sigma, passed):
    whole, rate = streams.profiles_of(record, N_METRES), jnp.zeros(N_METRES)
    beliefs = map_filter.sequence(weights, whole, streams.BEFORE, strip.pick(0), told, sigma, passed, rate)
    return beliefs, map_filter.place(jax.tree.map(lambda leaf: leaf[-1], beliefs))


# The relief is met from station 0 of `patches` on; the map begins 50 m before.
@pytest.mark.parametrize(("offset", "share"), [(0.0, 0.0), (3.0, 0.0), (-4.2, 0.02), (2.0, -0.03)])
def test_a_map_tells_how_far_the_start_is_off(offset, share):
    weights = map_filter.init(jax.random.key(0))
    passed = (
        np.maximum(np.arange(N_METRES) - DELAY + 1.0, 0.0) * share
    )  # what a perfect localiser says of the metres passed
    beliefs, (found, sigma, believed) = _beliefs(
        weights, share, 50.0 - offset, 3.0, map_of_walls(first=-50.0), passed.astype(np.float32)
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
