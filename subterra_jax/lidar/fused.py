"""The LiDAR as two fused kernels for NVIDIA GPUs.

The same boxes and the same segments as in `cast`, with nothing written to memory in between but a few block numbers a
beam: for 65,536 environments XLA moves about a gigabyte a step where this moves 25 MB. `cast` stays the reference, and
is what runs everywhere else.

Robots in different tunnels read different blocks, which a chip's cache does not hold, so time goes by waiting for
memory. A few neighbouring threads therefore serve one robot, and read its boxes and vertices side by side; each robot
reads those that it needs and no further ones; see `tunnel.packed`.
"""

from __future__ import annotations

import itertools
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.lidar.cast import NOTHING
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.packed import (
    ALL_PAIRS,
    ALL_WINDOW,
    WORDS,
    all_if_full,
    load_words,
    packed_blocks,
    store_words,
    unpack,
)

# Scans of one program: one warp of 32 threads, so that a program in which nobody looks on is short.
_ROWS = 4
# Threads of one scan.
_LANES = 8
# Lines whose nearest boxes fit into one thread's registers.
_MOST_LINES = 8
# Half thickness of a box that no beam enters, m.
_NONE = -1e30


def supported(n_beams: int) -> bool:
    """Tell whether the kernels can run: on an NVIDIA GPU, with an even number of beams (opposite ones share a line)."""
    return n_beams % 2 == 0 and jax.default_backend() == "gpu" and "nvidia" in jax.devices()[0].device_kind.lower()


def scan(
    tunnel: Tunnel,
    position: Float[Array, "n 2"],
    heading: Float[Array, " n"],
    first: Int[Array, " n"],
    wanted: Bool[Array, " n"],
    range_max: Float[Array, ""],
    bearing: np.ndarray,
) -> Float[Array, "n n_beams"]:
    """True ranges of many scans in one tunnel.

    Args:
        tunnel: The tunnel, one for all.
        position: Positions of the LiDAR, tunnel frame, m.
        heading: Its headings, rad.
        first: First block of each window.
        wanted: Which scans to take. Where none of 4 neighbours is wanted they cost next to nothing, and hold anything.
        range_max: Largest range, m.
        bearing: Of each beam from the heading, rad; the second half opposes the first.

    Returns:
        As `lidar.scan`.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    interpret = jax.default_backend() != "gpu"
    n_rows = 8 * _ROWS if interpret else _ROWS  # the interpreter takes programs one after another
    count, n_beams, n_best = position.shape[0], len(bearing), tunnel.n_candidates
    rows = [
        jnp.pad(row, (0, -count % n_rows), mode="edge")
        for row in (first, wanted.astype(jnp.int32), *position.T, heading)
    ]
    n, n_lines = rows[0].shape[0], n_beams // 2
    width = max(w for w in range(1, _MOST_LINES + 1) if n_lines % w == 0)
    turn = jnp.asarray(np.concatenate([np.cos(bearing), np.sin(bearing)]), jnp.float32)
    packed = packed_blocks(tunnel)
    box, walls = packed.box.reshape(-1), (jnp.asarray(packed.start), packed.wall.reshape(-1))
    beams = _Beams(n, n_beams, n_best, tunnel.n_scan, tunnel.box.shape[1], (tunnel.wall.shape[2] + 1) // 2, n_rows)
    whole = pl.BlockSpec(memory_space=pl.ANY)
    call = partial(
        pl.pallas_call,
        out_specs=whole,
        compiler_params=triton.CompilerParams(num_warps=1, num_stages=1),
        interpret=interpret,
    )
    key = call(
        partial(_boxes_kernel, beams=beams, width=width),
        grid=(n // n_rows, n_lines // width),
        in_specs=[whole] * 7,
        out_shape=jax.ShapeDtypeStruct((n * n_beams * beams.n_words,), jnp.int32),
    )(*rows, turn, box)
    ranges = call(
        partial(_hits_kernel, beams=beams),
        grid=(n // n_rows,),
        in_specs=[whole] * 11,
        out_shape=jax.ShapeDtypeStruct((n_beams * n,), jnp.float32),
    )(key, *rows, turn, jnp.asarray(range_max, jnp.float32).reshape(1), box, *walls)
    return ranges.reshape(n_beams, n)[:, :count].T


class _Beams(NamedTuple):
    """Sizes of the arrays that both kernels read.

    Attributes:
        n_all: Scans.
        n: Beams of a scan.
        n_best: Boxes of a beam that are sorted by where it enters them.
        n_scan: Blocks in the largest window.
        n_blocks: All blocks.
        n_pairs: Most vertex pairs of a block.
        n_rows: Scans of one program.
    """

    n_all: int
    n: int
    n_best: int
    n_scan: int
    n_blocks: int
    n_pairs: int
    n_rows: int

    @property
    def n_words(self) -> int:
        """Words of the keys of a beam, as many as are read at once or a multiple of them."""
        return -(-self.n_best // WORDS) * WORDS

    @property
    def number_bits(self) -> int:
        """Bits that the number of a block within its window takes."""
        return (self.n_scan - 1).bit_length()

    def entry(self, key):
        """Return the distance at which a box is entered, m, of its key."""
        return lax.bitcast_convert_type(key & jnp.int32(-(1 << self.number_bits)), jnp.float32)

    def key(self, entry, number):
        """Return the distance at which a box is entered and its number in one sortable integer."""
        return lax.bitcast_convert_type(entry, jnp.int32) & jnp.int32(-(1 << self.number_bits)) | number


def length_of(x, y):
    """Return the lengths of vectors, good to 1e-6."""
    squared = x * x + y * y
    return squared * lax.rsqrt(squared + 1e-20)


def _rows_of(refs, index):
    """Return the entries of several arrays at each thread's row."""
    from jax.experimental.pallas import triton

    return tuple(triton.load(ref.at[index]) for ref in refs)


