"""Meets a ray with one triangle or one box of a relief, and tells the normal there."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.lidar3d.cells import STEP_BITS, X_BITS, YZ_BITS
from subterra_jax.lidar3d.relief import N_FRAME, N_LINK

# Rays between two triangles must meet one of them although their edges are rounded apart; part of a triangle's size.
# So a ray that passes a free edge as closely meets the triangle too: 0.12 mm beside a sleeper of 2.5 m.
SEAM = 5e-5
# A ray may have stepped past a triangle by so much, m.
PAST = 2e-4
# A vertex's coordinates across the axis are read with the bits below them: so much of their unit.
FINE = 1 << (32 - YZ_BITS)
_TINY = 1e-12

Point = tuple[Array, Array, Array]


class Tools(NamedTuple):
    """Operations that a kernel does in its own way."""

    # reads elements of `frame`, `link`, `entry` or `box` of a relief, each flat, or pairs of `cell` or `vertex`, by
    # name and index; zeros where a mask is given and false
    load: Callable[..., Any]
    fma: Callable[[Array, Any, Any], Array]  # a · b + c
    reciprocal: Callable[[Array], Array]  # 1 / a, to within the last bit

    def dot(self, a: Any, b: Any) -> Array:
        """Return the scalar product of two vectors of two or three components."""
        total = a[-1] * b[-1]
        for left, right in zip(a[-2::-1], b[-2::-1], strict=True):
            total = self.fma(left, right, total)
        return total

    def minor(self, a: Array, b: Array, c: Array, d: Array) -> Array:
        """Return a · b − c · d."""
        return self.fma(a, b, -(c * d))

    def cross(self, a: Any, b: Any) -> Point:
        minor = self.minor
        return minor(a[1], b[2], a[2], b[1]), minor(a[2], b[0], a[0], b[2]), minor(a[0], b[1], a[1], b[0])


class Hits(NamedTuple):
    """First triangles that rays meet."""

    distance: Float[Array, "n"]  # distance to it, m; `inf` where there is none
    entry: Int[Array, "n"]  # its entry in `Relief.entry`; -1 where there is none, and -2 less the number of a box
    block: Int[Array, "n"]  # block of that entry


class Ray(NamedTuple):
    """Rays among the cells of their blocks."""

    units: Point  # points where they begin, in units of the relief along the axis, and a `FINE` part of them across it
    speeds: Point  # changes of these over a metre
    x: Float[Array, "n"]  # places along the axis where they begin, in cells from the first
    slope: Float[Array, "n"]  # metres that they go for each cell along the axis
    forward: Int[Array, "n"]  # 1 for rays along the axis, 0 for those against it
    onward: Bool[Array, "n"]  # true for rays that turn to the next wedge, not to the one before


def meet_one(
    tools: Tools,
    first_vertex: Int[Array, "n"],
    ray: Ray,
    number: Int[Array, "n"],
    listed: Bool[Array, "n"],
    hit: Float[Array, "n"],
    entry: Int[Array, "n"],
) -> tuple[Float[Array, "n"], Int[Array, "n"]]:
    """Compare rays with a triangle each, if it is listed; return the nearest distance, m, and its entry.

    Source: Möller and Trumbore, Fast, minimum storage ray/triangle intersection, 1997.
    """
    p, second, third = corners(tools, number, first_vertex, listed)
    a, b = ([q[j] - p[j] for j in range(3)] for q in (second, third))
    gap = [ray.units[j] - p[j] for j in range(3)]
    across_b, across_a = tools.cross(ray.speeds, b), tools.cross(gap, a)
    det = tools.dot(a, across_b)
    there = jnp.abs(det) > 0.0
    inverse = tools.reciprocal(jnp.where(there, det, 1.0))
    u, v, t = (tools.dot(*pair) * inverse for pair in ((gap, across_b), (ray.speeds, across_a), (b, across_a)))
    meets = listed & there & (jnp.minimum(u, v) >= -SEAM) & (u + v <= 1.0 + SEAM) & (t >= -PAST) & (t < hit)
    return jnp.where(meets, t, hit), jnp.where(meets, number, entry)


def meet_boxes(
    tools: Tools, first: Array, count: Array, at: list[Array], d: list[Array]
) -> tuple[Float[Array, "n"], Int[Array, "n"]]:
    """Compare rays with the boxes of a list each; return the nearest distance, m, and -2 less the box's number."""

    def one_box(i: Array, best: tuple[Array, Array]) -> tuple[Array, Array]:
        hit, which = best
        number = jnp.where(i < count, first + i, 0)
        enter, leave = jnp.full_like(hit, -jnp.inf), jnp.full_like(hit, jnp.inf)
        for side in range(3):
            row = [tools.load("box", 12 * number + 4 * side + j) for j in range(4)]
            speed = tools.dot(row[:3], d)
            slope = tools.reciprocal(jnp.where(jnp.abs(speed) < _TINY, _TINY, speed))
            middle, half = (row[3] - tools.dot(row[:3], at)) * slope, jnp.abs(slope)
            enter, leave = jnp.maximum(enter, middle - half), jnp.minimum(leave, middle + half)
        # From within a box one sees its inside.
        t = jnp.where(enter >= -PAST, enter, leave)
        meets = (i < count) & (enter <= leave) & (t >= -PAST) & (t < hit)
        return jnp.where(meets, t, hit), jnp.where(meets, -2 - number, which)

    start = jnp.full_like(at[0], jnp.inf), jnp.full_like(count, -1)
    return lax.fori_loop(0, jnp.max(count), one_box, start)


