"""The planar LiDAR and the clearance as kernels for NVIDIA GPUs: one thread serves one robot, in a warp of 32.

Blocks are visited in the order of `tunnel.order.Order`: from the robot's place on, and then back, each way until the
plane at a block tells that nothing behind it is nearer than what has been met. The threads of a warp do so in step, one
beam after another: nearly every beam enters one block, and all meet what is in theirs together.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.lidar.kernels import load_words, most, reciprocal
from subterra_jax.tunnel import CONTACT_REACH, Tunnel
from subterra_jax.tunnel.packed import BLOCK_WORDS, PAIR_WORDS, unpack

# Threads of one program.
ROWS = 32
# Beams that one thread casts, one after another: more of them read a robot less often, fewer fill the chip.
BEAMS = 8


def scan(
    tunnel: Tunnel,
    position: Float[Array, "n 2"],
    heading: Float[Array, " n"],
    start: Int[Array, " n"],
    needed: Bool[Array, " n"],
    range_max: Float[Array, ""],
    bearing: np.ndarray,
) -> Float[Array, "n n_beams"]:
    """True ranges of many scans in one tunnel.

    Args:
        tunnel: The tunnel, one for all.
        position: Positions of the LiDAR, tunnel frame, m.
        heading: Its headings, rad.
        start: First block that each scan visits.
        needed: Which scans to take; the others cost next to nothing, and hold anything.
        range_max: Largest range, m.
        bearing: Of each beam from the heading, rad.

    Returns:
        As `lidar.scan`.
    """
    n_beams, n_rows = len(bearing), _rows()
    count, rows = _pad_rows(n_rows, start, needed.astype(jnp.int32), *position.T, heading)
    n, n_some = len(rows[0]), max(k for k in range(1, BEAMS + 1) if n_beams % k == 0)
    turn = jnp.asarray(np.concatenate([np.cos(bearing), np.sin(bearing)]), jnp.float32)
    ranges = _call(
        partial(_scan_kernel, n_beams=n_beams, n_some=n_some, n_rows=n_rows),
        (n_beams // n_some, n // n_rows),
        n * n_beams,
    )(*rows, turn, jnp.asarray(range_max, jnp.float32).reshape(1), *_walls_of(tunnel))
    return ranges.reshape(n, n_beams)[:count]


def clearance(tunnel: Tunnel, position: Float[Array, "n 2"], start: Int[Array, " n"]) -> Float[Array, " n"]:
    """`unicycle.clearance` of many points in one tunnel, each with the first block that it visits."""
    n_rows = _rows()
    count, rows = _pad_rows(n_rows, start, *position.T)
    n = len(rows[0])
    gap = _call(partial(_gap_kernel, n_rows=n_rows), (n // n_rows,), n)(*rows, *_walls_of(tunnel))
    return gap[:count]


def _rows() -> int:
    """Threads of a program; more in Pallas' interpreter, which takes programs one after another."""
    return ROWS if jax.default_backend() == "gpu" else 16 * ROWS


def _pad_rows(n_rows: int, *rows: Array) -> tuple[int, list[Array]]:
    """Return the number of rows, and the rows padded to whole programs."""
    count = rows[0].shape[0]
    return count, [jnp.pad(row, (0, -count % n_rows), mode="edge") for row in rows]


def _walls_of(tunnel: Tunnel) -> tuple[Array, Array]:
    return tunnel.packed.block.reshape(-1), tunnel.packed.wall.reshape(-1)


