"""LiDAR in three dimensions: exact ranges to every triangle of a relief, for tilted and many-beam sensors.

Most rays are through after a few rounds of `march`; the others are gathered and go on by themselves. The cost depends
on neither the tunnel's length nor the number of its triangles.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float, Int

from subterra_jax.lidar3d import march
from subterra_jax.lidar3d.relief import Relief
from subterra_jax.rows import axes, spread

# Sweeps after which a ray that has met nothing is given up; the slowest of 32,000 in `subterra-351` took 13.
N_SWEEPS = 400
# One in how many of the rays a sweep takes on, first and while no more are left than the second; none fewer than FEW.
SHARES, FEW = (8, 64), 64
# Rays that go through the sweeps together: an H200 casts 78 M rays/s in one batch of 2¹⁸ and 3 M rays/s in one of 2²¹.
CHUNK = 1 << 18


def scan(
    relief: Relief,
    position: Float[Array, "3"],
    orientation: Float[Array, "4"],
    station: Float[Array, ""],
    directions: Float[Array, "n_beams 3"],
    range_max: Float[Array, ""] | float,
) -> Float[Array, "n_beams"]:
    """True ranges of one scan from one pose. For noise, see `lidar.add_noise`.

    Args:
        relief: What is looked at.
        position: Of the sensor, tunnel frame, m.
        orientation: From the sensor's frame to the tunnel frame, as a unit quaternion w, x, y, z.
        station: Station of the sensor, m, give or take 2 m.
        directions: Beams in the sensor's frame, unit vectors; see `beams`.
        range_max: Largest range, m.

    Returns:
        Ranges, m, in [0, range_max]; exactly `range_max` where a beam meets nothing within it, as when it leaves
        through a mouth.
    """
    return cast(relief, position, rotate(orientation, directions), station, range_max)


def cast(
    relief: Relief,
    origin: Float[Array, "3"],
    directions: Float[Array, "n 3"],
    station: Float[Array, ""],
    range_max: Float[Array, ""] | float,
) -> Float[Array, "n"]:
    """Distance along each ray to the nearest triangle.

    However many `vmap`s there are around it, all rays in one relief are cast as one batch; a ray's result depends on
    no other ray.

    Args:
        relief: What is looked at.
        origin: Of all rays, tunnel frame, m.
        directions: Unit vectors, tunnel frame.
        station: Station of the origin, m, give or take 2 m.
        range_max: Largest range, m.

    Returns:
        Ranges, m, in [0, range_max]; exactly `range_max` where a ray meets nothing within it; NaN where an argument is.
    """
    n = directions.shape[0]
    origins = jnp.broadcast_to(origin, (n, 3))
    blocks = jnp.broadcast_to(block_at(relief, origin, station), (n,))
    limits = jnp.broadcast_to(jnp.asarray(range_max, jnp.float32), (n,))
    return _cast_rays(relief, origins, directions, blocks, limits)


def block_at(relief: Relief, origin: Float[Array, "3"], station: Float[Array, ""]) -> Int[Array, ""]:
    """The block that holds a point whose station is known to a block's length; beyond a mouth, the last one."""
    last = relief.n_blocks - 1
    guess = jnp.floor(station / relief.length * relief.n_blocks)
    block = jnp.clip(guess, 0, last).astype(jnp.int32)
    row = relief.frame[block]
    local = march.turned(row, origin - row[:3])
    ahead, behind = march.dot(row[16:19], local) > row[19], march.dot(row[12:15], local) < row[15]
    return jnp.clip(block + ahead.astype(jnp.int32) - behind.astype(jnp.int32), 0, last)


def rotate(orientation: Float[Array, "4"], vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Vectors turned by a unit quaternion w, x, y, z."""
    w, x, y, z = orientation[0], orientation[1], orientation[2], orientation[3]
    a, b, c = vectors[:, 0], vectors[:, 1], vectors[:, 2]
    # v + 2 q × (q × v + w v)
    p, q, r = y * c - z * b + w * a, z * a - x * c + w * b, x * b - y * a + w * c
    turned = [a + 2.0 * (y * r - z * q), b + 2.0 * (z * p - x * r), c + 2.0 * (x * q - y * p)]
    return jnp.stack(turned, axis=-1)


@custom_vmap
def _cast_rays(
    relief: Relief,
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    blocks: Int[Array, "n"],
    limits: Float[Array, "n"],
) -> Float[Array, "n"]:
    """Any rays in one relief, each from the block that holds its origin."""
    rays = (origins, directions, blocks, limits)
    n = len(limits)
    if n <= CHUNK:
        return _cast_chunk(relief, *rays)
    # The last chunk is filled up with the first rays.
    n_chunks = -(-n // CHUNK)
    which = jnp.arange(n_chunks * CHUNK).reshape(n_chunks, CHUNK) % n
    chunks = lax.map(lambda chosen: _cast_chunk(relief, *(part[chosen] for part in rays)), which)
    return chunks.reshape(-1)[:n]


def _cast_chunk(
    relief: Relief,
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    blocks: Int[Array, "n"],
    limits: Float[Array, "n"],
) -> Float[Array, "n"]:
    """A sweep of all rays, then sweeps of ever fewer that are not done."""
    n = len(limits)
    rays = march.Ray(jnp.zeros(n), blocks, jnp.zeros(n, jnp.int32), jnp.full(n, jnp.inf))
    rays = march.sweep(relief, rays, origins, directions, limits)
    sizes = [min(n, max(FEW, -(-n // share))) for share in SHARES]
    for size, enough in zip(sizes, [*sizes[1:], 0], strict=True):
        rays = _sweep_until(enough, size, relief, rays, origins, directions, limits)
    return jnp.minimum(jnp.where(jnp.isfinite(rays.hit), rays.hit, rays.reached), limits)


def _sweep_until(
    enough: int, size: int, relief: Relief, rays: march.Ray, origins: Array, directions: Array, limits: Array
) -> march.Ray:
    """Sweeps of `size` unfinished rays each, until no more than `enough` are left."""

    def unfinished(carry: tuple[Array, march.Ray]) -> Array:
        return (jnp.sum(march.goes_on(carry[1], limits)) > enough) & (carry[0] < N_SWEEPS)

    def sweep_some(carry: tuple[Array, march.Ray]) -> tuple[Array, march.Ray]:
        count, rays = carry
        (which,) = jnp.nonzero(march.goes_on(rays, limits), size=size, fill_value=len(limits))
        some = jnp.minimum(which, len(limits) - 1)
        part = jax.tree.map(lambda leaf: leaf[some], rays)
        part = march.sweep(relief, part, origins[some], directions[some], limits[some])
        return count + 1, jax.tree.map(lambda leaf, new: leaf.at[which].set(new, mode="drop"), rays, part)

    return lax.while_loop(unfinished, sweep_some, (jnp.int32(0), rays))[1]


@_cast_rays.def_vmap
def _cast_more_rays(axis_size: int, batched: Any, relief: Relief, *rows: Array) -> tuple[Array, bool]:
    """A further batch axis becomes part of the rays; where reliefs differ, each is cast by itself."""
    if any(jax.tree.leaves(batched[0])):
        return jax.vmap(_cast_rays.fun, in_axes=axes(batched))(relief, *rows), True
    flat = [row.reshape(-1, *row.shape[2:]) for row in spread(rows, batched[1:], axis_size)]
    return _cast_rays(relief, *flat).reshape(axis_size, -1), True
