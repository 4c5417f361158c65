"""Metres of a whole drive at once, for training; `locator` makes the same ones as the robot goes."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.policies.locate import matching, profiles
from subterra_jax.policies.locate.blocks import DELAY, N_RECENT, Block
from subterra_jax.policies.locate.profiles import BIN, BLOCK, Points, Profiles

BEFORE = 120  # bins of the profiles before the start
_AFTER = 120  # bins behind the last metre


@struct.dataclass
class Record:
    """A drive as its robot saw it.

    Attributes:
        driven: Commanded distance along the axis at each observation, m; never falls.
        read: Odometer, m.
        points: Points on the walls.
    """

    driven: Float[Array, "time"]
    read: Float[Array, "time"]
    points: Points


def metres(record: Record, weights: matching.Weights | None, n: int) -> Block:
    """Returns the first `n` metres of a drive.

    Args:
        record: The drive.
        weights: Of the front end; None leaves its evidence at 0.
        n: Number of metres.
    """
    ends = jnp.arange(n + 1, dtype=jnp.float32)
    reads = jnp.interp(ends, record.driven, record.read)
    times = jnp.interp(ends, record.driven, jnp.arange(len(record.driven), dtype=jnp.float32))
    evidence = jnp.zeros((n, len(matching.SHARES))) if weights is None else _evidence(record, weights, n)
    return Block(evidence, jnp.diff(reads) - 1.0, jnp.diff(times), _raw(record, n))


def reached(record: Record, n: int) -> Bool[Array, "n"]:
    """Returns the metres that the drive has completed."""
    return jnp.arange(1, n + 1) <= record.driven[-1]


def profiles_of(record: Record, n: int) -> Profiles:
    """Returns the profiles of `n` metres of a drive, with `BEFORE` bins before its start."""
    where = (record.driven[:, None, None] + record.points.along) / BIN + BEFORE
    return profiles.add_points(profiles.blank(BLOCK * n + BEFORE + _AFTER, record.points.n_sides), record.points, where)


def _evidence(record: Record, weights: matching.Weights, n: int) -> Float[Array, "n n_shares"]:
    """Returns the evidence of the block `DELAY` metres before each metre."""
    whole = profiles_of(record, n)
    features, there = matching.encode(weights, whole)
    first = BEFORE - matching.MARGIN - matching.LAGS  # of the first block's cut, in features

    def one(block: Array) -> Float[Array, "n_shares"]:
        begin, width = first + BLOCK * block, BLOCK + 2 * matching.LAGS
        some = jax.lax.dynamic_slice_in_dim(features, begin, width, axis=2)
        weight = jax.lax.dynamic_slice_in_dim(there, begin, width, axis=2)
        middle = lambda sums: jax.lax.dynamic_slice_in_dim(sums, BEFORE + BLOCK * block, BLOCK, axis=2)  # noqa: E731
        along = profiles.mean_along(Profiles(middle(whole.weight), middle(whole.out), middle(whole.along)))
        return matching.compare(weights, some, weight, along)

    found = jax.vmap(one)(jnp.arange(n - DELAY))
    return jnp.concatenate([jnp.zeros((DELAY, found.shape[-1])), found])


def _raw(record: Record, n: int) -> Float[Array, "n n_raw"]:
    """Returns the mean of the scans in each part of each metre."""
    part = jnp.floor(record.driven * N_RECENT).astype(jnp.int32)
    rows = raw_rows(record.points)
    sums = jnp.zeros((n * N_RECENT, rows.shape[-1])).at[part].add(rows, mode="drop")
    counts = jnp.zeros(n * N_RECENT).at[part].add(1.0, mode="drop")
    return (sums / jnp.maximum(counts, 1.0)[:, None]).reshape(n, -1)


def raw_rows(points: Points) -> Float[Array, "*t row"]:
    """Returns a scan as numbers of order 1; of several heights the first, and of several rays the first."""
    first = slice(0, 2 * points.rays, points.rays)
    seen, batch = points.seen[..., first, :], points.seen.shape[:-2]
    out = jnp.where(seen, jnp.arcsinh(points.out[..., first, :] / 0.03), 0.0)
    along = jnp.where(seen, points.along[..., first, :] / 10.0, 0.0)
    return jnp.concatenate([out.reshape(*batch, -1), along.reshape(*batch, -1)], axis=-1)
