"""The march by XLA: some hundred rays in step, where one that is done gives its place to the next.

All places cost as much as the one with most to do. So one loop takes each ray through the triangles of its cell and on
to its next cell, at its own pace. It stops once half of the rays are through their blocks: these enter their next
blocks, or new rays take their places.
"""

from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.lidar3d.march import (
    Rays,
    Stay,
    Step,
    Way,
    enter_block,
    enter_cell,
    first_step,
    leave_block,
    leave_cell,
    ray_in_cells,
)
from subterra_jax.lidar3d.meeting import Hits, Ray, Tools, meet_one

# Rays in step, and triangles that each meets in a round.
N_PLACES, _AT_ONCE = 256, 8

_Part = TypeVar("_Part")


class Places(NamedTuple):
    """Rays under way, one in each place.

    Attributes:
        which: Number of the ray; their count where the place is empty.
        rays: Rays, as `march` has them.
        way: Their ways through their blocks.
        step: Cells where they are.
        stay: Lists of these cells.
        compared: Entries of the list that the ray has been compared with.
    """

    which: Int[Array, "n"]
    rays: Rays
    way: Way
    step: Step
    stay: Stay
    compared: Int[Array, "n"]


def _choose(mask: Bool[Array, "n"], then: _Part, otherwise: _Part) -> _Part:
    return jax.tree.map(lambda a, b: jnp.where(mask, a, b), then, otherwise)


def march_in_relay(
    tools: Tools,
    n_x: int,
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    blocks: Int[Array, "n"],
    limits: Float[Array, "n"],
) -> Hits:
    """Find the first triangle that each ray meets within its limit, as `march`.

    Args:
        tools: Operations of XLA.
        n_x: Cells of a block along the axis.
        origins: Origins, tunnel frame, m.
        directions: Unit vectors, tunnel frame.
        blocks: Blocks around the origins.
        limits: Largest distances of interest, m.
    """
    n = len(blocks)
    size = min(n, N_PLACES)

    def read(which: Int[Array, "k"]) -> tuple[Any, Any, Array, Array]:
        row = jnp.minimum(which, n - 1)
        origin, direction = origins[row], directions[row]
        return tuple(origin.T), tuple(direction.T), blocks[row], limits[row]

    def serve(state: tuple[Hits, Array, Places]) -> tuple[Hits, Array, Places]:
        """Take rays that are through their blocks on, then all of them through cells."""
        found, following, places = state
        through = ~places.step.going
        limit = read(places.which)[3]
        met = Hits(places.way.begin + places.step.hit, places.step.entry, places.rays.block)
        rays = _choose(through, leave_block(places.rays, places.way, limit, met), places.rays)
        done = through & ~rays.going
        row = jnp.where(done, places.which, n)
        found = Hits(*(a.at[row].set(b, mode="drop") for a, b in zip(found, rays.hits, strict=True)))
        which = jnp.where(done, jnp.minimum(following + jnp.cumsum(done) - 1, n), places.which)
        origin, direction, block, limit = read(which)
        rays = _choose(done, _begin(block, (limit >= 0.0) & (which < n)), rays)
        entering = rays._replace(going=rays.going & through)
        # Barriers keep XLA from computing one thing again in each of the programs that it makes of a round.
        way = lax.optimization_barrier(enter_block(tools, origin, direction, limit, entering))
        way = lax.optimization_barrier(_choose(through, way, places.way))
        ray = ray_in_cells(tools, way)
        start = first_step(tools, n_x, way, ray, rays.going & (way.end >= 0.0))
        step = _choose(through, start, places.step)
        stay = _choose(through, enter_cell(tools, n_x, way, ray, step), places.stay)
        compared = jnp.where(through, 0, places.compared)
        enough = jnp.sum(which < n) // 2
        step, stay, compared = _cross_some(tools, n_x, way, ray, enough, (step, stay, compared))
        return found, following + jnp.sum(done), Places(which, rays, way, step, stay, compared)

    found = Hits(jnp.full(n, jnp.inf), jnp.full(n, -1), blocks)
    state = found, jnp.int32(0), _empty(tools, n_x, read, jnp.full(size, n))
    return lax.while_loop(lambda state: (state[1] < n) | jnp.any(state[2].which < n), serve, state)[0]


def _begin(block: Int[Array, "n"], going: Bool[Array, "n"]) -> Rays:
    nothing = jnp.full(block.shape, jnp.inf, jnp.float32)
    return Rays(block, jnp.zeros_like(nothing), Hits(nothing, jnp.full_like(block, -1), block), going)


def _empty(tools: Tools, n_x: int, read: Any, which: Int[Array, "n"]) -> Places:
    """Return places without rays."""
    origin, direction, block, limit = read(which)
    nobody = jnp.zeros(which.shape, bool)
    rays = _begin(block, nobody)
    way = enter_block(tools, origin, direction, limit, rays)
    ray = ray_in_cells(tools, way)
    step = first_step(tools, n_x, way, ray, nobody)
    return Places(which, rays, way, step, enter_cell(tools, n_x, way, ray, step), jnp.zeros_like(which))


def _cross_some(
    tools: Tools, n_x: int, way: Way, ray: Ray, enough: Int[Array, ""], state: tuple[Step, Stay, Array]
) -> tuple[Step, Stay, Array]:
    """Take rays from triangle to triangle and from cell to cell, until no more than enough are in their blocks."""

    def one_round(state: tuple[Step, Stay, Array]) -> tuple[Step, Stay, Array]:
        step, stay, compared = state
        step = lax.optimization_barrier(_meet_some(tools, way, ray, step, stay, compared))
        over = compared + _AT_ONCE >= stay.listed
        step = lax.optimization_barrier(_choose(over, leave_cell(way, ray, step, stay), step))
        stay = _choose(over, enter_cell(tools, n_x, way, ray, step), stay)
        return step, stay, jnp.where(over, 0, compared + _AT_ONCE)

    return lax.while_loop(lambda state: jnp.sum(state[0].going) > enough, one_round, state)


def _meet_some(tools: Tools, way: Way, ray: Ray, step: Step, stay: Stay, compared: Int[Array, "n"]) -> Step:
    """Compare rays with the next few triangles of their lists."""
    several = lambda part: jnp.repeat(part, _AT_ONCE)  # noqa: E731
    place = compared[:, None] + jnp.arange(_AT_ONCE)
    listed = (place < stay.listed[:, None]) & step.going[:, None]
    number = (stay.first[:, None] + place).ravel()
    rays = jax.tree.map(several, ray)
    nothing = jnp.full(number.shape, jnp.inf), jnp.full(number.shape, -1)
    hit, entry = meet_one(tools, several(way.first_vertex), rays, number, listed.ravel(), *nothing)
    hit, entry = hit.reshape(-1, _AT_ONCE), entry.reshape(-1, _AT_ONCE)
    nearest = jnp.min(hit, axis=1)
    first = jnp.max(jnp.where(hit == nearest[:, None], entry, -1), axis=1)
    nearer = nearest < step.hit
    return step._replace(hit=jnp.where(nearer, nearest, step.hit), entry=jnp.where(nearer, first, step.entry))