def _direction(turn_ref, beam, n_beams: int, cos, sin):
    """Unit vectors of a beam in many scans, from the table of bearings and the headings."""
    from jax.experimental.pallas import triton

    along, across = triton.load(turn_ref.at[beam]), triton.load(turn_ref.at[n_beams + beam])
    return cos * along - sin * across, sin * along + cos * across


def _boxes_kernel(
    first_ref, wanted_ref, x_ref, y_ref, heading_ref, turn_ref, box_ref, key_ref, *, beams: _Beams, width: int
):
    """The first boxes along `width` lines, ahead and behind: entry distance and number in one integer, nearest first.

    Each thread has every eighth box of its scan, and keeps the nearest of those; the threads of a scan then compare.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    shape = beams.n_rows, _LANES
    row = pl.program_id(0) * beams.n_rows + lax.broadcasted_iota(jnp.int32, shape, 0)
    lane, line = lax.broadcasted_iota(jnp.int32, shape, 1), pl.program_id(1) * width

    @pl.when(_any(triton.load(wanted_ref.at[row]) > 0))
    def look() -> None:
        first, x, y, heading = _rows_of((first_ref, x_ref, y_ref, heading_ref), row)
        cos, sin = jnp.cos(heading), jnp.sin(heading)
        lines = [_direction(turn_ref, line + j, beams.n, cos, sin) for j in range(width)]
        window = all_if_full(unpack(load_words(box_ref, WORDS * first))[-1], ALL_WINDOW, beams.n_scan)

        def load(number):
            return load_words(box_ref, WORDS * (first + number), number < window)

        def one_box(i, carry):
            best, words = carry
            number = lane + i * _LANES
            following = load(number + _LANES)  # while this one is worked on
            keys = _entries(beams, unpack(words), number, number < window, x, y, lines)
            return tuple(_inserted(*pair) for pair in zip(best, keys, strict=True)), following

        nothing = tuple(jnp.full(shape, NOTHING) for _ in range(_kept(beams.n_best)))
        n_rounds = (jnp.max(window) + _LANES - 1) // _LANES
        best, _ = lax.fori_loop(0, n_rounds, one_box, ((nothing,) * (2 * width), load(lane)))
        for sense in range(2):
            first_boxes = [_first_of_all(kept, beams.n_best) for kept in best[sense::2]]
            beam = sense * (beams.n // 2) + line + lane
            _write_keys(key_ref, (row * beams.n + beam) * beams.n_words, first_boxes, lane)


def _entries(beams: _Beams, box, number, there, x, y, lines):
    """Keys of a box of each thread, ahead along each line and behind; `cast._entries` has the geometry."""
    m_x, m_y, e_x, e_y, thickness, _, _ = box
    thickness = jnp.where(there, thickness, _NONE)
    length = length_of(e_x, e_y)
    m_x, m_y = m_x - x, m_y - y
    turn = m_x * e_y - m_y * e_x
    e_x, e_y = jnp.where(turn < 0.0, -e_x, e_x), jnp.where(turn < 0.0, -e_y, e_y)
    to_face = jnp.abs(turn) - thickness * length
    between, to_face = to_face <= 0.0, jnp.maximum(to_face, 0.0)
    keys = []
    for d_x, d_y in lines:
        facing = d_x * e_y - d_y * e_x
        size = jnp.abs(facing)
        crosses = jnp.abs(d_x * m_y - d_y * m_x) <= size + thickness
        # A reciprocal from the special function unit, good to 1e-6: less than the bits that the number takes.
        root = lax.rsqrt(size + 1e-20)
        key = jnp.where(crosses, beams.key(to_face * root * root, number), NOTHING)
        keys += [jnp.where(ahead | between, key, NOTHING) for ahead in (facing > 0.0, facing < 0.0)]
    return keys


def _write_keys(key_ref, start, first_boxes, lane) -> None:
    """Write down the first boxes of some lines, each thread those of one line."""
    n_best = len(first_boxes[0])
    for begin in range(0, n_best, WORDS):
        words = []
        for k in range(begin, min(begin + WORDS, n_best)):
            own = jnp.zeros_like(lane)
            for j, boxes in enumerate(first_boxes):
                own = jnp.where(lane == j, boxes[k], own)
            words.append(own)
        store_words(key_ref, start + begin, words, lane < len(first_boxes))


def _kept(n_best: int) -> int:
    """Boxes that each thread keeps of a beam: a few, since neighbours in the tunnel are other threads'."""
    return min(n_best, 2 if n_best <= 3 else 3)


