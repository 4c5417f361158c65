"""A ray's way through the voxels of a relief.

From an empty voxel it leaps over as many as are known to be empty; in a voxel with triangles it meets those, a few at a
time. Every loop has a fixed number of turns.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Float, Int

from subterra_jax.lidar3d.relief import Relief

# Leaps and triangles met in one round, and rounds of a sweep.
N_LEAPS, N_TESTED, N_ROUNDS = 2, 8, 5
# Past the face of a voxel, so that rounding does not hold a ray there; `voxels.MARGIN` is larger, so nothing is missed.
_PAST = 2e-4
# Rays between two triangles must meet one of them although their edges are rounded apart; a share of a triangle's size.
_SEAM = 5e-5
_LEFT = jnp.inf


@struct.dataclass
class Ray:
    """How far a ray has got.

    Attributes:
        reached: It has met nothing up to here, m; `inf` once it has left the bore.
        block: Block that it is in there.
        skip: Triangles of the present voxel that it has been compared with.
        hit: Nearest triangle met so far, m.
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
        origin: Of the ray, m.
        direction: Of the ray, unit vector.
        leave: Where it leaves the block, m.
        following: The block that it is in from there.
    """

    block: Int[Array, ""]
    origin: Float[Array, "3"]
    direction: Float[Array, "3"]
    leave: Float[Array, ""]
    following: Int[Array, ""]


def goes_on(ray: Ray, limit: Array) -> Array:
    """Whether a ray has neither met anything nor come to its end; a NaN ends it."""
    return (ray.reached < limit) & (ray.hit > ray.reached)


def sweep(relief: Relief, rays: Ray, origins: Array, directions: Array, limits: Array) -> Ray:
    """A few rounds of every ray."""

    def one_round(ray: Ray, origin: Array, direction: Array, limit: Array) -> Ray:
        frame = _enter(relief, origin, direction, ray.block)
        for _ in range(N_LEAPS):
            ray = _leap(relief, frame, ray, limit)
        return _meet(relief, frame, ray, limit)

    every = jax.vmap(one_round)
    return lax.fori_loop(0, N_ROUNDS, lambda _, part: every(part, origins, directions, limits), rays)


def _enter(relief: Relief, origin: Array, direction: Array, block: Array) -> Frame:
    """A ray in the frame of the block that it is in."""
    row = relief.frame[block]
    o, d = turned(row, origin - row[:3]), turned(row, direction)
    back, front = _crossing(row[12:16], o, d, -1.0), _crossing(row[16:20], o, d, 1.0)
    return Frame(block, o, d, jnp.minimum(back, front), block + jnp.where(front <= back, 1, -1))


def _crossing(plane: Float[Array, "4"], origin: Array, direction: Array, outwards: float) -> Float[Array, ""]:
    """Where a ray leaves through a plane, m; `inf` where it runs along it or the other way."""
    speed = dot(plane[:3], direction)
    gap = plane[3] - dot(plane[:3], origin)
    return jnp.where(outwards * speed > 1e-9, gap / jnp.where(jnp.abs(speed) > 1e-9, speed, 1.0), jnp.inf)


def _leap(relief: Relief, frame: Frame, ray: Ray, limit: Array) -> Ray:
    """The ray at the end of the empty voxels around it; as it was where there are triangles, or out of the frame."""
    code, end = _look(relief, frame, ray)
    goes = (code < 0) & (ray.block == frame.block) & goes_on(ray, limit)
    return _where(goes, _moved(relief, frame, ray, end), ray)


def _meet(relief: Relief, frame: Frame, ray: Ray, limit: Array) -> Ray:
    """The ray after meeting a few triangles of its voxel; past the voxel once it has met all of them."""
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
    # A hit in this voxel is final; before one further on there may be what the next voxels list.
    final = (hit <= jnp.minimum(end, frame.leave) + _PAST) & ~more
    moved = _moved(relief, frame, ray.replace(hit=hit), end)  # type: ignore[attr-defined]
    after = _where(more, ray.replace(hit=hit, skip=ray.skip + N_TESTED), moved)  # type: ignore[attr-defined]
    after = _where(final, ray.replace(hit=hit, reached=hit), after)  # type: ignore[attr-defined]
    return _where((ray.block == frame.block) & goes_on(ray, limit), after, ray)


def _look(relief: Relief, frame: Frame, ray: Ray) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """The code of the voxel that a ray is in, and where it leaves the voxels known to be as empty, m."""
    o, d = frame.origin, frame.direction
    shape = jnp.asarray(relief.code.shape[1:], jnp.int32)
    place = jnp.floor((o + ray.reached * d - relief.low) / relief.cell)
    voxel = jnp.clip(place, 0, shape - 1).astype(jnp.int32)
    code = relief.code[frame.block, voxel[0], voxel[1], voxel[2]]
    free = jnp.maximum(-code, 1) - 1
    # The grid's outermost voxels reach on to infinity.
    behind = jnp.where(voxel - free <= 0, -jnp.inf, relief.low + (voxel - free) * relief.cell)
    before = jnp.where(voxel + free >= shape - 1, jnp.inf, relief.low + (voxel + free + 1) * relief.cell)
    level = jnp.abs(d) < 1e-9
    exits = jnp.where(d > 0.0, before - o, behind - o) / jnp.where(level, 1.0, d)
    return code, jnp.min(jnp.where(level, jnp.inf, exits))


def _moved(relief: Relief, frame: Frame, ray: Ray, end: Array) -> Ray:
    """The ray past its voxels, or in the next block, or out of the bore."""
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
    """Distance at which a ray meets each triangle, from either side, m; `inf` where it does not.

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


def turned(row: Float[Array, "20"], vector: Float[Array, "3"]) -> Float[Array, "3"]:
    """A vector in a block's frame."""
    return jnp.stack([dot(row[3:6], vector), dot(row[6:9], vector), dot(row[9:12], vector)])


def dot(a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, ""]:
    """The scalar product, written out: a library's might be rounded to TF32."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
