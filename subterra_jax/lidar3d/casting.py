"""Cast rays against every triangle of a relief: exact ranges for tilted and many-beam LiDARs.

A ray passes through the relief's voxels. In an empty voxel it leaps over all voxels known to be empty. In a voxel with
triangles it is compared with a few of them at a time. Every loop has a fixed number of turns. Most rays end within a
few rounds; the others are gathered and continue by themselves. The cost depends on neither the tunnel's length nor the
number of triangles.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float, Int

from subterra_jax.lidar3d.relief import Relief
from subterra_jax.rows import axes, spread

# Leaps and triangles met in one round, and rounds of a sweep.
N_LEAPS, N_TESTED, N_ROUNDS = 2, 8, 5
# Step past the face of a voxel, m, so that rounding does not hold a ray there; `relief.MARGIN` is larger.
_PAST = 2e-4
# Rays between two triangles must meet one of them although their edges are rounded apart; a share of a triangle's size.
_SEAM = 5e-5
_LEFT = jnp.inf


@struct.dataclass
class Ray:
    """State of a ray.

    Attributes:
        reached: Distance up to which it has met nothing, m; `inf` once it has left the bore.
        block: Block at that distance.
        skip: Triangles of the present voxel already compared.
        hit: Distance to the nearest triangle met so far, m.
    """

    reached: Float[Array, ""]
    block: Int[Array, ""]
    skip: Int[Array, ""]
    hit: Float[Array, ""]


@struct.dataclass
class Frame:
    """A ray in the frame of one block.

    Attributes:
        block: The block.
        origin: Origin of the ray, m.
        direction: Direction of the ray, unit vector.
        leave: Distance at which it leaves the block, m.
        following: Next block.
    """

    block: Int[Array, ""]
    origin: Float[Array, "3"]
    direction: Float[Array, "3"]
    leave: Float[Array, ""]
    following: Int[Array, ""]


def goes_on(ray: Ray, limit: Array) -> Array:
    """Return whether a ray has neither met a triangle nor reached its end; a NaN ends it."""
    return (ray.reached < limit) & (ray.hit > ray.reached)


def sweep(relief: Relief, rays: Ray, origins: Array, directions: Array, limits: Array) -> Ray:
    """Advance every ray by a few rounds."""

    def one_round(ray: Ray, origin: Array, direction: Array, limit: Array) -> Ray:
        frame = _enter(relief, origin, direction, ray.block)
        for _ in range(N_LEAPS):
            ray = _leap(relief, frame, ray, limit)
        return _meet(relief, frame, ray, limit)

    every = jax.vmap(one_round)
    return lax.fori_loop(0, N_ROUNDS, lambda _, part: every(part, origins, directions, limits), rays)


def _enter(relief: Relief, origin: Array, direction: Array, block: Array) -> Frame:
    """Transform a ray into the frame of its block."""
    row = relief.frame[block]
    o, d = rotate_into_frame(row, origin - row[:3]), rotate_into_frame(row, direction)
    back, front = _crossing(row[12:16], o, d, -1.0), _crossing(row[16:20], o, d, 1.0)
    return Frame(block, o, d, jnp.minimum(back, front), block + jnp.where(front <= back, 1, -1))


def _crossing(plane: Float[Array, "4"], origin: Array, direction: Array, outwards: float) -> Float[Array, ""]:
    """Return the distance at which a ray leaves through a plane, m; `inf` if it runs along it or the other way."""
    speed = dot(plane[:3], direction)
    gap = plane[3] - dot(plane[:3], origin)
    return jnp.where(outwards * speed > 1e-9, gap / jnp.where(jnp.abs(speed) > 1e-9, speed, 1.0), jnp.inf)


def _leap(relief: Relief, frame: Frame, ray: Ray, limit: Array) -> Ray:
    """Move a ray to the end of the empty voxels around it; leave it where there are triangles, or out of the frame."""
    code, end = _look(relief, frame, ray)
    goes = (code < 0) & (ray.block == frame.block) & goes_on(ray, limit)
    return _where(goes, _advance(relief, frame, ray, end), ray)


def _meet(relief: Relief, frame: Frame, ray: Ray, limit: Array) -> Ray:
    """Compare a ray with a few triangles of its voxel; move it past the voxel after the last of them."""
    code, end = _look(relief, frame, ray)
    listed = jnp.maximum(code, 0)
    number = relief.first[listed] + ray.skip + jnp.arange(N_TESTED)
    stop = relief.first[listed + 1]
    in_list = (number < stop) & (code >= 0)
    row = relief.member[jnp.minimum(number, relief.member.shape[0] - 1)]
    # From where the ray stands, not from its origin, so that little is lost to rounding.
    here = frame.origin + ray.reached * frame.direction
    distance = jnp.where(in_list, ray.reached + _distances(relief.triangle[row], here, frame.direction), jnp.inf)
    hit = jnp.minimum(ray.hit, jnp.min(jnp.where(distance >= 0.0, distance, jnp.inf)))
    more = (number[-1] + 1 < stop) & (code >= 0)
    # A hit in this voxel is final; before a hit further on there may be a triangle of the next voxels.
    final = (hit <= jnp.minimum(end, frame.leave) + _PAST) & ~more
    moved = _advance(relief, frame, ray.replace(hit=hit), end)  # type: ignore[attr-defined]
    after = _where(more, ray.replace(hit=hit, skip=ray.skip + N_TESTED), moved)  # type: ignore[attr-defined]
    after = _where(final, ray.replace(hit=hit, reached=hit), after)  # type: ignore[attr-defined]
    return _where((ray.block == frame.block) & goes_on(ray, limit), after, ray)


def _look(relief: Relief, frame: Frame, ray: Ray) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """Return the code of a ray's voxel, and the distance at which it leaves the voxels known to be as empty, m."""
    o, d = frame.origin, frame.direction
    shape = jnp.asarray(relief.code.shape[1:], jnp.int32)
    place = jnp.floor((o + ray.reached * d - relief.low) / relief.cell)
    voxel = jnp.clip(place, 0, shape - 1).astype(jnp.int32)
    code = relief.code[frame.block, voxel[0], voxel[1], voxel[2]]
    free = jnp.maximum(-code, 1) - 1
    # The grid's outermost voxels reach to infinity.
    behind = jnp.where(voxel - free <= 0, -jnp.inf, relief.low + (voxel - free) * relief.cell)
    before = jnp.where(voxel + free >= shape - 1, jnp.inf, relief.low + (voxel + free + 1) * relief.cell)
    level = jnp.abs(d) < 1e-9
    exits = jnp.where(d > 0.0, before - o, behind - o) / jnp.where(level, 1.0, d)
    return code, jnp.min(jnp.where(level, jnp.inf, exits))


