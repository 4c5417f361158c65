"""The LiDAR as two fused kernels for NVIDIA GPUs.

The same boxes and the same segments as in `cast`, with nothing written to memory in between but a few block numbers a
beam: for 65,536 environments XLA moves about a gigabyte a step where this moves 25 MB. `cast` stays the reference, and
is what runs everywhere else.

Robots in different tunnels read different blocks, so a box is 16 bytes, read by one instruction, and each robot reads
the boxes and the vertices that it needs and no further ones; see `tunnel.packed`.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.lidar.cast import NOTHING
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.packed import ALL_PAIRS, ALL_WINDOW, WINDOW_BITS, WORDS, Packed, high, low, pack

# Environments of one program: one warp, one environment a thread, so that a program in which nobody looks on is short.
_ROWS = 32
# Lines whose nearest boxes fit into one thread's registers.
_MOST_LINES = 8
# Beams of one program, one after the other.
_MOST_BEAMS = 2
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
        wanted: Which scans to take. Where none of 32 neighbours is wanted they cost next to nothing, and hold anything.
        range_max: Largest range, m.
        bearing: Of each beam from the heading, rad; the second half opposes the first.

    Returns:
        As `lidar.scan`.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    count, n_beams, k = position.shape[0], len(bearing), tunnel.n_candidates
    rows = [
        jnp.pad(row, (0, -count % _ROWS), mode="edge")
        for row in (first, wanted.astype(jnp.int32), *position.T, heading)
    ]
    n, n_lines = rows[0].shape[0], n_beams // 2
    width = max(w for w in range(1, _MOST_LINES + 1) if n_lines % w == 0)
    group = max(w for w in range(1, _MOST_BEAMS + 1) if n_beams % w == 0)
    turn = jnp.asarray(np.concatenate([np.cos(bearing), np.sin(bearing)]), jnp.float32)
    packed = packed_blocks(tunnel)
    box, wall = packed.box.reshape(-1), packed.wall.reshape(-1)
    row, of_second = pl.BlockSpec((_ROWS,), lambda i, _: (i,)), pl.BlockSpec((_ROWS,), lambda _, i: (i,))
    whole = pl.BlockSpec(memory_space=pl.ANY)
    warp = triton.CompilerParams(num_warps=1, num_stages=1)
    key = pl.pallas_call(
        partial(_boxes_kernel, tunnel=tunnel, n_beams=n_beams, width=width),
        grid=(n // _ROWS, n_lines // width),
        in_specs=[row] * 5 + [whole] * 2,
        out_specs=pl.BlockSpec((k, n_beams, _ROWS), lambda i, _: (0, 0, i)),
        out_shape=jax.ShapeDtypeStruct((k, n_beams, n), jnp.int32),
        compiler_params=warp,
        interpret=jax.default_backend() != "gpu",
    )(*rows, turn, box)
    ranges = pl.pallas_call(
        partial(_hits_kernel, tunnel=tunnel, n_numbers=packed.wall.shape[1], n_beams=n_beams, width=group),
        # Beams of the same scans one after another: they meet the same few blocks.
        grid=(n_beams // group, n // _ROWS),
        in_specs=[pl.BlockSpec((k, group, _ROWS), lambda j, i: (0, j, i))] + [of_second] * 5 + [whole] * 4,
        out_specs=pl.BlockSpec((group, _ROWS), lambda j, i: (j, i)),
        out_shape=jax.ShapeDtypeStruct((n_beams, n), jnp.float32),
        compiler_params=warp,
        interpret=jax.default_backend() != "gpu",
    )(key, *rows, turn, jnp.asarray(range_max, jnp.float32).reshape(1), box, wall)
    return ranges[:, :count].T


def packed_blocks(tunnel: Tunnel) -> Packed:
    """Return the packed blocks of a tunnel; made of its boxes and walls where it has none."""
    if tunnel.packed is not None:
        return tunnel.packed
    everything = jnp.full(tunnel.box.shape[1], tunnel.n_scan)
    return pack(tunnel.box, tunnel.wall, jnp.full_like(everything, tunnel.wall.shape[2]), everything)


def load_words(ref, start, mask=None):
    """Return four words of each of many rows, read by one instruction; 0 where masked.

    Args:
        ref: Flat array of words.
        start: First word of each row, a multiple of 4.
        mask: Rows to read; `None` for all.
    """
    from jax.experimental.pallas import triton

    column = lax.broadcasted_iota(jnp.int32, (*start.shape, WORDS), start.ndim)
    # Triton takes no `other` without a mask.
    masked: dict[str, Any] = (
        {} if mask is None else {"mask": jnp.broadcast_to(mask[..., None], column.shape), "other": 0}
    )
    words = triton.load(ref.at[start[..., None] + column], **masked)
    return tuple(jnp.sum(jnp.where(column == i, words, jnp.zeros_like(words)), axis=-1) for i in range(WORDS))


def unpack(words):
    """Return the middle x, y, half axis x, y, half thickness (m), vertex pairs and window of boxes; see `Packed`."""
    x, y = (lax.bitcast_convert_type(word, jnp.float32) for word in words[:2])
    pairs, window = (words[3] >> WINDOW_BITS) & ALL_PAIRS, words[3] & ALL_WINDOW
    return x, y, high(words[2]), low(words[2]), high(words[3]), pairs, window


def all_if_full(count, full: int, everything: int):
    """Return a count of which the largest number stands for everything."""
    return jnp.where(count == full, jnp.int32(everything), count)


def length_of(x, y):
    """Return the lengths of vectors, good to 1e-6."""
    squared = x * x + y * y
    return squared * lax.rsqrt(squared + 1e-20)


def _number_bits(tunnel: Tunnel) -> int:
    """Bits that the number of a block within its window takes."""
    return (tunnel.n_scan - 1).bit_length()


def _direction(turn_ref, beam, n_beams: int, cos, sin):
    """Unit vectors of one beam in many scans, from the table of bearings and the headings."""
    from jax.experimental.pallas import triton

    along, across = triton.load(turn_ref.at[beam]), triton.load(turn_ref.at[n_beams + beam])
    return cos * along - sin * across, sin * along + cos * across


def _boxes_kernel(
    first_ref,
    wanted_ref,
    x_ref,
    y_ref,
    heading_ref,
    turn_ref,
    box_ref,
    key_ref,
    *,
    tunnel: Tunnel,
    n_beams: int,
    width: int,
):
    """The first boxes along `width` lines, ahead and behind: entry distance and number in one integer, nearest first.

    `cast._entries` has the geometry.
    """
    from jax.experimental import pallas as pl

    line = pl.program_id(1) * width

    @pl.when(jnp.max(wanted_ref[...]) > 0)
    def look() -> None:
        n_best, n_bits = tunnel.n_candidates, _number_bits(tunnel)
        first, x, y, heading = first_ref[...], x_ref[...], y_ref[...], heading_ref[...]
        cos, sin = jnp.cos(heading), jnp.sin(heading)
        lines = [_direction(turn_ref, line + j, n_beams, cos, sin) for j in range(width)]

        def load(number):
            return load_words(box_ref, WORDS * (first + number), number < window)

        def meet(number, carry):
            best, words = carry
            following = load(number + 1)  # while this one is worked on
            m_x, m_y, e_x, e_y, thickness, _, _ = unpack(words)
            thickness = jnp.where(number < window, thickness, _NONE)
            length = length_of(e_x, e_y)
            m_x, m_y = m_x - x, m_y - y
            turn = m_x * e_y - m_y * e_x
            e_x, e_y = jnp.where(turn < 0.0, -e_x, e_x), jnp.where(turn < 0.0, -e_y, e_y)
            to_face = jnp.abs(turn) - thickness * length
            between, to_face = to_face <= 0.0, jnp.maximum(to_face, 0.0)
            merged = []
            for d_x, d_y in lines:
                facing = d_x * e_y - d_y * e_x
                size = jnp.abs(facing)
                crosses = jnp.abs(d_x * m_y - d_y * m_x) <= size + thickness
                # A reciprocal from the special function unit, good to 1e-6: less than the bits that the number takes.
                root = lax.rsqrt(size + 1e-20)
                key = lax.bitcast_convert_type(to_face * root * root, jnp.int32) & jnp.int32(-(1 << n_bits)) | number
                key = jnp.where(crosses, key, NOTHING)
                for ahead in (facing > 0.0, facing < 0.0):
                    merged.append(jnp.where(ahead | between, key, NOTHING))
            return tuple(_inserted(best[i], merged[i]) for i in range(2 * width)), following

        nothing = tuple(jnp.full(first.shape, NOTHING) for _ in range(n_best))
        begin = load_words(box_ref, WORDS * first)
        window = all_if_full(unpack(begin)[-1], ALL_WINDOW, tunnel.n_scan)
        best, _ = lax.fori_loop(0, jnp.max(window), meet, ((nothing,) * (2 * width), begin))
        for j in range(width):
            for k in range(n_best):
                key_ref[k, line + j, :] = best[2 * j][k]
                key_ref[k, n_beams // 2 + line + j, :] = best[2 * j + 1][k]


def _inserted(best, key):
    """The smallest keys, in order, with one more considered."""
    kept = []
    for old in best:
        kept.append(jnp.minimum(old, key))
        key = jnp.maximum(old, key)
    return tuple(kept)


def _hits_kernel(
    key_ref, first_ref, wanted_ref, x_ref, y_ref, heading_ref, turn_ref, limit_ref, box_ref, wall_ref, range_ref,
    *, tunnel: Tunnel, n_numbers: int, n_beams: int, width: int,
):  # fmt: skip
    """The nearest segment along one beam of many scans, in the blocks whose boxes it enters before that segment."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    first_beam = pl.program_id(0) * width

    @pl.when(jnp.max(wanted_ref[...]) > 0)
    def look() -> None:
        n_blocks, n_bits = tunnel.box.shape[1], _number_bits(tunnel)
        first, x, y, heading = first_ref[...], x_ref[...], y_ref[...], heading_ref[...]
        cos, sin = jnp.cos(heading), jnp.sin(heading)
        wanted = wanted_ref[...] > 0

        def beam(j, _):
            direction = _direction(turn_ref, first_beam + j, n_beams, cos, sin)
            look_into = partial(_look_into, box_ref, wall_ref, n_numbers, x, y, direction)
            nearest = jnp.full(first.shape, triton.load(limit_ref.at[jnp.int32(0)]))
            for k in range(tunnel.n_candidates):
                key = key_ref[k, j, :]
                entry = lax.bitcast_convert_type(key & jnp.int32(-(1 << n_bits)), jnp.float32)
                # A box that is entered behind the hit holds no nearer one.
                open_ = wanted & (key != NOTHING) & (entry <= nearest)
                block = jnp.minimum(first + (key & jnp.int32((1 << n_bits) - 1)), n_blocks - 1)
                nearest = look_into(block, open_, nearest)
            unsure = wanted & (key != NOTHING) & (entry <= nearest)
            range_ref[j, :] = _look_everywhere(
                box_ref, look_into, tunnel.n_scan, first, unsure, x, y, direction, nearest
            )
            return 0

        lax.fori_loop(0, width, beam, 0)


