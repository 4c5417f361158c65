"""The first of the two kernels of `fused`: the boxes around blocks of wall that each beam enters first.

Each of eight neighbouring threads has every eighth box of a robot's window.
"""

import itertools
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from subterra_jax.lidar.cast import NOTHING
from subterra_jax.lidar.nvidia import any_thread, load_words, most, store_words
from subterra_jax.tunnel.packed import ALL_WINDOW, WORDS, all_if_full, unpack

# Scans of one program: one warp of 32 threads, so that a program in which nobody looks on is short.
ROWS = 4
# Threads of one scan.
LANES = 8
# Lines whose nearest boxes fit into one thread's registers.
MOST_LINES = 8
# Half thickness of a box that no beam enters, m.
_NONE = -1e30


class Beams(NamedTuple):
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


def rows_of(refs, index):
    """Return the entries of several arrays at each thread's row."""
    from jax.experimental.pallas import triton

    return tuple(triton.load(ref.at[index]) for ref in refs)


def direction_of(turn_ref, beam, n_beams: int, cos, sin):
    """Unit vectors of a beam in many scans, from the table of bearings and the headings."""
    from jax.experimental.pallas import triton

    along, across = triton.load(turn_ref.at[beam]), triton.load(turn_ref.at[n_beams + beam])
    return cos * along - sin * across, sin * along + cos * across


def boxes_kernel(
    first_ref, wanted_ref, x_ref, y_ref, heading_ref, turn_ref, box_ref, key_ref, *, beams: Beams, width: int
):
    """The first boxes along `width` lines, ahead and behind: entry distance and number in one integer, nearest first.

    Each thread has every eighth box of its scan, and keeps the nearest of those; the threads of a scan then compare.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    shape = beams.n_rows, LANES
    row = pl.program_id(0) * beams.n_rows + lax.broadcasted_iota(jnp.int32, shape, 0)
    lane, line = lax.broadcasted_iota(jnp.int32, shape, 1), pl.program_id(1) * width

    @pl.when(any_thread(triton.load(wanted_ref.at[row]) > 0))
    def look() -> None:
        first, x, y, heading = rows_of((first_ref, x_ref, y_ref, heading_ref), row)
        cos, sin = jnp.cos(heading), jnp.sin(heading)
        lines = [direction_of(turn_ref, line + j, beams.n, cos, sin) for j in range(width)]
        window = all_if_full(unpack(load_words(box_ref, WORDS * first))[-1], ALL_WINDOW, beams.n_scan)

        def one_box(number, words, best):
            keys = _entries(beams, unpack(words), number, number < window, x, y, lines)
            return tuple(_inserted(*pair) for pair in zip(best, keys, strict=True))

        nothing = tuple(jnp.full(shape, NOTHING) for _ in range(_kept(beams.n_best)))
        n_rounds = (most(window) + LANES - 1) // LANES
        best = over_boxes(box_ref, first, window, n_rounds, lane, one_box, (nothing,) * (2 * width))
        for sense in range(2):
            first_boxes = [_first_of_all(kept, beams.n_best) for kept in best[sense::2]]
            beam = sense * (beams.n // 2) + line + lane
            _write_keys(key_ref, (row * beams.n + beam) * beams.n_words, first_boxes, lane)


def over_boxes(box_ref, first, window, n_rounds, lane, one_box, start):
    """Return what comes of all boxes of a window; each thread has every eighth of them.

    Args:
        box_ref: Words of the boxes.
        first: First block of each thread's window.
        window: Blocks of the window.
        n_rounds: Rounds of a box a thread that the longest window takes.
        lane: First box of each thread.
        one_box: What a box makes of its number, its words (zeros beyond the window) and what came of those before it.
        start: What is there before the first.
    """

    def load(number):
        return load_words(box_ref, WORDS * (first + number), number < window)

    def one_round(i, carry):
        found, words = carry
        number = lane + i * LANES
        following = load(number + LANES)  # while this one is worked on
        return one_box(number, words, found), following

    return lax.fori_loop(0, n_rounds, one_round, (start, load(lane)))[0]


def _entries(beams: Beams, box, number, there, x, y, lines):
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
