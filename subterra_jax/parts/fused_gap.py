"""Distances from robots to the nearest wall as one fused kernel for NVIDIA GPUs.

XLA reads every vertex of a window, with padding, for each robot. Here eight neighbouring threads look at a robot's
boxes side by side, and read the vertices of those blocks alone whose boxes lie within reach: most robots have none.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from subterra_jax.lidar.boxes import LANES, ROWS, length_of, over_boxes
from subterra_jax.lidar.cast import NOTHING
from subterra_jax.lidar.hits import Walls
from subterra_jax.lidar.nvidia import any_thread, load_words, most
from subterra_jax.tunnel import CONTACT_REACH, Tunnel
from subterra_jax.tunnel.packed import WORDS, packed_blocks, unpack

# Distance from a box up to which its walls are looked at, m: the reach, and more than rounding.
_NEAR = CONTACT_REACH + 1e-3


def clearance(tunnel: Tunnel, position: Float[Array, "n 2"], first: Int[Array, " n"]) -> Float[Array, " n"]:
    """Distances from many points in one tunnel to its nearest wall or furniture.

    Args:
        tunnel: The tunnel, one for all.
        position: The points, tunnel frame, m.
        first: First block of each contact window.

    Returns:
        As `unicycle.clearance`.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    interpret = jax.default_backend() != "gpu"
    n_rows = 8 * ROWS if interpret else ROWS  # the interpreter takes programs one after another
    count, packed = position.shape[0], packed_blocks(tunnel)
    more = -count % n_rows
    first, position = jnp.pad(first, (0, more), mode="edge"), jnp.pad(position, ((0, more), (0, 0)), mode="edge")
    whole = pl.BlockSpec(memory_space=pl.ANY)
    gap = pl.pallas_call(
        partial(gap_kernel, n_contact=tunnel.n_contact, n_pairs=(tunnel.wall.shape[2] + 1) // 2, n_rows=n_rows),
        grid=(len(first) // n_rows,),
        in_specs=[whole] * 5,
        out_specs=whole,
        out_shape=jax.ShapeDtypeStruct(first.shape, jnp.float32),
        compiler_params=triton.CompilerParams(num_warps=1, num_stages=1),
        interpret=interpret,
    )(first, position.reshape(-1), packed.box.reshape(-1), jnp.asarray(packed.start), packed.wall.reshape(-1))
    return gap[:count]


def gap_kernel(
    first_ref, position_ref, box_ref, start_ref, wall_ref, gap_ref, *, n_contact: int, n_pairs: int, n_rows: int
):
    """The distance from each of many points to the nearest segment, at most `CONTACT_REACH`.

    Each thread has every eighth box of its point's window; the walls in those that are near are looked at together.

    Args:
        first_ref: First block of each window, `(n,)`.
        position_ref: Points x, y, m, `(2 n,)`.
        box_ref: Words of the boxes, `(4 n_blocks,)`.
        start_ref: First vertex pair of each block, `(n_blocks,)`.
        wall_ref: Vertex pairs, m, `(4 n_pairs_of_all,)`.
        gap_ref: Output, distances, m, `(n,)`.
        n_contact: Blocks in a window.
        n_pairs: Most vertex pairs of a block.
        n_rows: Points of one program.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    shape = n_rows, LANES
    row = pl.program_id(0) * n_rows + lax.broadcasted_iota(jnp.int32, shape, 0)
    lane = lax.broadcasted_iota(jnp.int32, shape, 1)
    first = triton.load(first_ref.at[row])
    x, y = load_words(position_ref, 2 * row, n_words=2)
    walls = Walls(box_ref, start_ref, wall_ref, n_pairs, x, y)

    def one_box(number, words, squared):
        near = (number < n_contact) & _is_near(words, x, y)
        look = partial(_look, walls, first, number, near, lane, squared)
        return lax.cond(any_thread(near), look, lambda: squared)

    n_rounds = -(-n_contact // LANES)
    squared = over_boxes(box_ref, first, n_contact, n_rounds, lane, one_box, jnp.full(shape, jnp.inf, jnp.float32))
    gap = jnp.minimum(jnp.sqrt(jnp.min(squared, axis=1, keepdims=True)), CONTACT_REACH)
    triton.store(gap_ref.at[row], jnp.broadcast_to(gap, shape))


def _is_near(words, x, y):
    """Tell whether a box of each thread lies within reach of its point; a little too often, never too seldom."""
    m_x, m_y, e_x, e_y, thickness, _, _ = unpack(words)
    m_x, m_y, length = m_x - x, m_y - y, length_of(e_x, e_y)
    beside = jnp.abs(m_x * e_y - m_y * e_x) <= (thickness + _NEAR) * length + 1e-6
    # A packed axis is turned a little, and the box is longer by its half thickness at most.
    ahead = jnp.abs(m_x * e_x + m_y * e_y) <= (length + thickness + _NEAR) * length + 1e-6
    return (thickness >= 0.0) & beside & ahead  # that of padding is negative


def _look(walls: Walls, first, number, near, lane, squared):
    """Return the least squares of the distances that each thread met, in the near blocks of its point too, m².

    Args:
        walls: The walls, as seen from the points.
        first: First block of each window.
        number: Block of the window whose box each thread has.
        near: Whether that box is near.
        lane: Thread of the point.
        squared: Least squares so far, m².
    """

    def after(last):
        """Return the near block of each point that comes after one."""
        least = jnp.min(jnp.where(near & (number > last), number, NOTHING), axis=1, keepdims=True)
        return jnp.broadcast_to(least, number.shape)

    def one_block(_, carry):
        squared, current = carry
        there = current != NOTHING
        block = walls.block(first + jnp.where(there, current, 0), there)
        return _measure(walls, block, lane, squared), after(current)

    rounds = most(jnp.sum(near, axis=1, dtype=jnp.int32))
    return lax.fori_loop(0, rounds, one_block, (squared, after(-1)))[0]


def _measure(walls: Walls, block, lane, squared):
    """Return the least squares of the distances that each thread met, in its point's block too, m².

    The threads of a point have neighbouring vertex pairs of the block, each with the vertex behind it.
    """
    (m_x, m_y, *_), pairs = unpack(block[:WORDS]), walls.pairs(block)
    m_x, m_y = m_x - walls.x, m_y - walls.y

    def two_segments(i, squared):
        pair = lane + i * LANES
        corners = walls.corners(block, pair)
        one, other, behind = ((m_x + corners[k], m_y + corners[k + 1]) for k in (0, 2, 4))
        squared = jnp.where(pair < pairs, jnp.minimum(squared, _squared(one, other)), squared)
        return jnp.where(pair + 1 < pairs, jnp.minimum(squared, _squared(other, behind)), squared)

    return lax.fori_loop(0, (most(pairs) + LANES - 1) // LANES, two_segments, squared)


def _squared(start, end):
    """Return the square of the distance from the origin to a segment, m²; that to its start if both ends are one."""
    (x, y), (edge_x, edge_y) = start, (end[0] - start[0], end[1] - start[1])
    size = edge_x * edge_x + edge_y * edge_y
    share = jnp.clip(-(x * edge_x + y * edge_y) / jnp.where(size > 0.0, size, 1.0), 0.0, 1.0)
    near_x, near_y = x + share * edge_x, y + share * edge_y
    return near_x * near_x + near_y * near_y