def normals(tools: Tools, origin: Point, direction: Point, hits: Hits) -> Point:
    """Return unit normals of what rays meet, tunnel frame, to either side; arbitrary where there is nothing."""
    row = hits.block * N_FRAME
    frame = lambda i: tools.load("frame", row + i)  # noqa: E731
    axes = [[frame(3 + 3 * i + j) for j in range(3)] for i in range(3)]
    first, second, third = corners(tools, hits.entry, tools.load("link", hits.block * N_LINK + 2), hits.entry >= 0)
    along, across = frame(22), FINE * frame(23)
    a, b = (
        [(p - q) * tools.reciprocal(unit) for p, q, unit in zip(corner, first, (along, across, across), strict=True)]
        for corner in (second, third)
    )
    end = [tools.fma(hits.distance, direction[i], origin[i] - frame(i)) for i in range(3)]
    face = _face(tools, hits.entry, [tools.dot(axis, end) for axis in axes])
    met = hits.entry < -1
    local = [jnp.where(met, one, other) for one, other in zip(face, tools.cross(a, b), strict=True)]
    turned = [tools.dot([axis[i] for axis in axes], local) for i in range(3)]
    squared = tools.dot(turned, turned)
    scale = lax.rsqrt(jnp.where(squared > 0.0, squared, 1.0))
    return turned[0] * scale, turned[1] * scale, turned[2] * scale


def _face(tools: Tools, entry: Int[Array, "n"], end: list[Array]) -> list[Array]:
    """Return normals of the faces on which rays end, in the frames of their blocks: those furthest out there."""
    number = jnp.maximum(-2 - entry, 0)
    place, face = jnp.full_like(end[0], -1.0), [jnp.zeros_like(end[0])] * 3
    for side in range(3):
        row = [tools.load("box", 12 * number + 4 * side + j) for j in range(4)]
        out = jnp.abs(tools.dot(row[:3], end) - row[3])
        face = [jnp.where(out > place, new, old) for new, old in zip(row[:3], face, strict=True)]
        place = jnp.maximum(out, place)
    return face


def corners(
    tools: Tools, entry: Int[Array, "n"], first_vertex: Int[Array, "n"], listed: Bool[Array, "n"]
) -> tuple[Point, Point, Point]:
    """Return the corners of triangles, in units of their relief along the axis, and a `FINE` part of them across it."""
    code, low = tools.load("entry", entry, listed), (1 << STEP_BITS) - 1
    number = first_vertex + lax.shift_right_logical(code, 2 * STEP_BITS)
    numbers = number, number + (lax.shift_right_logical(code, STEP_BITS) & low), number + (code & low)
    first, second, third = (_point(tools, number) for number in numbers)
    return first, second, third


def _point(tools: Tools, number: Int[Array, "n"]) -> Point:
    one, two = tools.load("vertex", number)
    half = X_BITS // 2
    low = (1 << half) - 1
    x = ((one & low) << half) | (two & low)
    return x.astype(jnp.float32), one.astype(jnp.float32), two.astype(jnp.float32)
