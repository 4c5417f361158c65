"""The LiDAR as two fused kernels for NVIDIA GPUs.

The same boxes and the same segments as in `cast`, with nothing written to memory in between but a few block numbers a
beam: for 65,536 environments XLA moves about a gigabyte a step where this moves 25 MB. `cast` stays the reference, and
is what runs everywhere else.

Robots in different tunnels read different boxes, so a box is read as the 32 bytes of its record, in two instructions.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.lidar.cast import NOTHING
from subterra_jax.tunnel import Tunnel

# Environments of one program: one warp, one environment a thread, so that a program in which nobody looks on is short.
_ROWS = 32
# Lines whose nearest boxes fit into one thread's registers.
_MOST_LINES = 8
# Beams of one program, one after the other.
_MOST_BEAMS = 2
# Numbers of a record, and the places of two of them; see `Tunnel`.
RECORD, _VERTICES, _WINDOW = 8, 6, 7


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
    record, wall = record_of(tunnel), tunnel.wall.reshape(-1)
    row = pl.BlockSpec((_ROWS,), lambda i, _: (i,))
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
    )(*rows, turn, record)
    ranges = pl.pallas_call(
        partial(_hits_kernel, tunnel=tunnel, n_beams=n_beams, width=group),
        grid=(n // _ROWS, n_beams // group),
        in_specs=[pl.BlockSpec((k, group, _ROWS), lambda i, j: (0, j, i))] + [row] * 5 + [whole] * 4,
        out_specs=pl.BlockSpec((group, _ROWS), lambda i, j: (j, i)),
        out_shape=jax.ShapeDtypeStruct((n_beams, n), jnp.float32),
        compiler_params=warp,
        interpret=jax.default_backend() != "gpu",
    )(key, *rows, turn, jnp.asarray(range_max, jnp.float32).reshape(1), record, wall)
    return ranges[:, :count].T


def record_of(tunnel: Tunnel) -> Int[Array, " n"]:
    """Return the bits of the records of a tunnel, one after another; made of its boxes where it has none."""
    record = tunnel.record
    if record is None:
        most = jnp.full(tunnel.box.shape[1], tunnel.n_scan, jnp.float32)
        record = jnp.column_stack([tunnel.box.T, jnp.full_like(most, tunnel.wall.shape[2]), most])
    return lax.bitcast_convert_type(jnp.asarray(record, jnp.float32), jnp.int32).reshape(-1)


def load_box(record_ref, block):
    """Return the six numbers of the boxes of many blocks, read by two instructions."""
    from jax.experimental.pallas import triton

    column = lax.broadcasted_iota(jnp.int32, (*block.shape, 4), 1)
    at = RECORD * block[:, None] + column
    halves = triton.load(record_ref.at[at]), triton.load(record_ref.at[at + 4])

    def number(i):
        bits = jnp.sum(jnp.where(column == i % 4, halves[i // 4], 0), axis=1)
        return lax.bitcast_convert_type(bits, jnp.float32)

    return [number(i) for i in range(6)]


def load_number(record_ref, block, i, mask):
    """Return a number of the records of many blocks, 0 where masked."""
    from jax.experimental.pallas import triton

    other = {} if mask is None else {"mask": mask, "other": 0}  # Triton takes no `other` without a mask
    return lax.bitcast_convert_type(triton.load(record_ref.at[RECORD * block + i], **other), jnp.float32)


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
    record_ref,
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

        def meet(number, best):
            m_x, m_y, e_x, e_y, thickness, length = load_box(record_ref, first + number)
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
            return tuple(_inserted(best[i], merged[i]) for i in range(2 * width))

        nothing = tuple(jnp.full(first.shape, NOTHING) for _ in range(n_best))
        window = jnp.max(load_number(record_ref, first, _WINDOW, None)).astype(jnp.int32)
        best = lax.fori_loop(0, window, meet, (nothing,) * (2 * width))
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
    key_ref, first_ref, wanted_ref, x_ref, y_ref, heading_ref, turn_ref, limit_ref, record_ref, wall_ref, range_ref,
    *, tunnel: Tunnel, n_beams: int, width: int,
):  # fmt: skip
    """The nearest segment along one beam of many scans, in the blocks whose boxes it enters before that segment."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    first_beam = pl.program_id(1) * width

    @pl.when(jnp.max(wanted_ref[...]) > 0)
    def look() -> None:
        n_blocks, n_bits = tunnel.box.shape[1], _number_bits(tunnel)
        first, x, y, heading = first_ref[...], x_ref[...], y_ref[...], heading_ref[...]
        cos, sin = jnp.cos(heading), jnp.sin(heading)
        wanted = wanted_ref[...] > 0

        def beam(j, _):
            direction = _direction(turn_ref, first_beam + j, n_beams, cos, sin)
            look_into = partial(_look_into, record_ref, wall_ref, tunnel.wall.shape[2], x, y, direction)
            nearest = jnp.full(first.shape, triton.load(limit_ref.at[jnp.int32(0)]))
            for k in range(tunnel.n_candidates):
                key = key_ref[k, j, :]
                entry = lax.bitcast_convert_type(key & jnp.int32(-(1 << n_bits)), jnp.float32)
                # A box that is entered behind the hit holds no nearer one.
                open_ = wanted & (key != NOTHING) & (entry <= nearest)
                block = jnp.minimum(first + (key & jnp.int32((1 << n_bits) - 1)), n_blocks - 1)
                nearest = look_into(block, open_, nearest)
            unsure = wanted & (key != NOTHING) & (entry <= nearest)
            range_ref[j, :] = _look_everywhere(record_ref, look_into, first, unsure, x, y, direction, nearest)
            return 0

        lax.fori_loop(0, width, beam, 0)


