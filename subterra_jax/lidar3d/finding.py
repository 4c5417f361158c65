"""Finds what rays meet in a relief, all rays of any number of `vmap`s at once."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from subterra_jax.compiled import in_32_bits
from subterra_jax.lidar import kernels
from subterra_jax.lidar.kernels import compiled_by_numba, fastest
from subterra_jax.lidar3d import fused
from subterra_jax.lidar3d.march import march
from subterra_jax.lidar3d.meeting import Hits, Point, Tools, normals
from subterra_jax.lidar3d.relief import ARRAYS, Relief
from subterra_jax.rows import rowwise

# Rays that XLA marches in step: each takes as long as the one with most to do.
IN_STEP = 256


def tools_of(relief: Relief) -> Tools:
    """Return the operations of XLA."""
    arrays = {name: getattr(relief, name).reshape(-1) for name in ARRAYS}

    def one(name: str, index: Array, mask: Array | None) -> Array:
        index = index if mask is None else jnp.where(mask, index, 0)
        # Once, and not again in every program that uses the value.
        value = lax.optimization_barrier(arrays[name].at[index].get(mode="promise_in_bounds"))
        return value if mask is None else jnp.where(mask, value, 0)

    def load(name: str, index: Array, mask: Array | None = None) -> Any:
        if name in fused.PAIRS:
            return one(name, 2 * index, mask), one(name, 2 * index + 1, mask)
        return one(name, index, mask)

    return Tools(load, lambda a, b, c: a * b + c, lambda a: 1.0 / a)


def by_xla(
    relief: Relief,
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    blocks: Int[Array, "n"],
    limits: Float[Array, "n"],
) -> tuple[Hits, Point]:
    """Find the first triangle that each ray meets, and its normal, by XLA."""
    tools, n = tools_of(relief), len(blocks)
    size = min(n, IN_STEP)

    def some(rows: Any) -> tuple[Hits, Point]:
        origin, direction, block, limit = rows
        origin, direction = tuple(origin.T), tuple(direction.T)
        hits = march(tools, origin, direction, block, limit)
        return hits, normals(tools, origin, direction, hits)

    def cut(row: Array) -> Array:
        row = jnp.pad(row, [(0, -n % size), *[(0, 0)] * (row.ndim - 1)], mode="edge")
        return row.reshape(-1, size, *row.shape[1:])

    found = lax.map(some, jax.tree.map(cut, (origins, directions, blocks, limits)))
    return jax.tree.map(lambda part: part.reshape(-1)[:n], found)


def by_numba(relief: Relief, *rows: Any) -> tuple[Hits, Point]:
    """Find the first triangles by machine code, and their normals by XLA; arguments as for `by_xla`."""
    arrays = tuple(getattr(relief, name) for name in ARRAYS)
    hits = Hits(*compiled_by_numba("march")(arrays, *rows))
    return hits, normals(tools_of(relief), tuple(rows[0].T), tuple(rows[1].T), hits)


@in_32_bits()
def _one(relief: Relief, *row: Array) -> tuple[Hits, Point]:
    """`by_xla` of one ray."""
    return jax.tree.map(lambda part: part[0], by_xla(relief, *(part[None] for part in row)))


@in_32_bits()
def _many(relief: Relief, *rows: Array) -> tuple[Hits, Point]:
    """`by_xla` by the fastest means at hand."""
    return fastest(by_xla, fused.find, by_numba)(relief, *rows)


# Of a relief, an origin (m), a unit vector, the block around the origin, and the largest distance of interest (m).
find = rowwise(_one, _many)


def _image(relief: Relief, origin: Array, directions: Array, block: Array, limit: Array) -> tuple[Hits, Point]:
    """Find what the rays of an image meet, each as if it had a place of its own."""
    along_row = jax.vmap(find, (None, None, 0, None, None))
    return jax.vmap(along_row, (None, None, 0, None, None))(relief, origin, directions, block, limit)


@in_32_bits()
def _images(relief: Relief, origins: Array, directions: Array, blocks: Array, limits: Array) -> tuple[Hits, Point]:
    """Find what the rays of many scans meet."""
    apart = jax.vmap(_image, (None, 0, 0, 0, 0))
    if not kernels.on_nvidia() or directions.shape[1] * directions.shape[2] % fused.ROWS:
        return apart(relief, origins, directions, blocks, limits)
    rows = origins, directions, blocks, limits
    return fastest(apart, fused.find, apart)(relief, *rows)


# The same of an origin and the unit vectors of an image from there.
find_from = rowwise(_image, _images)
