"""Marches a ray through a relief: from block to block, from cell to cell, until it meets a triangle.

Written once, for many rays at a time, over the few operations that differ: XLA marches some thousand rays in step, a
fused kernel as many as a warp has lanes. `native.marching` does the same for one ray after another on a CPU.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.lidar3d.cells import FACES, MARGIN, N_WEDGES, NEAR_UNIT, STEP_BITS, X_BITS, YZ_BITS
from subterra_jax.lidar3d.relief import N_FRAME, N_LINK

# Rays between two triangles must meet one of them although their edges are rounded apart; a share of a triangle's size.
SEAM = 5e-5
# A ray may have stepped past a triangle by so much, m.
PAST = 2e-4
# A vertex's coordinates across the axis are read with the bits below them: so much of their unit.
FINE = 1 << (32 - YZ_BITS)
_TINY = 1e-12

Point = tuple[Array, Array, Array]


class Tools(NamedTuple):
    """Operations that a kernel does in its own way.

    Attributes:
        load: Reads elements of `frame`, `link`, `entry` or `box` of a relief, each flat, or pairs of `cell` or
            `vertex`, by name and index; zeros where a mask is given and false.
        fma: a · b + c.
        reciprocal: 1 / a, to within the last bit.
    """

    load: Callable[..., Any]
    fma: Callable[[Array, Any, Any], Array]
    reciprocal: Callable[[Array], Array]

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
        """Return the vector product."""
        minor = self.minor
        return minor(a[1], b[2], a[2], b[1]), minor(a[2], b[0], a[0], b[2]), minor(a[0], b[1], a[1], b[0])


class Hits(NamedTuple):
    """First triangles that rays meet.

    Attributes:
        distance: Distance to it, m; `inf` where there is none.
        entry: Its entry in `Relief.entry`; -1 where there is none, and -2 less the number of a box.
        block: Block of that entry.
    """

    distance: Float[Array, "n"]
    entry: Int[Array, "n"]
    block: Int[Array, "n"]


class Rays(NamedTuple):
    """Rays on their way through blocks.

    Attributes:
        block: Present block.
        reached: Distance at which the ray enters it, m.
        hits: First triangles met so far.
        going: The ray may still meet a nearer one.
    """

    block: Int[Array, "n"]
    reached: Float[Array, "n"]
    hits: Hits
    going: Bool[Array, "n"]


def march(
    tools: Tools, n_x: int, origin: Point, direction: Point, block: Int[Array, "n"], limit: Float[Array, "n"]
) -> Hits:
    """Find the first triangle that each ray meets within its limit.

    Args:
        tools: Operations of the kernel.
        n_x: Cells of a block along the axis.
        origin: Origins, tunnel frame, m, each `(n,)`.
        direction: Unit vectors, tunnel frame, each `(n,)`.
        block: Blocks around the origins.
        limit: Largest distances of interest, m.
    """

    def one_block(rays: Rays) -> Rays:
        return _cross_block(tools, n_x, origin, direction, limit, rays)

    none = Hits(jnp.full_like(limit, jnp.inf), jnp.full_like(block, -1), block)
    start = Rays(block, jnp.zeros_like(limit), none, limit >= 0.0)
    return lax.while_loop(lambda rays: _any(rays.going), one_block, start).hits


def _any(mask: Bool[Array, "n"]) -> Bool[Array, ""]:
    return jnp.max(mask.astype(jnp.int32)) > 0


def _cross_block(tools: Tools, n_x: int, origin: Point, direction: Point, limit: Array, rays: Rays) -> Rays:
    """Take each ray that goes on through its block."""
    way = enter_block(tools, origin, direction, limit, rays)
    found, entry = _cross_cells(tools, n_x, way, rays.going & (way.end >= 0.0))
    return leave_block(rays, way, limit, Hits(way.begin + found, entry, rays.block))


class Way(NamedTuple):
    """Ways of rays through one block each, in its frame; distances are from the rays' origins if not said otherwise.

    Attributes:
        at: Points where the rays leave the empty prism, m.
        d: Unit vectors.
        begin: Distance to these points, m.
        end: Distance from there to where the ray leaves the block, or needs go no further, m.
        leave: Distance at which the ray leaves the block, m.
        following: Block behind or ahead that it enters then; -1 at a mouth.
        hits: First triangles or boxes met so far, those in earlier blocks and the boxes of this one.
        low: Where the first cell begins along the axis, m.
        per_cell: Cells a metre.
        along: Units of a vertex along the axis, 1/m.
        across: Units of a vertex across the axis, 1/m.
        first_vertex: First vertex of the block.
        first_cell: First cell of the block.
    """

    at: tuple[Array, ...]
    d: tuple[Array, ...]
    begin: Float[Array, "n"]
    end: Float[Array, "n"]
    leave: Float[Array, "n"]
    following: Int[Array, "n"]
    hits: Hits
    low: Float[Array, "n"]
    per_cell: Float[Array, "n"]
    along: Float[Array, "n"]
    across: Float[Array, "n"]
    first_vertex: Int[Array, "n"]
    first_cell: Int[Array, "n"]


def enter_block(tools: Tools, origin: Point, direction: Point, limit: Array, rays: Rays) -> Way:
    """Put each ray into the frame of its block, meet the boxes there, and leap through the empty prism."""
    row = rays.block * N_FRAME
    frame = lambda i: tools.load("frame", row + i)  # noqa: E731
    link = lambda i: tools.load("link", rays.block * N_LINK + i)  # noqa: E731
    axes = [[frame(3 + 3 * i + j) for j in range(3)] for i in range(3)]
    from_centre = [origin[i] - frame(i) for i in range(3)]
    o, d = [tools.dot(axis, from_centre) for axis in axes], [tools.dot(axis, direction) for axis in axes]
    back, front = (
        _leaving(tools, [frame(first + i) for i in range(4)], o, d, way) for first, way in ((12, -1.0), (16, 1.0))
    )
    leave, following = jnp.minimum(back, front), jnp.where(front <= back, link(1), link(0))
    # From where the ray stands, so that little is lost to rounding.
    at = [tools.fma(rays.reached, d[i], o[i]) for i in range(3)]
    lowest = tools.fma(jnp.maximum(jnp.minimum(leave, limit) - rays.reached, 0.0), jnp.minimum(d[2], 0.0), at[2])
    count = jnp.where(rays.going & (lowest <= frame(24)), link(5), 0)
    boxes = _meet_boxes(tools, link(4), count, at, d)
    hits = _nearer(rays.hits, Hits(rays.reached + boxes[0], boxes[1], rays.block))
    leap = _leap(tools, frame, at, d)
    begin = jnp.minimum(rays.reached + leap, jnp.maximum(leave, rays.reached))
    at = [tools.fma(begin - rays.reached, d[i], at[i]) for i in range(3)]
    end = jnp.minimum(jnp.minimum(leave, limit), hits.distance) - begin
    return Way(
        tuple(at),
        tuple(d),
        begin,
        end,
        leave,
        following,
        hits,
        frame(20),
        frame(21),
        frame(22),
        frame(23),
        link(2),
        link(3),
    )


def leave_block(rays: Rays, way: Way, limit: Array, found: Hits) -> Rays:
    """Return rays in their next blocks, with what they met in the last."""
    hits = _nearer(way.hits, found)
    going = rays.going & (way.leave < jnp.minimum(limit, hits.distance)) & (way.following >= 0)
    following, reached = jnp.where(going, way.following, rays.block), jnp.where(going, way.leave, rays.reached)
    return Rays(following, reached, hits, going)


def _nearer(one: Hits, other: Hits) -> Hits:
    """Return the nearer of two hits of each ray."""
    nearer = other.distance < one.distance
    return Hits(*(jnp.where(nearer, b, a) for a, b in zip(one, other, strict=True)))


def _leaving(tools: Tools, plane: list[Array], o: list[Array], d: list[Array], way: float) -> Float[Array, "n"]:
    """Return the distance at which a ray leaves through a plane, m; `inf` if it runs along it or the other way."""
    speed, gap = tools.dot(plane[:3], d), plane[3] - tools.dot(plane[:3], o)
    leaves = way * speed > 1e-9
    return jnp.where(leaves, gap * tools.reciprocal(jnp.where(leaves, speed, 1.0)), jnp.inf)


def _leap(tools: Tools, frame: Any, at: list[Array], d: list[Array]) -> Float[Array, "n"]:
    """Return how far a ray stays in the block's prism, in which there is nothing, m; 0 if it is not in it."""
    leave, room = jnp.full_like(at[0], 1e9), jnp.full_like(at[0], jnp.inf)
    for i, (left, up) in enumerate(FACES.tolist()):
        speed = tools.fma(d[1], left, d[2] * up)
        gap = frame(25 + i) - tools.fma(at[1], left, at[2] * up)
        room = jnp.minimum(room, gap)
        leave = jnp.where(speed > _TINY, jnp.minimum(leave, gap * tools.reciprocal(speed)), leave)
    return jnp.where(room >= 0.0, leave, 0.0)


