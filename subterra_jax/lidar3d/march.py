"""Marches a ray through a relief: from block to block, from cell to cell, until it meets a triangle.

Written once, for many rays in step, over the few operations that differ: XLA marches some hundred of them, a fused
kernel as many as a warp has lanes. `native.marching` does the same for one ray after another on a CPU.
"""

from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.lidar3d.cells import FACES, MARGIN, N_WEDGES, N_X, NEAR_UNIT, X_BITS
from subterra_jax.lidar3d.meeting import FINE, Hits, Point, Ray, Tools, meet_boxes, meet_one
from subterra_jax.lidar3d.relief import N_FRAME, N_LINK

_TINY = 1e-12


class Rays(NamedTuple):
    """Rays on their way through blocks."""

    block: Int[Array, "n"]  # present block
    reached: Float[Array, "n"]  # distance at which the ray enters it, m
    hits: Hits  # first triangles met so far
    going: Bool[Array, "n"]  # the ray may still meet a nearer one


def march(tools: Tools, origin: Point, direction: Point, block: Int[Array, "n"], limit: Float[Array, "n"]) -> Hits:
    """Find the first triangle that each ray meets within its limit, m, from an origin (tunnel frame, m) in a block."""

    def one_block(rays: Rays) -> Rays:
        return _cross_block(tools, origin, direction, limit, rays)

    none = Hits(jnp.full_like(limit, jnp.inf), jnp.full_like(block, -1), block)
    start = Rays(block, jnp.zeros_like(limit), none, limit >= 0.0)
    return lax.while_loop(lambda rays: _any(rays.going), one_block, start).hits


def _any(mask: Bool[Array, "n"]) -> Bool[Array, ""]:
    return jnp.max(mask.astype(jnp.int32)) > 0


def _cross_block(tools: Tools, origin: Point, direction: Point, limit: Array, rays: Rays) -> Rays:
    """Take each ray that goes on through its block."""
    way = _enter_block(tools, origin, direction, limit, rays)
    found, entry = _cross_cells(tools, way, rays.going & (way.end >= 0.0))
    hits = _nearer(way.hits, Hits(way.begin + found, entry, rays.block))
    going = rays.going & (way.leave < jnp.minimum(limit, hits.distance)) & (way.following >= 0)
    following, reached = jnp.where(going, way.following, rays.block), jnp.where(going, way.leave, rays.reached)
    return Rays(following, reached, hits, going)


class Way(NamedTuple):
    """Ways of rays through one block each, in its frame; distances are from the rays' origins if not said otherwise."""

    at: tuple[Array, ...]  # points where the rays leave the empty prism, m
    d: tuple[Array, ...]  # unit vectors
    begin: Float[Array, "n"]  # distance to these points, m
    end: Float[Array, "n"]  # distance from there to where the ray leaves the block, or needs go no further, m
    leave: Float[Array, "n"]  # distance at which the ray leaves the block, m
    following: Int[Array, "n"]  # block behind or ahead that it enters then; -1 at a mouth
    hits: Hits  # first triangles or boxes met so far, those in earlier blocks and the boxes of this one
    low: Float[Array, "n"]  # coordinate along the axis at which the first cell begins, m
    per_cell: Float[Array, "n"]  # cells a metre
    along: Float[Array, "n"]  # units of a vertex along the axis, 1/m
    across: Float[Array, "n"]  # units of a vertex across the axis, 1/m
    first_vertex: Int[Array, "n"]  # first vertex of the block
    first_cell: Int[Array, "n"]  # first cell of the block


def _enter_block(tools: Tools, origin: Point, direction: Point, limit: Array, rays: Rays) -> Way:
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
    boxes = meet_boxes(tools, link(4), count, at, d)
    hits = _nearer(rays.hits, Hits(rays.reached + boxes[0], boxes[1], rays.block))
    leap = _leap(tools, frame, at, d)
    begin = jnp.minimum(rays.reached + leap, jnp.maximum(leave, rays.reached))
    at = [tools.fma(begin - rays.reached, d[i], at[i]) for i in range(3)]
    end = jnp.minimum(jnp.minimum(leave, limit), hits.distance) - begin
    low, per_cell, along, across = (frame(i) for i in range(20, 24))
    units = low, per_cell, along, across, link(2), link(3)
    return Way(tuple(at), tuple(d), begin, end, leave, following, hits, *units)