def _inserted(best, key):
    """The smallest keys, in order, with one more considered."""
    kept = []
    for old in best:
        kept.append(jnp.minimum(old, key))
        key = jnp.maximum(old, key)
    return tuple(kept)


def _first_of_all(kept, n_best: int):
    """Return the smallest keys of all threads of each scan, in order.

    A thread that has given all that it kept may have had more behind the last: it gives its last again and again, so
    that nothing behind that is taken for known.
    """
    smallest = []
    for _ in range(n_best):
        smallest.append(jnp.min(kept[0], axis=1, keepdims=True))
        given = kept[0] == smallest[-1]
        kept = (*(jnp.where(given, after, one) for one, after in itertools.pairwise(kept)), kept[-1])
    return smallest


def _hits_kernel(
    key_ref, first_ref, wanted_ref, x_ref, y_ref, heading_ref, turn_ref, limit_ref, box_ref, start_ref, wall_ref,
    range_ref, *, beams: _Beams,
):  # fmt: skip
    """The nearest segment along each beam of many scans, in the blocks whose boxes it enters before that segment."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    shape = beams.n_rows, _LANES
    row = pl.program_id(0) * beams.n_rows + lax.broadcasted_iota(jnp.int32, shape, 0)
    lane = lax.broadcasted_iota(jnp.int32, shape, 1)
    wanted = triton.load(wanted_ref.at[row]) > 0

    @pl.when(_any(wanted))
    def look() -> None:
        first, x, y, heading = _rows_of((first_ref, x_ref, y_ref, heading_ref), row)
        cos, sin = jnp.cos(heading), jnp.sin(heading)
        limit = jnp.full(shape, triton.load(limit_ref.at[jnp.int32(0)]))

        def one_beam(beam, _):
            direction = _direction(turn_ref, beam, beams.n, cos, sin)
            look_into = partial(_look_into, box_ref, start_ref, wall_ref, beams.n_pairs, x, y, direction)
            start = (row * beams.n + beam) * beams.n_words
            keys = [key for i in range(0, beams.n_words, WORDS) for key in load_words(key_ref, start + i)]

            def enters(key, nearest):
                # A box that is entered behind the hit holds no nearer one.
                return wanted & (key != NOTHING) & (beams.entry(key) <= nearest)

            def look_from(k: int, there, nearest):
                """The nearest hit in a beam's boxes from the k-th on, where it enters that."""
                if k == beams.n_best:
                    return _look_everywhere(
                        box_ref, look_into, beams.n_scan, first, there, x, y, direction, lane, nearest
                    )
                block = jnp.minimum(first + (keys[k] & jnp.int32((1 << beams.number_bits) - 1)), beams.n_blocks - 1)
                nearest = _least(look_into(block, there, nearest, lane, _LANES))
                further = enters(keys[min(k + 1, beams.n_best - 1)], nearest)
                return lax.cond(_any(further), partial(look_from, k + 1, further, nearest), lambda: nearest)

            nearest = look_from(0, enters(keys[0], limit), limit)
            triton.store(range_ref.at[beam * beams.n_all + row], nearest)  # all threads of a beam know it
            return 0

        lax.fori_loop(0, beams.n, one_beam, 0)


