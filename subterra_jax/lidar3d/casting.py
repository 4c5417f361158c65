"""Cast rays against every triangle of a relief: exact ranges for tilted and many-beam LiDARs, and their derivatives.

The same march, cell by cell, is a fused kernel on NVIDIA GPUs, machine code on CPUs with numba, and XLA elsewhere.
Under any number of `vmap`s all rays are one call. The cost depends on neither the tunnel's length nor the number of
triangles, and no ray's result on another's.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int

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


@in_32_bits()
def scan(
    relief: Relief,
    position: Float[Array, "3"],
    orientation: Float[Array, "4"],
    station: Float[Array, ""],
    directions: Float[Array, "n_beams 3"],
    range_max: Float[Array, ""] | float,
) -> Float[Array, "n_beams"]:
    """Return the true ranges of one scan from one pose. For noise, see `lidar.add_noise`.

    Args:
        relief: Surface of the bore.
        position: Position of the sensor, tunnel frame, m.
        orientation: Rotation from the sensor's frame to the tunnel frame, unit quaternion w, x, y, z.
        station: Station of the sensor, m, to within 2 m.
        directions: Beams in the sensor's frame, unit vectors; see `beams`.
        range_max: Largest range, m.

    Returns:
        Ranges, m, in [0, range_max]; exactly `range_max` for a beam that meets nothing, as one through a mouth.

    Raises:
        ValueError: There is no beam, or one is no number or no unit vector.
    """
    _require_pattern(directions)
    beams = rotate(jnp.asarray(orientation, jnp.float32), jnp.asarray(directions, jnp.float32))
    return cast(relief, position, beams, station, range_max)


@in_32_bits()
def cast(
    relief: Relief,
    origin: Float[Array, "3"],
    directions: Float[Array, "n 3"],
    station: Float[Array, ""],
    range_max: Float[Array, ""] | float,
) -> Float[Array, "n"]:
    """Return the distance along each ray to the nearest triangle.

    Derivatives with respect to origin and directions are exact but at edges: those of the plane of the triangle that
    the ray meets, 0 for a ray that meets nothing.

    Args:
        relief: Surface of the bore, or of one picked from a stack.
        origin: Origin of all rays, tunnel frame, m.
        directions: Unit vectors, tunnel frame.
        station: Station of the origin, m, to within 2 m.
        range_max: Largest range, m.

    Returns:
        Ranges, m, in [0, range_max]; exactly `range_max` for a ray that meets nothing; NaN where an argument is.

    Raises:
        ValueError: There is no ray, or a direction known beforehand is no number or no unit vector.
    """
    _require_pattern(directions)
    n = directions.shape[0]
    origin, station = jnp.asarray(origin, jnp.float32), jnp.asarray(station, jnp.float32)
    origins = jnp.broadcast_to(origin, (n, 3))
    blocks = jnp.broadcast_to(block_at(relief, origin, station), (n,))
    limits = jnp.broadcast_to(jnp.asarray(range_max, jnp.float32), (n,))
    return _ranges(relief.shared, origins, jnp.asarray(directions, jnp.float32), blocks, limits)


class Met(NamedTuple):
    """Surfaces that rays meet, `n` of them or an image.

    Attributes:
        ranges: Distance along each ray, m; exactly the largest range where nothing is met.
        normal: Unit normal of the surface, tunnel frame, to either side; arbitrary where nothing is met.
        thing: A box is met, as track or furniture, and not the lining.
    """

    ranges: Float[Array, "*n"]
    normal: Float[Array, "*n 3"]
    thing: Bool[Array, "*n"]


@in_32_bits()
def meet(
    relief: Relief,
    origins: Float[Array, "n 3"] | Float[Array, "3"],
    directions: Float[Array, "n 3"] | Float[Array, "rows columns 3"],
    station: Float[Array, ""],
    limits: Float[Array, "n"] | Float[Array, ""],
) -> Met:
    """Return the surfaces that rays meet. Ranges have derivatives as those of `cast`.

    Args:
        relief: Surface of the bore, or of one picked from a stack.
        origins: Origins, one for each ray or one for all, tunnel frame, m, within 2 m of the station.
        directions: Unit vectors, tunnel frame; not checked. Those of one origin row by row of an image, a ring a row.
        station: Station of the origins, m.
        limits: Largest ranges, m; one for all rays if they have one origin.
    """
    if directions.ndim == 3:
        block = block_at(relief, origins, jnp.asarray(station, jnp.float32))
        return Met(*_meet_from(relief.shared, origins, directions, block, limits))
    blocks = jax.vmap(block_at, (None, 0, None))(relief, origins, jnp.asarray(station, jnp.float32))
    limits = jnp.broadcast_to(limits, len(directions))
    return Met(*_meet(relief.shared, origins, directions, blocks, limits))


@jax.custom_jvp
@in_32_bits()
def _meet(
    relief: Relief, origins: Array, directions: Array, blocks: Array, limits: Array
) -> tuple[Array, Array, Array]:
    hits, normal = _find_facing(relief, origins, directions, blocks, limits)
    return _clip(hits, origins, directions, limits), jnp.stack(normal, axis=-1), hits.entry < -1


@_meet.defjvp
@in_32_bits()
def _meet_and_changes(primals: Any, tangents: Any) -> tuple[Any, Any]:
    """Return what rays meet and how the ranges change; the same surface is met."""
    ranges, change = _ranges_and_changes(primals, tangents)
    _, normal, thing = _meet(*primals)
    return (ranges, normal, thing), (change, jnp.zeros_like(normal), np.zeros(thing.shape, jax.dtypes.float0))


@jax.custom_jvp
@in_32_bits()
def _meet_from(
    relief: Relief, origin: Array, directions: Array, block: Array, limit: Array
) -> tuple[Array, Array, Array]:
    """`_meet` of rays from one place."""
    hits, normal = _find_facing_from(relief, origin, directions, block, limit)
    return _clip(hits, origin, directions, limit), jnp.stack(normal, axis=-1), hits.entry < -1


@_meet_from.defjvp
@in_32_bits()
def _meet_from_and_changes(primals: Any, tangents: Any) -> tuple[Any, Any]:
    """Return what rays meet and how the ranges change, as if each had a place of its own."""
    relief, origin, directions, block, limit = primals
    image = directions.shape[:-1]
    n = image[0] * image[1]
    each = lambda part: jnp.broadcast_to(part, (n, *part.shape))  # noqa: E731
    rows = relief, each(origin), directions.reshape(n, 3), each(block), each(limit)
    turned, still = tangents[2].reshape(n, 3), np.zeros(n, jax.dtypes.float0)
    found = _meet_and_changes(rows, (tangents[0], each(tangents[1]), turned, still, each(tangents[4])))
    return jax.tree.map(lambda part: part.reshape(*image, *part.shape[1:]), found)


def _require_pattern(directions: Float[Array, "n 3"]) -> None:
    """Check beams, as far as they are known before the program runs.

    Raises:
        ValueError: There is no beam, or one is no number or no unit vector.
    """
    if jnp.ndim(directions) != 2 or directions.shape[1] != 3 or not len(directions):
        raise ValueError(f"a pattern needs one or more beams as unit vectors (n, 3), got shape {jnp.shape(directions)}")
    if isinstance(directions, jax.core.Tracer):
        return
    size = np.linalg.norm(np.asarray(directions, np.float64), axis=1)
    if not np.all(np.isfinite(size)):
        raise ValueError(f"beam {int(np.argmin(np.isfinite(size)))} of the pattern is no number")
    if np.any(off := np.abs(size - 1.0) > 1e-3):
        raise ValueError(
            f"beam {int(np.argmax(off))} of the pattern is no unit vector: its length is {size[off][0]:.4g}"
        )


@in_32_bits()
def require_free(relief: Relief, position: Any, station: float) -> None:
    """Check that a sensor stands free in a bore: that it is seen from the axis within 2 m of its station.

    Args:
        relief: Surface of one bore.
        position: Position of the sensor, tunnel frame, m, `(3,)`.
        station: Station of the sensor, m.

    Raises:
        SubterraError: It is inside the wall or a thing.
    """
    place = np.asarray(position, np.float64)
    first, n = int(relief.first_block), int(relief.n_blocks)
    row = np.asarray(relief.frame[first : first + n], np.float64)
    nearest = np.argsort(np.linalg.norm(row[:, :3] - place, axis=1), kind="stable")[0]
    at = row[nearest, :3] + row[nearest, 3:6] * np.linspace(-2.0, 2.0, 9)[:, None]
    way = place - at
    size = np.linalg.norm(way, axis=1)
    origins, directions = jnp.asarray(at, jnp.float32), jnp.asarray(way / np.maximum(size, 1e-9)[:, None], jnp.float32)
    free = _free_lengths(relief, origins, directions, jnp.float32(station), jnp.asarray(size, jnp.float32))
    if not np.any(np.asarray(free) >= size - 1e-4):
        x, y, z = place
        raise SubterraError(
            f"the sensor at ({x:.2f}, {y:.2f}, {z:.2f}) m, station {station:.1f} m, is inside the wall, or in a thing: "
            "it is not seen from the axis"
        )


@jax.jit
def _free_lengths(relief: Relief, origins: Array, directions: Array, station: Array, size: Array) -> Array:
    """Return how far rays from near a station go, m, at most `size`."""
    blocks = jax.vmap(block_at, (None, 0, None))(relief, origins, station)
    return _ranges(relief.shared, origins, directions, blocks, size)


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


@in_32_bits()
def block_at(relief: Relief, origin: Float[Array, "3"], station: Float[Array, ""]) -> Int[Array, ""]:
    """Return the block around a point, searched from the one at a station; beyond a mouth, the last block."""
    origin, station = lax.stop_gradient(origin), lax.stop_gradient(station)
    last = relief.n_blocks - 1
    at = jnp.clip(jnp.floor(station / relief.length * relief.n_blocks), 0, last).astype(jnp.int32)
    row = relief.frame[relief.first_block + at]
    local = rotate_into_frame(row, origin - row[:3])
    ahead, behind = dot(row[16:19], local) > row[19], dot(row[12:15], local) < row[15]
    return relief.first_block + jnp.clip(at + ahead.astype(jnp.int32) - behind.astype(jnp.int32), 0, last)


def rotate_into_frame(row: Float[Array, "n_frame"], vector: Float[Array, "3"]) -> Float[Array, "3"]:
    """Turn a vector into a block's frame."""
    return jnp.stack([dot(row[3:6], vector), dot(row[6:9], vector), dot(row[9:12], vector)])