def _advance(relief: Relief, frame: Frame, ray: Ray, end: Array) -> Ray:
    """Move a ray past its voxels, into the next block, or out of the bore."""
    leaves = frame.leave <= end
    out = leaves & ((frame.following < 0) | (frame.following >= relief.n_blocks))
    reached = jnp.maximum(ray.reached, jnp.where(leaves, frame.leave, end + _PAST))
    return ray.replace(  # type: ignore[attr-defined]
        reached=jnp.where(out, _LEFT, reached),
        block=jnp.where(leaves & ~out, frame.following, ray.block),
        skip=jnp.zeros_like(ray.skip),
    )


def _where(condition: Array, yes: Ray, no: Ray) -> Ray:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def _distances(triangle: Float[Array, "k 9"], origin: Array, direction: Array) -> Float[Array, "k"]:
    """Return the distance at which a ray meets each triangle from either side, m; `inf` if it does not.

    Source: Möller and Trumbore, Fast, minimum storage ray/triangle intersection, 1997.
    """
    dx, dy, dz = direction[0], direction[1], direction[2]
    gx, gy, gz = origin[0] - triangle[:, 0], origin[1] - triangle[:, 1], origin[2] - triangle[:, 2]
    ax, ay, az = triangle[:, 3], triangle[:, 4], triangle[:, 5]
    bx, by, bz = triangle[:, 6], triangle[:, 7], triangle[:, 8]
    px, py, pz = dy * bz - dz * by, dz * bx - dx * bz, dx * by - dy * bx
    det = ax * px + ay * py + az * pz
    qx, qy, qz = gy * az - gz * ay, gz * ax - gx * az, gx * ay - gy * ax
    inverse = 1.0 / jnp.where(jnp.abs(det) < 1e-12, 1.0, det)
    u = (gx * px + gy * py + gz * pz) * inverse
    v = (dx * qx + dy * qy + dz * qz) * inverse
    t = (bx * qx + by * qy + bz * qz) * inverse
    meets = (u >= -_SEAM) & (v >= -_SEAM) & (u + v <= 1.0 + _SEAM) & (t >= -2.0 * _PAST)
    return jnp.where(meets & (jnp.abs(det) >= 1e-12), t, jnp.inf)


def rotate_into_frame(row: Float[Array, "20"], vector: Float[Array, "3"]) -> Float[Array, "3"]:
    """Turn a vector into a block's frame."""
    return jnp.stack([dot(row[3:6], vector), dot(row[6:9], vector), dot(row[9:12], vector)])