def wedge_edge(turn: Float[Array, "n"]) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """Return the direction left and up at a share of 4 of a turn, as `cells.wedge_edge`."""
    return jnp.abs(turn - 2.0) - 1.0, jnp.abs(turn + jnp.where(turn < 1.0, 1.0, -3.0)) - 1.0


def wedge_at(tools: Tools, y: Float[Array, "n"], z: Float[Array, "n"]) -> Int[Array, "n"]:
    """Return the wedge in which points lie, as `cells.wedge_place`."""
    share = y * tools.reciprocal(jnp.maximum(jnp.abs(y) + jnp.abs(z), 1e-30))
    turn = jnp.where(z >= 0.0, 1.0 - share, 3.0 + share)
    return jnp.clip((turn * (N_WEDGES / 4)).astype(jnp.int32), 0, N_WEDGES - 1)


class Step(NamedTuple):
    """Rays on their way through the cells of a block; distances are from where they began there.

    Attributes:
        x: Cell along the axis.
        wedge: Wedge.
        reached: Distance at which the ray enters the cell, m.
        hit: Distance to the nearest triangle met so far, m.
        entry: Entry of that triangle.
        going: The ray may still meet one in this block.
    """

    x: Int[Array, "n"]
    wedge: Int[Array, "n"]
    reached: Float[Array, "n"]
    hit: Float[Array, "n"]
    entry: Int[Array, "n"]
    going: Bool[Array, "n"]


