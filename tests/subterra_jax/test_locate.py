"""Learnt localisers: the front end against known walls, and the robot's metres against those of training."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from subterra_jax.policies.locate import kalman, matching, memory, streams
from subterra_jax.policies.locate.blocks import DELAY, N_RAW, Block
from subterra_jax.policies.locate.profiles import Points

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


def _random_blocks(n, key=1):
    rng = np.random.default_rng(key)
    evidence = 2.0 * rng.standard_normal((n, matching.N_SHARES))
    evidence[:DELAY] = 0.0
    return Block(
        jnp.asarray(evidence, jnp.float32),
        jnp.asarray(0.03 * rng.standard_normal(n), jnp.float32),
        jnp.full(n, 5.0),
        jnp.asarray(rng.standard_normal((n, N_RAW)), jnp.float32),
    )


@pytest.mark.parametrize("network", memory.NETWORKS)
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
    evidence = jnp.broadcast_to(sharp, (n, matching.N_SHARES)).at[:DELAY].set(0.0)
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
