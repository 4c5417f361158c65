"""The second of the two kernels of `fused`: the nearest segment along each beam, in the blocks whose boxes it enters.

Eight neighbouring threads serve one beam, and read the vertices of a block side by side.
"""

from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax

from subterra_jax.lidar.boxes import LANES, Beams, direction_of, length_of, rows_of
from subterra_jax.lidar.cast import NOTHING
from subterra_jax.lidar.nvidia import any_thread, load_words, most, reciprocal
from subterra_jax.tunnel.packed import ALL_PAIRS, ALL_WINDOW, WORDS, all_if_full, counts, unpack


def hits_kernel(
    key_ref, first_ref, wanted_ref, x_ref, y_ref, heading_ref, turn_ref, limit_ref, box_ref, start_ref, wall_ref,
    range_ref, *, beams: Beams,
):  # fmt: skip
    """The nearest segment along each beam of many scans, in the blocks whose boxes it enters before that segment.

    A beam takes three reads one after another: its keys, its first block, that block's vertices. While one beam is
    worked on, the vertices of the next, the block of the one behind it and the keys of the third are on their way.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    shape = beams.n_rows, LANES
    row = pl.program_id(0) * beams.n_rows + lax.broadcasted_iota(jnp.int32, shape, 0)
    lane = lax.broadcasted_iota(jnp.int32, shape, 1)
    wanted = triton.load(wanted_ref.at[row]) > 0

    @pl.when(any_thread(wanted))
    def look() -> None:
        first, x, y, heading = rows_of((first_ref, x_ref, y_ref, heading_ref), row)
        cos, sin = jnp.cos(heading), jnp.sin(heading)
        limit = jnp.full(shape, triton.load(limit_ref.at[jnp.int32(0)]))
        boxes = _Entered(beams, key_ref, row, first, wanted)
        walls = Walls(box_ref, start_ref, wall_ref, beams.n_pairs, x, y)

        def first_block(keys):
            return walls.block(boxes.block(keys[0]), boxes.enters(keys[0], limit))

        def one_beam(beam, ahead):
            (keys, block, corners), (keys_1, block_1), keys_2 = ahead
            ahead = (keys_1, block_1, walls.corners(block_1, lane)), (keys_2, first_block(keys_2)), boxes.keys(beam + 3)
            direction = direction_of(turn_ref, beam, beams.n, cos, sin)

            def look_from(k: int, there, nearest):
                """Return the nearest hit in the boxes from the k-th on, where the beam enters that."""
                if k == beams.n_best:
                    return _look_everywhere(walls, beams.n_scan, first, there, direction, lane, nearest)
                block = walls.block(boxes.block(keys[k]), there)
                return look_on(k, walls.nearest(block, direction, nearest, lane, LANES))

            def look_on(k: int, distance):
                """Return the nearest hit, also of the boxes behind the k-th, after what the threads found."""
                nearest = _least(distance)
                further = boxes.enters(keys[min(k + 1, beams.n_best - 1)], nearest)
                return lax.cond(any_thread(further), partial(look_from, k + 1, further, nearest), lambda: nearest)

            nearest = look_on(0, walls.nearest(block, direction, limit, lane, LANES, corners))
            triton.store(range_ref.at[beam * beams.n_all + row], nearest)  # all threads of a beam know it
            return ahead

        keys, keys_1, keys_2 = (boxes.keys(jnp.int32(beam)) for beam in range(3))
        block, block_1 = first_block(keys), first_block(keys_1)
        lax.fori_loop(0, beams.n, one_beam, ((keys, block, walls.corners(block, lane)), (keys_1, block_1), keys_2))


class _Entered(NamedTuple):
    """The first boxes along the beams of some scans, as `boxes_kernel` wrote them down.

    Attributes:
        beams: Sizes of the arrays.
        key_ref: Keys of all beams.
        row: Scan of each thread.
        first: First block of its window.
        wanted: Whether anybody wants it.
    """

    beams: Beams
    key_ref: Any
    row: Any
    first: Any
    wanted: Any

    def keys(self, beam):
        """Return the keys of a beam, nearest first; behind the last beam those of the last."""
        beams = self.beams
        start = (self.row * beams.n + jnp.minimum(beam, beams.n - 1)) * beams.n_words
        return tuple(key for i in range(0, beams.n_words, WORDS) for key in load_words(self.key_ref, start + i))

    def block(self, key):
        """Return the block whose box it is."""
        number = key & jnp.int32((1 << self.beams.number_bits) - 1)
        return jnp.minimum(self.first + number, self.beams.n_blocks - 1)

    def enters(self, key, nearest):
        """Tell whether a beam enters the box before its nearest hit; behind that it holds no nearer one."""
        return self.wanted & (key != NOTHING) & (self.beams.entry(key) <= nearest)


class Walls(NamedTuple):
    """The blocks of wall, as each thread sees them from its robot.

    Attributes:
        box_ref: Words of the boxes.
        start_ref: First vertex pair of each block.
        wall_ref: Vertex pairs.
        n_pairs: Most vertex pairs of a block.
        x: Position of the robots, m.
        y: The other coordinate, m.
    """

    box_ref: Any
    start_ref: Any
    wall_ref: Any
    n_pairs: int
    x: Any
    y: Any

    def block(self, number, open_):
        """Return the words of each thread's box and the first vertex pair of its block; zeros where not `open_`.

        They stay as they were read: to work with them here would be to wait for them.
        """
        from jax.experimental.pallas import triton

        first_pair = triton.load(self.start_ref.at[number], mask=open_, other=0)
        return *load_words(self.box_ref, WORDS * number, open_), first_pair

    def corners(self, block, pair):
        """Return a vertex pair of each thread's block and the vertex behind it, from the middle of the block, m."""
        pairs, start = self.pairs(block), WORDS * (block[WORDS] + pair)
        behind = load_words(self.wall_ref, start + WORDS, pair + 1 < pairs, 2)
        return load_words(self.wall_ref, start, pair < pairs) + behind

    def nearest(self, block, direction, nearest, lane, stride: int, corners=None):
        """Return the distance to the nearest segment of each thread's block along its beam, if less than `nearest`.

        Each thread meets a vertex pair and the vertex behind it, then the pair `stride` pairs on. `cast.hits` has the
        geometry.

        Args:
            block: What `block` returned.
            direction: Directions of the beams.
            nearest: Distance of what each thread has met, m.
            lane: First pair of each thread.
            stride: Pairs from one to the next of a thread.
            corners: The first ones, if they have been read.
        """
        (m_x, m_y, *_), pairs, (d_x, d_y) = unpack(block[:WORDS]), self.pairs(block), direction
        m_x, m_y = m_x - self.x, m_y - self.y
        middle_left, middle_ahead = d_x * m_y - d_y * m_x, d_x * m_x + d_y * m_y
        joint = 2e-7 * (1.0 + jnp.abs(middle_ahead))

        def seen(x, y):
            return middle_left + (d_x * y - d_y * x), middle_ahead + (d_x * x + d_y * y)

        def segment(start, end, nearest, there):
            (a, a_ahead), (b, b_ahead) = start, end
            meets = (jnp.minimum(a, b) <= joint) & (jnp.maximum(a, b) >= -joint)
            share = jnp.clip(a * reciprocal(jnp.where(a == b, 1.0, a - b)), 0.0, 1.0)
            distance = a_ahead + share * (b_ahead - a_ahead)
            hit = there & meets & (distance >= 0.0)
            return jnp.where(hit, jnp.minimum(nearest, distance), nearest)

        def two_segments(pair, corners, nearest):
            one, other, behind = (seen(*corners[i : i + 2]) for i in (0, 2, 4))
            nearest = segment(one, other, nearest, pair < pairs)
            return segment(other, behind, nearest, pair + 1 < pairs)

        def later(i, nearest):
            pair = lane + i * stride
            return two_segments(pair, self.corners(block, pair), nearest)

        if corners is None:
            corners = self.corners(block, lane)
        rounds = (most(pairs) + stride - 1) // stride
        return lax.fori_loop(1, rounds, later, two_segments(lane, corners, nearest))

    def pairs(self, block):
        """Return the vertex pairs of each thread's block; none where it was not read."""
        pairs = all_if_full(counts(block[WORDS - 1])[0], ALL_PAIRS, self.n_pairs)
        return jnp.where(block[WORDS - 1] == 0, 0, pairs)