def dot(a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, ""]:
    """Return the scalar product, written out: a library may round to TF32."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def rotate(orientation: Float[Array, "4"], vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Rotate vectors by a unit quaternion w, x, y, z."""
    w, x, y, z = orientation[0], orientation[1], orientation[2], orientation[3]
    a, b, c = vectors[:, 0], vectors[:, 1], vectors[:, 2]
    # v + 2 q × (q × v + w v)
    p, q, r = y * c - z * b + w * a, z * a - x * c + w * b, x * b - y * a + w * c
    turned = [a + 2.0 * (y * r - z * q), b + 2.0 * (z * p - x * r), c + 2.0 * (x * q - y * p)]
    return jnp.stack(turned, axis=-1)


@jax.custom_jvp
@in_32_bits()
def _ranges(
    relief: Relief,
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    blocks: Int[Array, "n"],
    limits: Float[Array, "n"],
) -> Float[Array, "n"]:
    """Return the ranges of rays, each from the block around its origin."""
    return _clip(_find(relief, origins, directions, blocks, limits), origins, directions, limits)


def _clip(hits: Hits, origins: Array, directions: Array, limits: Array) -> Float[Array, "*n"]:
    finite = jnp.isfinite(jnp.sum(origins, axis=-1) + jnp.sum(directions, axis=-1))
    return jnp.where(finite, jnp.clip(hits.distance, 0.0, limits), jnp.nan)


