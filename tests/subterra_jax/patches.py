"""A straight corridor with patches on its walls, drives through it as a localiser records them, and its map."""

import jax.numpy as jnp
import numpy as np

from subterra_jax.policies.locate import streams
from subterra_jax.policies.locate.map_strip import MapStrip
from subterra_jax.policies.locate.profiles import BIN, Points

HALF, N_METRES = 2.7, 40  # m; metres


def patches(station, seed=3):
    """Depth at stations of patches of 6 cm at random, the same everywhere they are looked at from, m."""
    edges = np.cumsum(np.random.default_rng(seed).uniform(0.3, 1.5, 200)) - 20.0
    return np.where(np.searchsorted(edges, station) % 2 == 0, 0.06, 0.0)


def drive_past(fraction, sigma=0.02, seed=0):
    """A robot in the middle of a straight tunnel that drives (1 + fraction) times what is commanded."""
    driven = 0.2 * np.arange(5 * N_METRES + 2)
    angle = np.deg2rad(22.5) * np.arange(1, 8)
    along = np.broadcast_to(HALF / np.tan(angle), (len(driven), 2, 7))
    station = (1.0 + fraction) * driven[:, None, None] + along + np.array([0.0, 7.3])[:, None]
    noise = sigma * np.random.default_rng(seed).standard_normal(station.shape)
    points = Points(jnp.asarray(along), jnp.asarray(patches(station) + noise), jnp.ones(station.shape, bool))
    return streams.Record(jnp.asarray(driven), jnp.asarray((1.0 + fraction) * driven), points)


def map_of_walls(first=0.0, n_metres=160, seed=3, side=7.3):
    """The map of two walls with `patches`; the right one shows them `side` metres on."""
    centre = BIN * (np.arange(10 * n_metres) + 0.5)
    left, right = (patches(first + centre + off, seed) for off in (0.0, side))
    one = lambda value: jnp.full(1, value, jnp.int32)  # noqa: E731
    return MapStrip(jnp.asarray(HALF + np.stack([left, right]), jnp.float32), one(0), one(10 * n_metres), one(0))