class Ray(NamedTuple):
    """Rays among the cells of their blocks.

    Attributes:
        units: Points where they begin, in units of the relief along the axis, and a `FINE` part of them across it.
        speeds: Changes of these over a metre.
        x: Places along the axis where they begin, in cells from the first.
        slope: Metres that they go for each cell along the axis.
        forward: 1 for rays along the axis, 0 for those against it.
        onward: True for rays that turn to the next wedge, not to the one before.
    """

    units: Point
    speeds: Point
    x: Float[Array, "n"]
    slope: Float[Array, "n"]
    forward: Int[Array, "n"]
    onward: Bool[Array, "n"]


def ray_in_cells(tools: Tools, way: Way) -> Ray:
    """Return what rays in their blocks need at every cell."""
    at, d, along, across = way.at, way.d, way.along, way.across * FINE
    # Vertices count from 0 along the axis.
    units = (tools.fma(at[0], along, 0.5 * (1 << X_BITS)), at[1] * across, at[2] * across)
    speeds = (d[0] * along, d[1] * across, d[2] * across)
    forward = jnp.where(d[0] > 0.0, 1, 0)
    onward = tools.minor(at[1], d[2], at[2], d[1]) > 0.0
    slope = tools.reciprocal(jnp.where(jnp.abs(d[0]) < 1e-9, 1e-9, d[0]) * way.per_cell)
    return Ray(units, speeds, (at[0] - way.low) * way.per_cell, slope, forward, onward)


def first_step(tools: Tools, n_x: int, way: Way, ray: Ray, going: Bool[Array, "n"]) -> Step:
    """Return rays in the cells where they begin."""
    first_x = jnp.clip(ray.x, 0.0, n_x - 1.0).astype(jnp.int32)
    wedge = wedge_at(tools, way.at[1], way.at[2])
    nothing = jnp.full_like(way.end, jnp.inf)
    return Step(first_x, wedge, jnp.zeros_like(way.end), nothing, jnp.full_like(first_x, -1), going)


