"""The planar LiDAR and the clearance as kernels for NVIDIA GPUs: one thread serves one robot, in a warp of 32.

Blocks are visited in the order of `tunnel.order.Order`: from the robot's place on, and then back, each way until the
plane at a block tells that nothing behind it is nearer than what has been met. Threads that have entered a block wait
until some others have too, and then all meet their segments together.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

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
# Beams that one thread casts, one after another: more of them even out long and short beams, fewer fill the chip.
BEAMS = 8
# Threads of 32 that may still be on their way when the others meet their segments.
UNDER_WAY = 12
# States of a thread.
_VISITS, _ENTERED, _ENDED, _IDLE = 0, 1, 2, 3


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


class _Visit(NamedTuple):
    """Place of a thread on its way."""

    block: Array  # block that it visits
    way: Array  # 1.0 ahead, -1.0 behind
    state: Array  # what it does
    best: Array  # distance of what it has met, m; its square for clearances, m²

    def onward(self, start: Array, enters: Array, ends: Array) -> _Visit:
        """Return the next visit, from the first block ahead, and whether nothing more is to be found this way."""
        visits = self.state == _VISITS
        back = visits & ends & (self.way > 0.0)
        following = self.block + self.way.astype(jnp.int32)
        block = jnp.where(back, start - 1, jnp.where(visits & ~enters & ~ends, following, self.block))
        state = jnp.where(ends & ~back, _ENDED, jnp.where(enters & ~ends, _ENTERED, _VISITS))
        return self._replace(
            block=block, way=jnp.where(back, -1.0, self.way), state=jnp.where(visits, state, self.state)
        )

    def left(self, best: Array) -> _Visit:
        """Return the visit after those that have entered their block have met what is in it."""
        entered = self.state == _ENTERED
        return self._replace(
            block=self.block + jnp.where(entered, self.way.astype(jnp.int32), 0),
            state=jnp.where(entered, _VISITS, self.state),
            best=jnp.where(entered, jnp.minimum(self.best, best), self.best),
        )


class _Beam(NamedTuple):
    """The beams that threads cast."""

    number: Array  # of each thread's beam
    d_x: Array  # its direction
    d_y: Array  # the other coordinate


def _scan_kernel(
    start_ref, needed_ref, x_ref, y_ref, heading_ref, turn_ref, limit_ref, block_ref, wall_ref, range_ref, *,
    n_beams: int, n_some: int, n_rows: int,
) -> None:  # fmt: skip
    """Cast some beams of each of many robots, each thread those of one robot in its own time."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    row = pl.program_id(1) * n_rows + lax.broadcasted_iota(jnp.int32, (n_rows,), 0)
    first_beam = pl.program_id(0) * n_some
    start, needed, x, y, heading = (
        triton.load(ref.at[row]) for ref in (start_ref, needed_ref, x_ref, y_ref, heading_ref)
    )
    cos, sin, limit = jnp.cos(heading), jnp.sin(heading), jnp.full((n_rows,), triton.load(limit_ref.at[jnp.int32(0)]))

    def aim(number) -> _Beam:
        along, across = triton.load(turn_ref.at[number]), triton.load(turn_ref.at[n_beams + number])
        return _Beam(number, cos * along - sin * across, sin * along + cos * across)

    def advance(beam: _Beam, visit: _Visit) -> _Visit:
        m_x, m_y, e_x, e_y, thickness, _, n_x, n_y, ahead, behind, _ = _block(block_ref, visit.block)
        m_x, m_y, n_x, n_y = m_x - x, m_y - y, n_x * visit.way, n_y * visit.way
        gap = n_x * m_x + n_y * m_y + jnp.where(visit.way > 0.0, ahead, behind)
        ends = gap > jnp.maximum(visit.best * (n_x * beam.d_x + n_y * beam.d_y), 0.0)
        beside = jnp.abs(beam.d_x * m_y - beam.d_y * m_x) - jnp.abs(beam.d_x * e_y - beam.d_y * e_x)
        along, half = beam.d_x * m_x + beam.d_y * m_y, jnp.abs(beam.d_x * e_x + beam.d_y * e_y) + thickness
        enters = (beside <= thickness) & (along + half >= 0.0) & (along - half <= visit.best)
        return visit.onward(start, enters, ends)

    def meet(beam: _Beam, visit: _Visit) -> _Visit:
        words = _block(block_ref, visit.block)
        middle, pairs = (words[0] - x, words[1] - y), jnp.where(visit.state == _ENTERED, words[5], 1)
        return visit.left(_nearest(wall_ref, words[10], pairs, middle, beam))

    def one_round(carry: tuple[_Beam, _Visit]) -> tuple[_Beam, _Visit]:
        beam, visit = carry
        few = (n_rows - _count(visit.state, _IDLE)) * UNDER_WAY // ROWS
        visit = lax.while_loop(lambda v: _count(v.state, _VISITS) > few, partial(advance, beam), visit)
        visit = lax.cond(_count(visit.state, _ENTERED) > 0, partial(meet, beam), lambda v: v, visit)
        ended = visit.state == _ENDED
        triton.store(range_ref.at[row * n_beams + beam.number], visit.best, mask=ended)
        last = beam.number == first_beam + n_some - 1
        beam = aim(jnp.where(ended & ~last, beam.number + 1, beam.number))
        state = jnp.where(ended, jnp.where(last, _IDLE, _VISITS), visit.state)
        begins = ended & ~last
        return beam, _Visit(
            jnp.where(begins, start, visit.block),
            jnp.where(begins, 1.0, visit.way),
            state,
            jnp.where(begins, limit, visit.best),
        )

    begin = _Visit(start, jnp.ones_like(x), jnp.where(needed > 0, _VISITS, _IDLE), limit)
    beam = aim(jnp.full((n_rows,), first_beam, jnp.int32))
    lax.while_loop(lambda carry: _count(carry[1].state, _IDLE) < n_rows, one_round, (beam, begin))