def _look_into(box_ref, wall_ref, n_numbers: int, x, y, direction, block, open_, nearest):
    """The distance to the nearest segment of a block along beams where `open_`, if less than `nearest`.

    `cast.hits` has the geometry.
    """
    d_x, d_y = direction
    m_x, m_y, _, _, _, pairs, _ = unpack(load_words(box_ref, WORDS * block, open_))
    m_x, m_y = m_x - x, m_y - y
    pairs = jnp.where(open_, all_if_full(pairs, ALL_PAIRS, n_numbers // WORDS), 0)
    middle_left, middle_ahead = d_x * m_y - d_y * m_x, d_x * m_x + d_y * m_y
    joint = 2e-7 * (1.0 + jnp.abs(middle_ahead))

    def vertices(pair):
        numbers = load_words(wall_ref, block * n_numbers + WORDS * pair, pair < pairs)
        for x, y in (numbers[:2], numbers[2:]):
            yield middle_left + (d_x * y - d_y * x), middle_ahead + (d_x * x + d_y * y)

    def segment(start, end, nearest, there):
        (a, a_ahead), (b, b_ahead) = start, end
        meets = (jnp.minimum(a, b) <= joint) & (jnp.maximum(a, b) >= -joint)
        share = jnp.clip(a / jnp.where(a == b, 1.0, a - b), 0.0, 1.0)
        distance = a_ahead + share * (b_ahead - a_ahead)
        hit = there & meets & (distance >= 0.0)
        return jnp.where(hit, jnp.minimum(nearest, distance), nearest)

    def two_segments(pair, carry):
        before, nearest = carry
        one, other = vertices(pair)
        there = pair < pairs
        return other, segment(one, other, segment(before, one, nearest, there), there)

    one, other = vertices(jnp.int32(0))
    return lax.fori_loop(1, jnp.max(pairs), two_segments, (other, segment(one, other, nearest, pairs > 0)))[1]


def _look_everywhere(box_ref, look_into, n_scan: int, first, unsure, x, y, direction, nearest):
    """Return the nearest hit in any block of the window whose box is entered, for beams that are `unsure`.

    They enter as many boxes as were kept, and meet no wall before the last of them, as beside a row of deep recesses.
    """
    d_x, d_y = direction
    window = all_if_full(unpack(load_words(box_ref, WORDS * first, unsure))[-1], ALL_WINDOW, n_scan)
    window = jnp.where(unsure, window, 0)

    def look(number, nearest):
        block, there = first + number, number < window
        m_x, m_y, e_x, e_y, thickness, _, _ = unpack(load_words(box_ref, WORDS * block, there))
        m_x, m_y = m_x - x, m_y - y
        to_face = jnp.maximum(jnp.abs(m_x * e_y - m_y * e_x) - thickness * length_of(e_x, e_y), 0.0)
        size = jnp.abs(d_x * e_y - d_y * e_x)
        # Entered a little early rather than a little late.
        open_ = there & (jnp.abs(d_x * m_y - d_y * m_x) <= size + thickness)
        open_ = open_ & (to_face * (1.0 - 1e-5) <= nearest * size + 1e-6)
        return lax.cond(jnp.max(open_.astype(jnp.int32)) > 0, lambda: look_into(block, open_, nearest), lambda: nearest)

    return lax.fori_loop(0, jnp.max(window), look, nearest)
