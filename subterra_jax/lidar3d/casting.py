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
from subterra_jax.lidar3d.finding import find, find_from
from subterra_jax.lidar3d.relief import Relief, block_contents


class Met(NamedTuple):
    """Surfaces that rays meet, `n` of them or an image."""

    ranges: Float[Array, "*n"]  # distance along each ray, m; exactly the largest range where nothing is met
    # unit normal of the surface, tunnel frame, to either side; arbitrary where nothing is met
    normal: Float[Array, "*n 3"]
    thing: Bool[Array, "*n"]  # a box is met, as track or furniture, and not the lining


@in_32_bits()
def meet(
    relief: Relief,
    origins: Float[Array, "n 3"] | Float[Array, "3"],
    directions: Float[Array, "n 3"] | Float[Array, "rows columns 3"],
    station: Float[Array, ""],
    limits: Float[Array, "n"] | Float[Array, ""] | float,
) -> Met:
    """Return the surfaces that rays meet, without noise.

    Derivatives of the ranges are exact but at edges: those of the plane of the triangle that the ray meets, 0 for a ray
    that meets nothing.

    Args:
        relief: Surface of the bore, or of one picked from a stack.
        origins: Origins, one for each ray or one for an image, tunnel frame, m, within 2 m of the station.
        directions: Unit vectors, tunnel frame, `(n, 3)`, or an image, a ring a row; see `beams`.
            NVIDIA GPUs take an image tile by tile, which was twice as fast in upright tunnels.
        station: Station of the origins, m.
        limits: Largest ranges, m.

    Returns:
        Ranges in [0, limit], exactly `limit` for a ray that meets nothing, as one through a mouth; NaN where an
        argument is.
    """
    origins, directions = jnp.asarray(origins, jnp.float32), jnp.asarray(directions, jnp.float32)
    limits = jnp.asarray(limits, jnp.float32)
    if directions.ndim == 3:
        block = block_at(relief, origins, jnp.asarray(station, jnp.float32))
        return Met(*_meet(relief.shared, origins, directions, block, limits))
    blocks = jax.vmap(block_at, (None, 0, None))(relief, origins, jnp.asarray(station, jnp.float32))
    limits = jnp.broadcast_to(limits, len(directions))
    return Met(*_meet(relief.shared, origins, directions, blocks, limits))


@jax.custom_jvp
@in_32_bits()
def _meet(
    relief: Relief,
    origins: Float[Array, "*n 3"],
    directions: Float[Array, "*image 3"],
    blocks: Int[Array, "*n"],
    limits: Float[Array, "*n"],
) -> tuple[Float[Array, "*image"], Float[Array, "*image 3"], Bool[Array, "*image"]]:
    """Return the rows of `Met` of rays from a place each, or of those of an image from one, and the blocks there."""
    rows = jax.vmap(find, (None, 0, 0, 0, 0))
    hits, normal = (find_from if directions.ndim == 3 else rows)(relief, origins, directions, blocks, limits)
    finite = jnp.isfinite(jnp.sum(origins, axis=-1) + jnp.sum(directions, axis=-1))
    ranges = jnp.where(finite, jnp.clip(hits.distance, 0.0, limits), jnp.nan)
    return ranges, jnp.stack(normal, axis=-1), hits.entry < -1


@_meet.defjvp
@in_32_bits()
def _meet_and_changes(primals: Any, tangents: Any) -> tuple[Any, Any]:
    """Return what rays meet, and how the ranges change: a ray's end stays in the plane of what it meets."""
    _, _, directions, _, limits = primals
    _, moved, turned, _, widened = tangents
    ranges, normal, thing = _meet(*primals)
    facing = jnp.sum(normal * directions, axis=-1)
    meets = (ranges < limits) & (jnp.abs(facing) > 0.0)
    shift = jnp.sum(normal * (moved + ranges[..., None] * turned), axis=-1)
    change = jnp.where(meets, -shift / jnp.where(meets, facing, 1.0), jnp.where(ranges >= limits, widened, 0.0))
    return (ranges, normal, thing), (change, jnp.zeros_like(normal), np.zeros(thing.shape, jax.dtypes.float0))


def require_pattern(directions: np.ndarray) -> None:
    """Check beams, unit vectors `(n, 3)`.

    Raises:
        ValueError: There is no beam, or one is no number or no unit vector.
    """
    if directions.ndim != 2 or directions.shape[-1] != 3 or not directions.size:
        raise ValueError(f"a pattern needs one or more beams as unit vectors (n, 3), got shape {directions.shape}")
    size = np.linalg.norm(directions.astype(np.float64), axis=1)
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
        fraction = above[cut] / (above[cut] - above_end[cut])
        met = point + fraction[:, None] * (end - point)
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
    # Written out: a library's product may round to TF32.
    local = jnp.sum(row[3:12].reshape(3, 3) * (origin - row[:3]), axis=1)
    ahead, behind = jnp.sum(row[16:19] * local) > row[19], jnp.sum(row[12:15] * local) < row[15]
    return relief.first_block + jnp.clip(at + ahead.astype(jnp.int32) - behind.astype(jnp.int32), 0, last)