def _look_everywhere(walls: Walls, n_scan: int, first, unsure, direction, lane, nearest):
    """Return the nearest hit in any block of the window whose box is entered, for beams that are `unsure`.

    They enter as many boxes as were kept, and meet no wall before the last of them, as beside a row of deep recesses.
    Each thread has every eighth box.
    """
    d_x, d_y = direction
    box_ref, x, y = walls.box_ref, walls.x, walls.y
    window = all_if_full(unpack(load_words(box_ref, WORDS * first, unsure))[-1], ALL_WINDOW, n_scan)
    window = jnp.where(unsure, window, 0)

    def look(i, nearest):
        number = lane + i * LANES
        block, there = first + number, number < window
        m_x, m_y, e_x, e_y, thickness, _, _ = unpack(load_words(box_ref, WORDS * block, there))
        m_x, m_y = m_x - x, m_y - y
        to_face = jnp.maximum(jnp.abs(m_x * e_y - m_y * e_x) - thickness * length_of(e_x, e_y), 0.0)
        size = jnp.abs(d_x * e_y - d_y * e_x)
        # Entered a little early rather than a little late.
        open_ = there & (jnp.abs(d_x * m_y - d_y * m_x) <= size + thickness)
        open_ = open_ & (to_face * (1.0 - 1e-5) <= nearest * size + 1e-6)

        def alone():
            return walls.nearest(walls.block(block, open_), direction, nearest, jnp.zeros_like(lane), 1)

        return lax.cond(any_thread(open_), alone, lambda: nearest)

    return _least(lax.fori_loop(0, (most(window) + LANES - 1) // LANES, look, nearest))


def _least(distance):
    """Return the least distance among the threads of a beam, to all of them."""
    # As integers: a minimum of floats must look out for NaN.
    least = jnp.min(lax.bitcast_convert_type(distance, jnp.int32), axis=1, keepdims=True)
    return lax.bitcast_convert_type(jnp.broadcast_to(least, distance.shape), jnp.float32)
