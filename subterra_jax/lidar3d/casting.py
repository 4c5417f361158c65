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
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.compiled import in_32_bits
from subterra_jax.host.errors import SubterraError
from subterra_jax.lidar3d.finding import find, find_facing, find_facing_from
from subterra_jax.lidar3d.meeting import Hits, Point
from subterra_jax.lidar3d.relief import Relief, block_contents


@in_32_bits()
def scan(
    relief: Relief,
    position: Float[Array, "3"],
    orientation: Float[Array, "4"],
    station: Float[Array, ""],
    directions: Float[Array, "*n_beams 3"],
    range_max: Float[Array, ""] | float,
) -> Float[Array, "*n_beams"]:
    """Return the true ranges of one scan from one pose. For noise, see `lidar.add_noise`.

    Args:
        relief: Surface of the bore.
        position: Position of the sensor, tunnel frame, m.
        orientation: Rotation from the sensor's frame to the tunnel frame, unit quaternion w, x, y, z.
        station: Station of the sensor, m, to within 2 m.
        directions: Beams in the sensor's frame, unit vectors, `(n, 3)`, or an image `(rows, columns, 3)`, a ring a row;
            see `beams`. NVIDIA GPUs take an image column by column, which was twice as fast in upright tunnels.
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
    directions: Float[Array, "*n 3"],
    station: Float[Array, ""],
    range_max: Float[Array, ""] | float,
) -> Float[Array, "*n"]:
    """Return the distance along each ray to the nearest triangle.

    Derivatives with respect to origin and directions are exact but at edges: those of the plane of the triangle that
    the ray meets, 0 for a ray that meets nothing.

    Args:
        relief: Surface of the bore, or of one picked from a stack.
        origin: Origin of all rays, tunnel frame, m.
        directions: Unit vectors, tunnel frame, `(n, 3)` or as an image, as for `scan`.
        station: Station of the origin, m, to within 2 m.
        range_max: Largest range, m.

    Returns:
        Ranges, m, in [0, range_max]; exactly `range_max` for a ray that meets nothing; NaN where an argument is.

    Raises:
        ValueError: There is no ray, or a direction known beforehand is no number or no unit vector.
    """
    _require_pattern(directions)
    origin, station = jnp.asarray(origin, jnp.float32), jnp.asarray(station, jnp.float32)
    directions, limit = jnp.asarray(directions, jnp.float32), jnp.asarray(range_max, jnp.float32)
    block, n = block_at(relief, origin, station), len(directions)
    if directions.ndim == 3:
        return _meet_from(relief.shared, origin, directions, block, limit)[0]
    origins, blocks, limits = (jnp.broadcast_to(part, (n, *part.shape)) for part in (origin, block, limit))
    return _ranges(relief.shared, origins, directions, blocks, limits)


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


def _surfaces(
    found: tuple[Hits, Point], origins: Array, directions: Array, limits: Array
) -> tuple[Array, Array, Array]:
    """Return ranges, normals and whether a thing is met, of what was found."""
    hits, normal = found
    return _clip(hits, origins, directions, limits), jnp.stack(normal, axis=-1), hits.entry < -1


@jax.custom_jvp
@in_32_bits()
def _meet(
    relief: Relief, origins: Array, directions: Array, blocks: Array, limits: Array
) -> tuple[Array, Array, Array]:
    return _surfaces(find_facing(relief, origins, directions, blocks, limits), origins, directions, limits)


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
    return _surfaces(find_facing_from(relief, origin, directions, block, limit), origin, directions, limit)


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


def _require_pattern(directions: Float[Array, "*n 3"]) -> None:
    """Check beams, as far as they are known before the program runs.

    Raises:
        ValueError: There is no beam, or one is no number or no unit vector.
    """
    if jnp.ndim(directions) not in (2, 3) or directions.shape[-1] != 3 or not directions.size:
        raise ValueError(
            f"a pattern needs one or more beams as unit vectors (n, 3) or (rows, columns, 3), got shape "
            f"{jnp.shape(directions)}"
        )
    if isinstance(directions, jax.core.Tracer):
        return
    size = np.linalg.norm(np.asarray(directions, np.float64).reshape(-1, 3), axis=1)
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
    rows = np.asarray(relief.frame[first : first + n], np.float64)
    nearest = int(np.argmin(np.linalg.norm(rows[:, :3] - place, axis=1)))
    sensor = rows[nearest, 3:12].reshape(3, 3) @ (place - rows[nearest, :3])
    on_axis = np.linspace(-2.0, 2.0, 9)[:, None] * [1.0, 0.0, 0.0]
    surface, boxes = block_contents(relief, first + nearest)
    hidden = _crosses_triangles(on_axis, sensor, surface) | _crosses_boxes(on_axis, sensor, boxes)
    if hidden.all():
        x, y, z = place
        raise SubterraError(
            f"the sensor at ({x:.2f}, {y:.2f}, {z:.2f}) m, station {station:.1f} m, is inside the wall, or in a thing: "
            "it is not seen from the axis"
        )


def _crosses_triangles(
    start: Float[np.ndarray, "n 3"], end: Float[np.ndarray, "3"], corner: Float[np.ndarray, "t 3 3"]
) -> Bool[np.ndarray, "n"]:
    """Tell which lines between some points and another one cross a triangle; all in one frame, m."""
    edges = np.roll(corner, -1, axis=1) - corner
    normal = np.cross(edges[:, 0], edges[:, 1])
    above_end = np.sum((end - corner[:, 0]) * normal, axis=1)
    crosses = np.zeros(len(start), bool)
    for k, point in enumerate(start):
        above = np.sum((point - corner[:, 0]) * normal, axis=1)
        cut = np.flatnonzero((above > 0.0) != (above_end > 0.0))
        share = above[cut] / (above[cut] - above_end[cut])
        met = point + share[:, None] * (end - point)
        side = np.sum(np.cross(edges[cut], met[:, None] - corner[cut]) * normal[cut, None], axis=-1)
        crosses[k] = (side >= 0.0).all(axis=1).any()
    return crosses


def _crosses_boxes(
    start: Float[np.ndarray, "n 3"], end: Float[np.ndarray, "3"], box: Float[np.ndarray, "k 3 4"]
) -> Bool[np.ndarray, "n"]:
    """Tell which lines between some points and another one cross a box; boxes as in `Cells.box`."""
    first, last = (np.einsum("kij,...j->...ki", box[..., :3], point) - box[..., 3] for point in (start, end))
    step = last - first
    step = np.where(np.abs(step) < 1e-12, 1e-12, step)
    faces = np.stack([(-1.0 - first) / step, (1.0 - first) / step])
    enters, leaves = faces.min(axis=0).max(axis=-1), faces.max(axis=0).min(axis=-1)
    return ((enters <= leaves) & (enters <= 1.0) & (leaves >= 0.0)).any(axis=1)


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


def rotate(orientation: Float[Array, "4"], vectors: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Rotate vectors by a unit quaternion w, x, y, z."""
    w, x, y, z = orientation[0], orientation[1], orientation[2], orientation[3]
    a, b, c = vectors[..., 0], vectors[..., 1], vectors[..., 2]
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
    return _clip(find(relief, origins, directions, blocks, limits), origins, directions, limits)


def _clip(hits: Hits, origins: Array, directions: Array, limits: Array) -> Float[Array, "*n"]:
    finite = jnp.isfinite(jnp.sum(origins, axis=-1) + jnp.sum(directions, axis=-1))
    return jnp.where(finite, jnp.clip(hits.distance, 0.0, limits), jnp.nan)


@_ranges.defjvp
@in_32_bits()
def _ranges_and_changes(primals: Any, tangents: Any) -> tuple[Array, Array]:
    """Return ranges and their changes: a ray's end stays in the plane of the triangle that it meets."""
    relief, origins, directions, blocks, limits = primals
    _, moved, turned, _, widened = tangents
    hits, rows = find_facing(relief, origins, directions, blocks, limits)
    ranges, normal = _clip(hits, origins, directions, limits), jnp.stack(rows, axis=-1)
    facing = jnp.sum(normal * directions, axis=-1)
    meets = (hits.entry != -1) & (hits.distance < limits) & (jnp.abs(facing) > 0.0)
    shift = jnp.sum(normal * (moved + ranges[:, None] * turned), axis=-1)
    return ranges, jnp.where(
        meets, -shift / jnp.where(meets, facing, 1.0), jnp.where(hits.distance >= limits, widened, 0.0)
    )