@_ranges.defjvp
@in_32_bits()
def _ranges_and_changes(primals: Any, tangents: Any) -> tuple[Array, Array]:
    """Return ranges and their changes: a ray's end stays in the plane of the triangle that it meets."""
    relief, origins, directions, blocks, limits = primals
    _, moved, turned, _, widened = tangents
    hits, rows = _find_facing(relief, origins, directions, blocks, limits)
    ranges, normal = _clip(hits, origins, directions, limits), jnp.stack(rows, axis=-1)
    facing = jnp.sum(normal * directions, axis=-1)
    meets = (hits.entry != -1) & (hits.distance < limits) & (jnp.abs(facing) > 0.0)
    shift = jnp.sum(normal * (moved + ranges[:, None] * turned), axis=-1)
    return ranges, jnp.where(
        meets, -shift / jnp.where(meets, facing, 1.0), jnp.where(hits.distance >= limits, widened, 0.0)
    )


def _tools(relief: Relief) -> Tools:
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


def _by_platform(find: Any, on_gpu: Any, on_cpu: Any, relief: Relief, rows: Any) -> Any:
    """Call what is fastest on the device: the fused kernel, machine code, or XLA's `find`."""
    _require_memory(len(rows[2]))
    kernels: dict[str, Any] = {}
    if fused.supported():
        kernels["cuda"] = on_gpu
    if native.supported():
        kernels["cpu"] = on_cpu
    return lax.platform_dependent(relief, *rows, **kernels, default=find)