def _nearer(one: Hits, other: Hits) -> Hits:
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
    """Return the direction left and up at a fraction of 4 of a turn, as `cells.wedge_edge`."""
    return jnp.abs(turn - 2.0) - 1.0, jnp.abs(turn + jnp.where(turn < 1.0, 1.0, -3.0)) - 1.0


def wedge_at(tools: Tools, y: Float[Array, "n"], z: Float[Array, "n"]) -> Int[Array, "n"]:
    """Return the wedge in which points lie, as `cells.wedge_place`."""
    fraction = y * tools.reciprocal(jnp.maximum(jnp.abs(y) + jnp.abs(z), 1e-30))
    turn = jnp.where(z >= 0.0, 1.0 - fraction, 3.0 + fraction)
    return jnp.clip((turn * (N_WEDGES / 4)).astype(jnp.int32), 0, N_WEDGES - 1)


class Step(NamedTuple):
    """Rays on their way through the cells of a block; distances are from where they began there."""

    x: Int[Array, "n"]  # cell along the axis
    wedge: Int[Array, "n"]
    reached: Float[Array, "n"]  # distance at which the ray enters the cell, m
    hit: Float[Array, "n"]  # distance to the nearest triangle met so far, m
    entry: Int[Array, "n"]  # entry of that triangle
    going: Bool[Array, "n"]  # the ray may still meet one in this block


def _ray_in_cells(tools: Tools, way: Way) -> Ray:
    """Return what rays in their blocks need at every cell."""
    at, d, along, across = way.at, way.d, way.along, way.across * FINE
    # Vertices count from 0 along the axis.
    units = (tools.fma(at[0], along, 0.5 * (1 << X_BITS)), at[1] * across, at[2] * across)
    speeds = (d[0] * along, d[1] * across, d[2] * across)
    forward = jnp.where(d[0] > 0.0, 1, 0)
    onward = tools.minor(at[1], d[2], at[2], d[1]) > 0.0
    slope = tools.reciprocal(jnp.where(jnp.abs(d[0]) < 1e-9, 1e-9, d[0]) * way.per_cell)
    return Ray(units, speeds, (at[0] - way.low) * way.per_cell, slope, forward, onward)


def _cross_cell(tools: Tools, way: Way, ray: Ray, step: Step) -> Step:
    """Compare rays with the triangles of their cells, if they come near these, and take them to the next cells."""
    at, d = way.at, way.d
    edge = step.x + ray.forward
    # The outermost cells reach to infinity.
    leave_x = jnp.where((edge <= 0) | (edge >= N_X), jnp.inf, (edge.astype(jnp.float32) - ray.x) * ray.slope)
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
    listed = jnp.where(reaches, lax.shift_right_logical(word, 16), 0)

    def one_triangle(i: Array, best: tuple[Array, Array]) -> tuple[Array, Array]:
        return meet_one(tools, way.first_vertex, ray, first + i, i < listed, *best)

    hit, entry = lax.fori_loop(0, jnp.max(listed), one_triangle, (step.hit, step.entry))
    going, ends = step.going & (leave < way.end) & (hit > leave), leave_x <= leave_wedge
    x = step.x + jnp.where(ends & going, 2 * ray.forward - 1, 0)
    wedge = step.wedge + jnp.where(ends | ~going, 0, jnp.where(ray.onward, 1, -1))
    wedge = jnp.where(wedge == N_WEDGES, 0, jnp.where(wedge < 0, N_WEDGES - 1, wedge))
    return Step(x, wedge, jnp.where(going, leave, step.reached), hit, entry, going)


def _cross_cells(tools: Tools, way: Way, going: Bool[Array, "n"]) -> tuple[Float[Array, "n"], Int[Array, "n"]]:
    """Return the distance at which rays meet a triangle in their block, m, or `inf`, and its entry."""
    ray = _ray_in_cells(tools, way)
    first_x, nothing = jnp.clip(ray.x, 0.0, N_X - 1.0).astype(jnp.int32), jnp.full_like(way.end, jnp.inf)
    wedge = wedge_at(tools, way.at[1], way.at[2])
    start = Step(first_x, wedge, jnp.zeros_like(way.end), nothing, jnp.full_like(first_x, -1), going)
    one_cell = partial(_cross_cell, tools, way, ray)
    step = lax.while_loop(lambda step: _any(step.going), one_cell, start)
    return step.hit, step.entry