class Stay(NamedTuple):
    """Stays of rays in one cell each.

    Attributes:
        first: First entry of the cell's list.
        listed: Number of entries that the ray must be compared with.
        leave: Distance at which it leaves, m.
        ends: True where it leaves through an end of the cell, not through a side of its wedge.
    """

    first: Int[Array, "n"]
    listed: Int[Array, "n"]
    leave: Float[Array, "n"]
    ends: Bool[Array, "n"]


def enter_cell(tools: Tools, n_x: int, way: Way, ray: Ray, step: Step) -> Stay:
    """Look up the lists of the cells where rays are, empty for a ray that does not come near its triangles."""
    at, d = way.at, way.d
    edge = step.x + ray.forward
    # The outermost cells reach to infinity.
    leave_x = jnp.where((edge <= 0) | (edge >= n_x), jnp.inf, (edge.astype(jnp.float32) - ray.x) * ray.slope)
    turn = step.wedge.astype(jnp.float32) * (4.0 / N_WEDGES)
    (y0, z0), (y1, z1) = wedge_edge(turn), wedge_edge(turn + 4.0 / N_WEDGES)
    y, z = jnp.where(ray.onward, y1, y0), jnp.where(ray.onward, z1, z0)
    speed, side = tools.minor(y, d[2], z, d[1]), tools.minor(z, at[1], y, at[2])
    turns = jnp.where(ray.onward, speed, -speed) > _TINY
    leave_wedge = jnp.where(turns, side * tools.reciprocal(jnp.where(turns, speed, 1.0)), jnp.inf)
    leave = jnp.maximum(jnp.minimum(leave_x, leave_wedge), step.reached)
    y, z = y0 + y1, z0 + z1
    deeper = tools.dot((y, z), d[1:])
    deepest = jnp.where(deeper > 0.0, jnp.minimum(leave, way.end), step.reached)
    depth = tools.fma(deeper, deepest, tools.dot((y, z), at[1:]))
    first, word = tools.load("cell", way.first_cell + step.x * N_WEDGES + step.wedge)
    near = (word & 0xFFFF).astype(jnp.float32)
    reaches = step.going & ((depth + MARGIN) * (1.0 / NEAR_UNIT) >= near)
    return Stay(first, jnp.where(reaches, lax.shift_right_logical(word, 16), 0), leave, leave_x <= leave_wedge)


def leave_cell(way: Way, ray: Ray, step: Step, stay: Stay) -> Step:
    """Return rays in their next cells; `step` has the nearest triangles so far."""
    going = step.going & (stay.leave < way.end) & (step.hit > stay.leave)
    x = step.x + jnp.where(stay.ends & going, 2 * ray.forward - 1, 0)
    wedge = step.wedge + jnp.where(stay.ends | ~going, 0, jnp.where(ray.onward, 1, -1))
    wedge = jnp.where(wedge == N_WEDGES, 0, jnp.where(wedge < 0, N_WEDGES - 1, wedge))
    return Step(x, wedge, jnp.where(going, stay.leave, step.reached), step.hit, step.entry, going)


def _cross_cells(
    tools: Tools, n_x: int, way: Way, going: Bool[Array, "n"]
) -> tuple[Float[Array, "n"], Int[Array, "n"]]:
    """Return the distance at which rays meet a triangle in their block, m, or `inf`, and its entry."""
    ray = ray_in_cells(tools, way)

    def one_cell(step: Step) -> Step:
        stay = enter_cell(tools, n_x, way, ray, step)
        hit, entry = _meet(tools, way, ray, stay, step)
        return leave_cell(way, ray, step._replace(hit=hit, entry=entry), stay)

    start = first_step(tools, n_x, way, ray, going)
    step = lax.while_loop(lambda step: _any(step.going), one_cell, start)
    return step.hit, step.entry


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


def _meet(tools: Tools, way: Way, ray: Ray, stay: Stay, step: Step) -> tuple[Float[Array, "n"], Int[Array, "n"]]:
    """Compare rays with the triangles of a list each; return the nearest distance, m, and its entry."""

    def one_triangle(i: Array, best: tuple[Array, Array]) -> tuple[Array, Array]:
        return meet_one(tools, way.first_vertex, ray, stay.first + i, i < stay.listed, *best)

    return lax.fori_loop(0, jnp.max(stay.listed), one_triangle, (step.hit, step.entry))


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


def _meet_boxes(
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