def _merged(find: Any, find_in_step: Any, axis_size: int, batched: Any, relief: Relief, rows: Any) -> tuple[Any, Any]:
    """Merge a batch axis into the rays; find those of each relief by themselves if the reliefs differ."""
    if any(jax.tree.leaves(batched[0])):
        found = jax.vmap(find_in_step, in_axes=axes(batched))(relief, *rows)
    else:
        rows = spread(tuple(map(jnp.asarray, rows)), batched[1:], axis_size)
        flat = find(relief, *(row.reshape(-1, *row.shape[2:]) for row in rows))
        found = jax.tree.map(lambda part: part.reshape(axis_size, -1), flat)
    return found, jax.tree.map(lambda part: True, found)


@custom_vmap
@in_32_bits()
def _find(
    relief: Relief,
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    blocks: Int[Array, "n"],
    limits: Float[Array, "n"],
) -> Hits:
    """Find the first triangle that each ray meets, by the fastest means at hand."""
    return _by_platform(_find_in_step, fused.find, _find_natively, relief, (origins, directions, blocks, limits))


@_find.def_vmap
@in_32_bits()
def _find_more(axis_size: int, batched: Any, relief: Relief, *rows: Any) -> tuple[Hits, Hits]:
    """Merge a batch axis into the rays."""
    return _merged(_find, _find_in_step, axis_size, batched, relief, rows)


@custom_vmap
@in_32_bits()
def _find_facing(
    relief: Relief,
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    blocks: Int[Array, "n"],
    limits: Float[Array, "n"],
) -> tuple[Hits, Point]:
    """Find the first triangle that each ray meets, and its normal, by the fastest means at hand."""
    rows = (origins, directions, blocks, limits)
    return _by_platform(_facing_in_step, fused.find_facing, _facing_natively, relief, rows)


@_find_facing.def_vmap
@in_32_bits()
def _find_more_facing(axis_size: int, batched: Any, relief: Relief, *rows: Any) -> tuple[Any, Any]:
    """Merge a batch axis into the rays."""
    return _merged(_find_facing, _facing_in_step, axis_size, batched, relief, rows)


def _facing_from_one(relief: Relief, origin: Array, directions: Array, block: Array, limit: Array) -> Any:
    """Find what the rays of an image meet, each as if it had a place of its own."""
    image = directions.shape[:-1]
    n = image[0] * image[1]
    rows = jnp.broadcast_to(origin, (n, 3)), directions.reshape(n, 3), *(jnp.broadcast_to(x, n) for x in (block, limit))
    return jax.tree.map(lambda part: part.reshape(image), _find_facing(relief, *rows))


def _facing_from_many(relief: Relief, origins: Array, directions: Array, blocks: Array, limits: Array) -> Any:
    """Find what the rays of many scans meet."""
    apart = jax.vmap(_facing_from_one, (None, 0, 0, 0, 0))
    if not fused.supported() or directions.shape[1] * directions.shape[2] % fused.ROWS:
        return apart(relief, origins, directions, blocks, limits)
    _require_memory(directions.size // 3)
    rows = origins, directions, blocks, limits
    return lax.platform_dependent(relief, *rows, cuda=fused.find_facing_from, default=apart)


_find_facing_from = rowwise(_facing_from_one, in_32_bits()(_facing_from_many))


def _find_in_step(relief: Relief, origins: Array, directions: Array, blocks: Array, limits: Array) -> Hits:
    """Find the first triangles by XLA."""
    return march_in_relay(_tools(relief), relief.n_x, origins, directions, blocks, limits)


def _find_natively(relief: Relief, *rows: Array) -> Hits:
    """Find the first triangles by machine code."""
    from subterra_jax.native import marchcall  # numba is optional

    return marchcall.find(relief, *rows)


def _facing_in_step(relief: Relief, *rows: Array) -> tuple[Hits, Point]:
    """Find the first triangles and their normals by XLA."""
    return _with_normals(relief, _find_in_step(relief, *rows), rows)


def _facing_natively(relief: Relief, *rows: Array) -> tuple[Hits, Point]:
    """Find the first triangles by machine code, and their normals by XLA."""
    return _with_normals(relief, _find_natively(relief, *rows), rows)


def _with_normals(relief: Relief, hits: Hits, rows: Any) -> tuple[Hits, Point]:
    origins, directions = rows[:2]
    return hits, normals(_tools(relief), tuple(origins.T), tuple(directions.T), hits)