def _count(state, what: int):
    return jnp.sum((state == what).astype(jnp.int32))


def _block(block_ref, number):
    """Return the numbers of each thread's block, see `packed.unpack`, and its first vertex pair."""
    one, two = load_words(block_ref, BLOCK_WORDS * number), load_words(block_ref, BLOCK_WORDS * number + 4)
    return *unpack((*one, *two[:2])), two[2]


def _nearest(wall_ref, first_pair, pairs, middle, beam: _Beam):
    """Return the distance at which each beam meets a block, m; `inf` if it does not.

    `cast._distances` has the geometry.
    """
    d_x, d_y = beam.d_x, beam.d_y
    middle_left, middle_ahead = d_x * middle[1] - d_y * middle[0], d_x * middle[0] + d_y * middle[1]
    joint = 2e-7 * (1.0 + jnp.abs(middle_ahead))

    def seen(x, y):
        return middle_left + (d_x * y - d_y * x), middle_ahead + (d_x * x + d_y * y)

    def segment(start, end, nearest):
        (a, a_ahead), (b, b_ahead) = start, end
        meets = (jnp.minimum(a, b) <= joint) & (jnp.maximum(a, b) >= -joint)
        share = jnp.clip(a * reciprocal(jnp.where(a == b, 1.0, a - b)), 0.0, 1.0)
        distance = a_ahead + share * (b_ahead - a_ahead)
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

    def advance(visit: _Visit) -> _Visit:
        m_x, m_y, e_x, e_y, thickness, _, n_x, n_y, ahead, behind, _ = _block(block_ref, visit.block)
        m_x, m_y = m_x - x, m_y - y
        gap = (n_x * m_x + n_y * m_y) * visit.way + jnp.where(visit.way > 0.0, ahead, behind)
        ends = (gap > 0.0) & (gap * gap > visit.best)
        squared = e_x * e_x + e_y * e_y
        # Not the best so far: from within a pocket its wall is nearer than the box, whose lid closes it.
        near = CONTACT_REACH + thickness + 1e-3
        length = jnp.sqrt(squared)
        beside = jnp.abs(m_x * e_y - m_y * e_x) <= near * length + 1e-6
        # A packed axis is turned a little, and the box is longer by its half thickness at most.
        along = jnp.abs(m_x * e_x + m_y * e_y) <= (length + near) * length + 1e-6
        return visit.onward(start, beside & along & (thickness >= 0.0), ends)

    def meet(visit: _Visit) -> _Visit:
        words = _block(block_ref, visit.block)
        middle, pairs = (words[0] - x, words[1] - y), jnp.where(visit.state == _ENTERED, words[5], 1)
        return visit.left(_least_square(wall_ref, words[10], pairs, middle))

    def one_round(visit: _Visit) -> _Visit:
        visit = lax.while_loop(lambda v: _count(v.state, _VISITS) > 0, advance, visit)
        return lax.cond(_count(visit.state, _ENTERED) > 0, meet, lambda v: v, visit)

    reach = jnp.full((n_rows,), CONTACT_REACH * CONTACT_REACH, jnp.float32)
    begin = _Visit(start, jnp.ones_like(x), jnp.full((n_rows,), _VISITS, jnp.int32), reach)
    visit = lax.while_loop(lambda v: _count(v.state, _ENDED) < n_rows, one_round, begin)
    triton.store(gap_ref.at[row], jnp.where(visit.best < reach, jnp.sqrt(visit.best), CONTACT_REACH))


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
    share = jnp.clip(-(x * edge_x + y * edge_y) / jnp.where(size > 0.0, size, 1.0), 0.0, 1.0)
    near_x, near_y = x + share * edge_x, y + share * edge_y
    return near_x * near_x + near_y * near_y