def _any(what):
    """Tell whether anything holds in any thread."""
    return jnp.max(what.astype(jnp.int32)) > 0


def _least(distance):
    """Return the least distance among the threads of a beam, to all of them."""
    # As integers: a minimum of floats must look out for NaN.
    least = jnp.min(lax.bitcast_convert_type(distance, jnp.int32), axis=1, keepdims=True)
    return lax.bitcast_convert_type(jnp.broadcast_to(least, distance.shape), jnp.float32)


def _look_into(box_ref, start_ref, wall_ref, n_pairs: int, x, y, direction, block, open_, nearest, lane, stride: int):
    """The distance to the nearest segment of a block along beams where `open_`, if less than `nearest`.

    Each thread meets a vertex pair and the vertex behind it, then the pair `stride` pairs on. `cast.hits` has the
    geometry.
    """
    from jax.experimental.pallas import triton

    d_x, d_y = direction
    first_pair = triton.load(start_ref.at[block], mask=open_, other=0)
    m_x, m_y, _, _, _, pairs, _ = unpack(load_words(box_ref, WORDS * block, open_))
    m_x, m_y = m_x - x, m_y - y
    pairs = jnp.where(open_, all_if_full(pairs, ALL_PAIRS, n_pairs), 0)
    middle_left, middle_ahead = d_x * m_y - d_y * m_x, d_x * m_x + d_y * m_y
    joint = 2e-7 * (1.0 + jnp.abs(middle_ahead))

    def seen(x, y):
        return middle_left + (d_x * y - d_y * x), middle_ahead + (d_x * x + d_y * y)

    def segment(start, end, nearest, there):
        (a, a_ahead), (b, b_ahead) = start, end
        meets = (jnp.minimum(a, b) <= joint) & (jnp.maximum(a, b) >= -joint)
        share = jnp.clip(a / jnp.where(a == b, 1.0, a - b), 0.0, 1.0)
        distance = a_ahead + share * (b_ahead - a_ahead)
        hit = there & meets & (distance >= 0.0)
        return jnp.where(hit, jnp.minimum(nearest, distance), nearest)

    def two_segments(i, nearest):
        pair = lane + i * stride
        there, goes_on = pair < pairs, pair + 1 < pairs
        start = WORDS * (first_pair + pair)
        numbers = load_words(wall_ref, start, there)
        behind = load_words(wall_ref, start + WORDS, goes_on, 2)
        one, other = seen(*numbers[:2]), seen(*numbers[2:])
        return segment(other, seen(*behind), segment(one, other, nearest, there), goes_on)

    return lax.fori_loop(0, (jnp.max(pairs) + stride - 1) // stride, two_segments, nearest)


def _look_everywhere(box_ref, look_into, n_scan: int, first, unsure, x, y, direction, lane, nearest):
    """Return the nearest hit in any block of the window whose box is entered, for beams that are `unsure`.

    They enter as many boxes as were kept, and meet no wall before the last of them, as beside a row of deep recesses.
    Each thread has every eighth box.
    """
    d_x, d_y = direction
    window = all_if_full(unpack(load_words(box_ref, WORDS * first, unsure))[-1], ALL_WINDOW, n_scan)
    window = jnp.where(unsure, window, 0)

    def look(i, nearest):
        number = lane + i * _LANES
        block, there = first + number, number < window
        m_x, m_y, e_x, e_y, thickness, _, _ = unpack(load_words(box_ref, WORDS * block, there))
        m_x, m_y = m_x - x, m_y - y
        to_face = jnp.maximum(jnp.abs(m_x * e_y - m_y * e_x) - thickness * length_of(e_x, e_y), 0.0)
        size = jnp.abs(d_x * e_y - d_y * e_x)
        # Entered a little early rather than a little late.
        open_ = there & (jnp.abs(d_x * m_y - d_y * m_x) <= size + thickness)
        open_ = open_ & (to_face * (1.0 - 1e-5) <= nearest * size + 1e-6)
        alone = partial(look_into, block, open_, nearest, jnp.zeros_like(lane), 1)
        return lax.cond(_any(open_), alone, lambda: nearest)

    return _least(lax.fori_loop(0, (jnp.max(window) + _LANES - 1) // _LANES, look, nearest))