def _look_into(record_ref, wall_ref, n_vertices: int, x, y, direction, block, open_, nearest):
    """The distance to the nearest segment of a block along beams where `open_`, if less than `nearest`.

    `cast.hits` has the geometry.
    """
    from jax.experimental.pallas import triton

    d_x, d_y = direction
    m_x, m_y = (load_number(record_ref, block, i, open_) - at for i, at in ((0, x), (1, y)))
    middle_left, middle_ahead = d_x * m_y - d_y * m_x, d_x * m_x + d_y * m_y
    joint = 2e-7 * (1.0 + jnp.abs(middle_ahead))
    start = block * (2 * n_vertices)
    load = lambda i: triton.load(wall_ref.at[start + i], mask=open_, other=0.0)  # noqa: E731

    def vertex(i):
        x, y = load(i), load(n_vertices + i)
        return middle_left + (d_x * y - d_y * x), middle_ahead + (d_x * x + d_y * y)

    def segment(i, carry):
        a, a_ahead, nearest = carry
        b, b_ahead = vertex(i)
        meets = (jnp.minimum(a, b) <= joint) & (jnp.maximum(a, b) >= -joint)
        share = jnp.clip(a / jnp.where(a == b, 1.0, a - b), 0.0, 1.0)
        distance = a_ahead + share * (b_ahead - a_ahead)
        hit = open_ & meets & (distance >= 0.0)
        return b, b_ahead, jnp.where(hit, jnp.minimum(nearest, distance), nearest)

    end = jnp.max(load_number(record_ref, block, _VERTICES, open_)).astype(jnp.int32)
    return lax.fori_loop(1, jnp.maximum(end, 1), segment, (*vertex(0), nearest))[2]


def _look_everywhere(record_ref, look_into, first, unsure, x, y, direction, nearest):
    """Return the nearest hit in any block of the window whose box is entered, for beams that are `unsure`.

    They enter as many boxes as were kept, and meet no wall before the last of them, as beside a row of deep recesses.
    """
    d_x, d_y = direction

    def look(number, nearest):
        block = first + number
        m_x, m_y, e_x, e_y, thickness, length = (load_number(record_ref, block, i, unsure) for i in range(6))
        m_x, m_y = m_x - x, m_y - y
        to_face = jnp.maximum(jnp.abs(m_x * e_y - m_y * e_x) - thickness * length, 0.0)
        size = jnp.abs(d_x * e_y - d_y * e_x)
        # Entered a little early rather than a little late.
        open_ = unsure & (jnp.abs(d_x * m_y - d_y * m_x) <= size + thickness)
        open_ = open_ & (to_face * (1.0 - 1e-5) <= nearest * size + 1e-6)
        return lax.cond(jnp.max(open_.astype(jnp.int32)) > 0, lambda: look_into(block, open_, nearest), lambda: nearest)

    window = jnp.max(jnp.where(unsure, load_number(record_ref, first, _WINDOW, unsure), 0.0)).astype(jnp.int32)
    return lax.fori_loop(0, window, look, nearest)
