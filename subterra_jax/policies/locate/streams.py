"""Metres of a whole drive at once, for training; `locator` makes the same ones as the robot goes."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.policies.locate import matching, profiles
from subterra_jax.policies.locate.blocks import DELAY, Block
from subterra_jax.policies.locate.profiles import BIN, BLOCK, Points, Profiles

BEFORE = 120  # bins of the profiles before the start
_AFTER = 120  # bins behind the last metre


@struct.dataclass
class Record:
    """A drive as its robot saw it."""

    driven: Float[Array, "time"]  # commanded distance along the axis at each observation, m; never falls
    read: Float[Array, "time"]  # odometer, m
    points: Points  # points on the walls


def metres(record: Record, weights: matching.Weights, n: int) -> Block:
    """Returns the first `n` metres of a drive.

    Args:
        record: The drive.
        weights: Of the front end.
        n: Number of metres.
    """
    ends = jnp.arange(n + 1, dtype=jnp.float32)
    reads = jnp.interp(ends, record.driven, record.read)
    times = jnp.interp(ends, record.driven, jnp.arange(len(record.driven), dtype=jnp.float32))
    return Block(_evidence(record, weights, n), jnp.diff(reads) - 1.0, jnp.diff(times))


def reached(record: Record, n: int) -> Bool[Array, "n"]:
    """Returns the metres that the drive has completed."""
    return jnp.arange(1, n + 1) <= record.driven[-1]


def profiles_of(record: Record, n: int) -> Profiles:
    """Returns the profiles of `n` metres of a drive, with `BEFORE` bins before its start."""
    where = (record.driven[:, None, None] + record.points.along) / BIN + BEFORE
    return profiles.add_points(profiles.blank(BLOCK * n + BEFORE + _AFTER, record.points.n_sides), record.points, where)


def _evidence(record: Record, weights: matching.Weights, n: int) -> Float[Array, "n n_fractions"]:
    """Returns the evidence of the block `DELAY` metres before each metre."""
    whole = profiles_of(record, n)
    features, there = matching.encode(weights, whole)
    first = BEFORE - matching.MARGIN - matching.LAGS  # of the first block's cut, in features

    def one(block: Array) -> Float[Array, "n_fractions"]:
        begin, width = first + BLOCK * block, BLOCK + 2 * matching.LAGS
        some = jax.lax.dynamic_slice_in_dim(features, begin, width, axis=2)
        weight = jax.lax.dynamic_slice_in_dim(there, begin, width, axis=2)
        middle = lambda sums: jax.lax.dynamic_slice_in_dim(sums, BEFORE + BLOCK * block, BLOCK, axis=2)  # noqa: E731
        along = profiles.mean_along(Profiles(middle(whole.weight), middle(whole.out), middle(whole.along)))
        return matching.compare(weights, some, weight, along)

    found = jax.vmap(one)(jnp.arange(n - DELAY))
    return jnp.concatenate([jnp.zeros((DELAY, found.shape[-1])), found])
