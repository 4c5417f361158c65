"""Finds what rays meet in a relief by the fastest program for the device, all rays of any number of `vmap`s at once."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float, Int

from subterra_jax import native
from subterra_jax.compiled import in_32_bits
from subterra_jax.host.errors import SubterraError
from subterra_jax.lidar3d import fused
from subterra_jax.lidar3d.meeting import Hits, Point, Tools, normals
from subterra_jax.lidar3d.relay import march_in_relay
from subterra_jax.lidar3d.relief import ARRAYS, Relief
from subterra_jax.rows import axes, rowwise, spread

# Memory of a ray, bytes: origin, direction, block, limit, distance, entry, block again, each once more as a row.
_BYTES = 2 * 4 * 11


def device_memory() -> int | None:
    """Return the memory of the device, bytes; `None` where it does not tell."""
    stats = jax.devices()[0].memory_stats()
    return None if stats is None else stats.get("bytes_limit")


def _require_memory(n: int) -> None:
    """Check that rays fit into the device's memory.

    Raises:
        SubterraError: They do not.
    """
    limit = device_memory()
    if limit is not None and n * _BYTES > limit:
        raise SubterraError(
            f"{n:,} rays need {n * _BYTES / 1e9:.3g} GB and the device has {limit / 1e9:.3g} GB: cast at most "
            f"{limit // _BYTES:,} at once"
        )


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


def _by_platform(in_step: Any, on_gpu: Any, on_cpu: Any, relief: Relief, rows: Any) -> Any:
    """Call what is fastest on the device: the fused kernel, machine code, or XLA's `in_step`."""
    _require_memory(len(rows[2]))
    kernels: dict[str, Any] = {}
    if fused.supported():
        kernels["cuda"] = on_gpu
    if native.supported():
        kernels["cpu"] = on_cpu
    return lax.platform_dependent(relief, *rows, **kernels, default=in_step)


def _merged(find_rays: Any, in_step: Any, axis_size: int, batched: Any, relief: Relief, rows: Any) -> tuple[Any, Any]:
    """Merge a batch axis into the rays; find those of each relief by themselves if the reliefs differ."""
    if any(jax.tree.leaves(batched[0])):
        found = jax.vmap(in_step, in_axes=axes(batched))(relief, *rows)
    else:
        rows = spread(tuple(map(jnp.asarray, rows)), batched[1:], axis_size)
        flat = find_rays(relief, *(row.reshape(-1, *row.shape[2:]) for row in rows))
        found = jax.tree.map(lambda part: part.reshape(axis_size, -1), flat)
    return found, jax.tree.map(lambda part: True, found)


@custom_vmap
@in_32_bits()
def find(
    relief: Relief,
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    blocks: Int[Array, "n"],
    limits: Float[Array, "n"],
) -> Hits:
    """Find the first triangle that each ray meets, by the fastest means at hand."""
    return _by_platform(find_in_step, fused.find, _find_natively, relief, (origins, directions, blocks, limits))


@find.def_vmap
@in_32_bits()
def _find_more(axis_size: int, batched: Any, relief: Relief, *rows: Any) -> tuple[Hits, Hits]:
    """Merge a batch axis into the rays."""
    return _merged(find, find_in_step, axis_size, batched, relief, rows)


@custom_vmap
@in_32_bits()
def find_facing(
    relief: Relief,
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    blocks: Int[Array, "n"],
    limits: Float[Array, "n"],
) -> tuple[Hits, Point]:
    """Find the first triangle that each ray meets, and its normal, by the fastest means at hand."""
    rows = (origins, directions, blocks, limits)
    return _by_platform(facing_in_step, fused.find_facing, _facing_natively, relief, rows)


@find_facing.def_vmap
@in_32_bits()
def _find_more_facing(axis_size: int, batched: Any, relief: Relief, *rows: Any) -> tuple[Any, Any]:
    """Merge a batch axis into the rays."""
    return _merged(find_facing, facing_in_step, axis_size, batched, relief, rows)


def _facing_from_one(relief: Relief, origin: Array, directions: Array, block: Array, limit: Array) -> Any:
    """Find what the rays of an image meet, each as if it had a place of its own."""
    image = directions.shape[:-1]
    n = image[0] * image[1]
    rows = jnp.broadcast_to(origin, (n, 3)), directions.reshape(n, 3), *(jnp.broadcast_to(x, n) for x in (block, limit))
    return jax.tree.map(lambda part: part.reshape(image), find_facing(relief, *rows))


def _facing_from_many(relief: Relief, origins: Array, directions: Array, blocks: Array, limits: Array) -> Any:
    """Find what the rays of many scans meet."""
    apart = jax.vmap(_facing_from_one, (None, 0, 0, 0, 0))
    if not fused.supported() or directions.shape[1] * directions.shape[2] % fused.ROWS:
        return apart(relief, origins, directions, blocks, limits)
    _require_memory(directions.size // 3)
    rows = origins, directions, blocks, limits
    return lax.platform_dependent(relief, *rows, cuda=fused.find_facing_from, default=apart)


find_facing_from = rowwise(_facing_from_one, in_32_bits()(_facing_from_many))


def find_in_step(relief: Relief, origins: Array, directions: Array, blocks: Array, limits: Array) -> Hits:
    """Find the first triangles by XLA."""
    return march_in_relay(tools_of(relief), relief.n_x, origins, directions, blocks, limits)


def _find_natively(relief: Relief, *rows: Array) -> Hits:
    """Find the first triangles by machine code."""
    from subterra_jax.native import marchcall  # numba is optional

    return marchcall.find(relief, *rows)


def facing_in_step(relief: Relief, *rows: Array) -> tuple[Hits, Point]:
    """Find the first triangles and their normals by XLA."""
    return _with_normals(relief, find_in_step(relief, *rows), rows)


def _facing_natively(relief: Relief, *rows: Array) -> tuple[Hits, Point]:
    """Find the first triangles by machine code, and their normals by XLA."""
    return _with_normals(relief, _find_natively(relief, *rows), rows)


def _with_normals(relief: Relief, hits: Hits, rows: Any) -> tuple[Hits, Point]:
    origins, directions = rows[:2]
    return hits, normals(tools_of(relief), tuple(origins.T), tuple(directions.T), hits)