def _call(kernel: Any, grid: tuple[int, ...], size: int) -> Any:
    """Return a kernel as a function of whole arrays; its result has a size."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    whole = pl.BlockSpec(memory_space=pl.ANY)

    def call(*arrays: Array) -> Array:
        return pl.pallas_call(
            kernel,
            grid=grid,
            in_specs=[whole] * len(arrays),
            out_specs=whole,
            out_shape=jax.ShapeDtypeStruct((size,), jnp.float32),
            compiler_params=triton.CompilerParams(num_warps=1, num_stages=1),
            interpret=jax.default_backend() != "gpu",
        )(*arrays)

    return call


def _march(way: int, start: Array, best: Array, look: Any, meet: Any) -> Array:
    """Visit blocks one way until nothing nearer can follow, and return the least distance.

    The threads of a warp go in step: those that have entered a block wait until all others have, or have ended, and
    then all meet what is in theirs.

    Args:
        way: 1 for ahead, -1 for behind.
        start: First block ahead, of each thread.
        best: Distance of what has been met, m.
        look: Tells of blocks, and of what has been met, whether the visits end there, and whether the block is entered.
        meet: Returns the distance of what is in blocks; looks at one pair of vertices alone where its mask is false.
    """

    def advance(carry: tuple[Array, Array, Array], best: Array) -> tuple[Array, Array, Array]:
        block, going, _ = carry
        block = block + way * going
        ends, enters = look(block, best)
        return block, (~(ends | enters)).astype(jnp.int32), (~ends).astype(jnp.int32)

    def one_round(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        block, open_, best = carry
        start = block, open_, open_
        block, _, open_ = lax.while_loop(lambda c: _any(c[1]), lambda c: advance(c, best), start)

        def met(best: Array) -> Array:
            return jnp.where(open_ > 0, jnp.minimum(best, meet(block, open_ > 0)), best)

        return block, open_, lax.cond(_any(open_), met, lambda best: best, best)

    before = start - 1 if way > 0 else start
    return lax.while_loop(lambda c: _any(c[1]), one_round, (before, jnp.ones_like(start), best))[2]


def _any(flags: Array) -> Array:
    """Tell whether a flag, 0 or 1, of any thread is set."""
    return jnp.sum(flags) > 0


def _scan_kernel(
    start_ref, needed_ref, x_ref, y_ref, heading_ref, turn_ref, limit_ref, block_ref, wall_ref, range_ref, *,
    n_beams: int, n_some: int, n_rows: int,
) -> None:  # fmt: skip
    """Cast some beams of each of many robots, one robot a thread, one beam after another."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    row = pl.program_id(1) * n_rows + lax.broadcasted_iota(jnp.int32, (n_rows,), 0)
    start, needed, x, y, heading = (
        triton.load(ref.at[row]) for ref in (start_ref, needed_ref, x_ref, y_ref, heading_ref)
    )
    # Of a tunnel's first two blocks, which are padding, nothing is seen.
    start = jnp.where(needed > 0, start, 1)
    cos, sin, first_beam = jnp.cos(heading), jnp.sin(heading), pl.program_id(0) * n_some
    limit = jnp.full((n_rows,), triton.load(limit_ref.at[jnp.int32(0)]))

    def cast(i: Array, _: None) -> None:
        beam = first_beam + i
        along, across = triton.load(turn_ref.at[beam]), triton.load(turn_ref.at[n_beams + beam])
        d_x, d_y = cos * along - sin * across, sin * along + cos * across

        def look(way: int, block: Array, best: Array) -> tuple[Array, Array]:
            m_x, m_y, e_x, e_y, thickness, _, n_x, n_y, *planes, _ = _block(block_ref, block)
            m_x, m_y = m_x - x, m_y - y
            gap = way * (n_x * m_x + n_y * m_y) + planes[0 if way > 0 else 1]
            ends = gap > jnp.maximum(best * (way * (n_x * d_x + n_y * d_y)), 0.0)
            beside = jnp.abs(d_x * m_y - d_y * m_x) - jnp.abs(d_x * e_y - d_y * e_x)
            along, half = d_x * m_x + d_y * m_y, jnp.abs(d_x * e_x + d_y * e_y) + thickness
            return ends, (beside <= thickness) & (along + half >= 0.0) & (along - half <= best)

        def meet(block: Array, entered: Array) -> Array:
            words = _block(block_ref, block)
            middle = words[0] - x, words[1] - y
            return _nearest(wall_ref, words[10], jnp.where(entered, words[5], 1), middle, (d_x, d_y))

        best = limit
        for way in (1, -1):
            best = _march(way, start, best, partial(look, way), meet)
        triton.store(range_ref.at[row * n_beams + beam], best)

    lax.fori_loop(0, jnp.max(needed) * n_some, cast, None)


def _block(block_ref, number):
    """Return the numbers of each thread's block, see `packed.unpack`, and its first vertex pair."""
    one, two = load_words(block_ref, BLOCK_WORDS * number), load_words(block_ref, BLOCK_WORDS * number + 4)
    return *unpack((*one, *two[:2])), two[2]