def dot(a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, ""]:
    """Return the scalar product, written out: a library may round to TF32."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


# Most sweeps of a ray that meets nothing; the slowest of 32,000 in `subterra-351` took 13.
N_SWEEPS = 400
# A later sweep takes one in 8 of the rays, then one in 64 once no more are left, but never fewer than FEW.
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
    """
    return cast(relief, position, rotate(orientation, directions), station, range_max)


def cast(
    relief: Relief,
    origin: Float[Array, "3"],
    directions: Float[Array, "n 3"],
    station: Float[Array, ""],
    range_max: Float[Array, ""] | float,
) -> Float[Array, "n"]:
    """Return the distance along each ray to the nearest triangle.

    Under any number of `vmap`s all rays in one relief are cast as one batch. A ray's result depends on no other ray.

    Args:
        relief: Surface of the bore.
        origin: Origin of all rays, tunnel frame, m.
        directions: Unit vectors, tunnel frame.
        station: Station of the origin, m, to within 2 m.
        range_max: Largest range, m.

    Returns:
        Ranges, m, in [0, range_max]; exactly `range_max` for a ray that meets nothing; NaN where an argument is.
    """
    n = directions.shape[0]
    origins = jnp.broadcast_to(origin, (n, 3))
    blocks = jnp.broadcast_to(block_at(relief, origin, station), (n,))
    limits = jnp.broadcast_to(jnp.asarray(range_max, jnp.float32), (n,))
    return _cast_rays(relief, origins, directions, blocks, limits)


def block_at(relief: Relief, origin: Float[Array, "3"], station: Float[Array, ""]) -> Int[Array, ""]:
    """Return the block around a point whose station is known to a block's length; beyond a mouth, the last block."""
    last = relief.n_blocks - 1
    guess = jnp.floor(station / relief.length * relief.n_blocks)
    block = jnp.clip(guess, 0, last).astype(jnp.int32)
    row = relief.frame[block]
    local = rotate_into_frame(row, origin - row[:3])
    ahead, behind = dot(row[16:19], local) > row[19], dot(row[12:15], local) < row[15]
    return jnp.clip(block + ahead.astype(jnp.int32) - behind.astype(jnp.int32), 0, last)


def rotate(orientation: Float[Array, "4"], vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Rotate vectors by a unit quaternion w, x, y, z."""
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
    """Cast rays in one relief, each from the block around its origin."""
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
    """Sweep all rays, then ever fewer unfinished ones."""
    n = len(limits)
    rays = Ray(jnp.zeros(n), blocks, jnp.zeros(n, jnp.int32), jnp.full(n, jnp.inf))
    rays = sweep(relief, rays, origins, directions, limits)
    sizes = [min(n, max(FEW, -(-n // share))) for share in SHARES]
    for size, enough in zip(sizes, [*sizes[1:], 0], strict=True):
        rays = _sweep_until(enough, size, relief, rays, origins, directions, limits)
    return jnp.minimum(jnp.where(jnp.isfinite(rays.hit), rays.hit, rays.reached), limits)


def _sweep_until(
    enough: int, size: int, relief: Relief, rays: Ray, origins: Array, directions: Array, limits: Array
) -> Ray:
    """Sweep `size` unfinished rays at a time until no more than `enough` are left."""

    def too_many_left(carry: tuple[Array, Ray]) -> Array:
        return (jnp.sum(goes_on(carry[1], limits)) > enough) & (carry[0] < N_SWEEPS)

    def sweep_some(carry: tuple[Array, Ray]) -> tuple[Array, Ray]:
        count, rays = carry
        (which,) = jnp.nonzero(goes_on(rays, limits), size=size, fill_value=len(limits))
        some = jnp.minimum(which, len(limits) - 1)
        part = jax.tree.map(lambda leaf: leaf[some], rays)
        part = sweep(relief, part, origins[some], directions[some], limits[some])
        return count + 1, jax.tree.map(lambda leaf, new: leaf.at[which].set(new, mode="drop"), rays, part)

    return lax.while_loop(too_many_left, sweep_some, (jnp.int32(0), rays))[1]


@_cast_rays.def_vmap
def _cast_more_rays(axis_size: int, batched: Any, relief: Relief, *rows: Array) -> tuple[Array, bool]:
    """Merge a batch axis into the rays; cast each relief by itself if they differ."""
    if any(jax.tree.leaves(batched[0])):
        return jax.vmap(_cast_rays.fun, in_axes=axes(batched))(relief, *rows), True
    flat = [row.reshape(-1, *row.shape[2:]) for row in spread(rows, batched[1:], axis_size)]
    return _cast_rays(relief, *flat).reshape(axis_size, -1), True