def _nearest(wall_ref, first_pair, pairs, middle, direction):
    """Return the distance at which each beam meets a block, m; `inf` if it does not.

    `planar._distances` has the geometry.
    """
    d_x, d_y = direction
    middle_left, middle_ahead = d_x * middle[1] - d_y * middle[0], d_x * middle[0] + d_y * middle[1]
    joint = 2e-7 * (1.0 + jnp.abs(middle_ahead))

    def seen(x, y):
        return middle_left + (d_x * y - d_y * x), middle_ahead + (d_x * x + d_y * y)

    def segment(start, end, nearest):
        (a, a_ahead), (b, b_ahead) = start, end
        meets = (jnp.minimum(a, b) <= joint) & (jnp.maximum(a, b) >= -joint)
        fraction = jnp.clip(a * reciprocal(jnp.where(a == b, 1.0, a - b)), 0.0, 1.0)
        distance = a_ahead + fraction * (b_ahead - a_ahead)
        return jnp.where(meets & (distance >= 0.0), jnp.minimum(nearest, distance), nearest)

    def two_segments(i, carry):
        nearest, last = carry
        # Behind its last pair a block's last two segments are met again.
        corners = load_words(wall_ref, PAIR_WORDS * (first_pair + jnp.minimum(i, pairs - 1)))
        one, two = seen(*corners[:2]), seen(*corners[2:])
        return segment(one, two, segment(last, one, nearest)), two

    corners = load_words(wall_ref, PAIR_WORDS * first_pair)
    one, two = seen(*corners[:2]), seen(*corners[2:])
    nearest = segment(one, two, jnp.full_like(d_x, jnp.inf))
    return lax.fori_loop(1, most(pairs), two_segments, (nearest, two))[0]


def _gap_kernel(start_ref, x_ref, y_ref, block_ref, wall_ref, gap_ref, *, n_rows: int) -> None:
    """Measure the distance from each of many points to the nearest segment, at most `CONTACT_REACH`."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    row = pl.program_id(0) * n_rows + lax.broadcasted_iota(jnp.int32, (n_rows,), 0)
    start, x, y = (triton.load(ref.at[row]) for ref in (start_ref, x_ref, y_ref))

    def look(way: int, block: Array, best: Array) -> tuple[Array, Array]:
        m_x, m_y, e_x, e_y, thickness, _, n_x, n_y, *planes, _ = _block(block_ref, block)
        m_x, m_y = m_x - x, m_y - y
        gap = way * (n_x * m_x + n_y * m_y) + planes[0 if way > 0 else 1]
        squared = e_x * e_x + e_y * e_y
        # Not the best so far: from within a pocket its wall is nearer than the box, whose lid closes it.
        near = CONTACT_REACH + thickness + 1e-3
        length = jnp.sqrt(squared)
        beside = jnp.abs(m_x * e_y - m_y * e_x) <= near * length + 1e-6
        # A packed axis is turned a little, and the box is longer by its half thickness at most.
        along = jnp.abs(m_x * e_x + m_y * e_y) <= (length + near) * length + 1e-6
        return (gap > 0.0) & (gap * gap > best), beside & along & (thickness >= 0.0)

    def meet(block: Array, entered: Array) -> Array:
        words = _block(block_ref, block)
        return _least_square(wall_ref, words[10], jnp.where(entered, words[5], 1), (words[0] - x, words[1] - y))

    best = reach = jnp.full((n_rows,), CONTACT_REACH * CONTACT_REACH, jnp.float32)
    for way in (1, -1):
        best = _march(way, start, best, partial(look, way), meet)
    triton.store(gap_ref.at[row], jnp.where(best < reach, jnp.sqrt(best), CONTACT_REACH))


def _least_square(wall_ref, first_pair, pairs, middle):
    """Return the square of the distance from each point to a block's nearest segment, m²."""

    def vertices(i):
        corners = load_words(wall_ref, PAIR_WORDS * (first_pair + i))
        return tuple((middle[0] + corners[k], middle[1] + corners[k + 1]) for k in (0, 2))

    def two_segments(i, carry):
        least, last = carry
        one, two = vertices(jnp.minimum(i, pairs - 1))
        return jnp.minimum(jnp.minimum(least, _squared(last, one)), _squared(one, two)), two

    one, two = vertices(jnp.zeros_like(pairs))
    return lax.fori_loop(1, most(pairs), two_segments, (_squared(one, two), two))[0]


def _squared(start, end):
    """Return the square of the distance from the origin to a segment, m²; that to its start if both ends are one."""
    (x, y), (edge_x, edge_y) = start, (end[0] - start[0], end[1] - start[1])
    size = edge_x * edge_x + edge_y * edge_y
    fraction = jnp.clip(-(x * edge_x + y * edge_y) / jnp.where(size > 0.0, size, 1.0), 0.0, 1.0)
    near_x, near_y = x + fraction * edge_x, y + fraction * edge_y
    return near_x * near_x + near_y * near_y
