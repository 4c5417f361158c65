"""Casts beams against the walls, exactly.

Walls come in short blocks, each in a thin box. Every beam is tested against all boxes of a window with a few products,
and then meets the true segments of the few blocks that it enters first, and of further ones as long as these do not
decide. Nothing about the walls is approximated; the cost depends neither on the tunnel's length nor, much, on its
pockets.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.rows import vary_like
from subterra_jax.tunnel import Tunnel

NOTHING = np.int32(2**31 - 1)


def nearest(
    tunnel: Tunnel, first: Int[Array, ""], position: Float[Array, "2"], direction: Float[Array, "n_beams 2"]
) -> Float[Array, "n_beams"]:
    """Distance at which each beam first meets a wall, m; `inf` where it meets none.

    Args:
        first: First block of the window.
        position: Origin of the beams, tunnel frame, m.
        direction: Their unit vectors; if their number is even, the second half must oppose the first.
    """
    return _search(tunnel, first, position, direction, which=False).distance


class _Found(NamedTuple):
    """Nearest walls after some rounds of a search."""

    distance: Float[Array, "n_beams"]  # to the nearest wall so far along each beam, m
    block: Int[Array, "n_beams"]  # the block that it is of
    last: Int[Array, "n_beams"]  # key of the farthest box looked into, as `_entries` makes it
    open: Bool[Array, "n_beams"]  # a nearer wall may stand in a box not yet looked into


def _search(
    tunnel: Tunnel,
    first: Int[Array, ""],
    position: Float[Array, "2"],
    direction: Float[Array, "n_beams 2"],
    which: bool,
) -> _Found:
    """Look into boxes in the order in which each beam enters them, a few a round, until none is left before its wall.

    One round is enough for nearly every scan, but not beside a row of deep recesses, whose thick boxes a beam along the
    wall enters one after another. The blocks are found only if `which`.
    """
    n_beams, n_bits = direction.shape[0], (tunnel.n_scan - 1).bit_length()

    def look(found: _Found) -> _Found:
        key = _following(tunnel, first, position, direction, found.last)
        block = first + (key & jnp.int32((1 << n_bits) - 1))
        # A beam that enters fewer boxes gets arbitrary blocks for the rest: a hit on any wall is a hit.
        block = jnp.minimum(block, tunnel.box.shape[1] - 1)
        each = _hits(tunnel, block, position, direction)
        last, distance = key[:, -1], jnp.minimum(found.distance, jnp.min(each, axis=-1))
        met = jnp.take_along_axis(block, jnp.argmin(each, axis=-1)[:, None], axis=-1)[:, 0]
        entry = lax.bitcast_convert_type(last & jnp.int32(-(1 << n_bits)), jnp.float32)
        met = jnp.where(distance < found.distance, met, found.block) if which else found.block
        return _Found(distance, met, last, (last != NOTHING) & (entry <= distance))

    start = _Found(
        jnp.full(n_beams, jnp.inf, direction.dtype),
        jnp.zeros(n_beams, jnp.int32),
        jnp.full(n_beams, -1, jnp.int32),
        jnp.ones(n_beams, bool),
    )
    start = vary_like(start, tunnel.box, first, position, direction)
    return lax.while_loop(lambda found: jnp.any(found.open), look, start)


def _following(
    tunnel: Tunnel,
    first: Int[Array, ""],
    position: Float[Array, "2"],
    direction: Float[Array, "n_beams 2"],
    last: Int[Array, "n_beams"],
) -> Int[Array, "n_beams n_candidates"]:
    """Return the keys of the boxes that each beam enters next after the `last`, nearest first; then `NOTHING`.

    With m the middle of a box and e its half axis, both from the LiDAR, a line along d crosses the box if
    |d × m| ≤ |d × e| + thickness, and does so at the distance (m × e) / (d × e), whose numerator all beams share.
    """
    n_beams, n_bits = direction.shape[0], (tunnel.n_scan - 1).bit_length()
    # Opposite beams share a line, and so everything but its sense.
    n_lines = n_beams if n_beams % 2 else n_beams // 2
    # Without the planes: a batch copies its windows.
    box = lax.dynamic_slice_in_dim(tunnel.box[:6], first, tunnel.n_scan, axis=1)
    number = jnp.arange(tunnel.n_scan, dtype=jnp.int32)
    senses = _entries(box, number, n_bits, position, direction[:n_lines])
    following = []
    for sense in range(n_beams // n_lines):
        rest, found = senses[sense], [last[sense * n_lines : (sense + 1) * n_lines]]
        for _ in range(tunnel.n_candidates):
            rest = jnp.where(rest > found[-1][None], rest, NOTHING)
            found.append(jnp.min(rest, axis=0))
        following.append(jnp.stack(found[1:], axis=-1))
    return jnp.concatenate(following)


def _entries(
    box: Float[Array, "6 k"],
    number: Int[Array, "k"],
    n_bits: int,
    position: Float[Array, "2"],
    lines: Float[Array, "m 2"],
) -> tuple[Int[Array, "k m"], Int[Array, "k m"]]:
    """For each box and line, the distance of the crossing and the box's number in one sortable integer.

    Returns:
        Crossings ahead, and crossings behind; `NOTHING` where there is none. Distances lose their last `n_bits` to the
        number, which makes them less by up to a few millimetres, never more.
    """
    box, number = box[:, :, None], number[:, None]
    m_x, m_y, thickness = box[0] - position[0], box[1] - position[1], box[4]
    turn = m_x * box[3] - m_y * box[2]
    # With e turned so that m × e ≥ 0, the sign of d × e tells whether the crossing lies ahead or behind.
    e_x, e_y = jnp.where(turn < 0.0, -box[2], box[2]), jnp.where(turn < 0.0, -box[3], box[3])
    to_face = jnp.abs(turn) - thickness * box[5]
    # Looking along a wall, from between the two faces of its box, one may meet it ahead or behind.
    outside = to_face > 0.0
    to_face, least = jnp.where(outside, to_face, 0.0), jnp.where(outside, 0.0, -jnp.inf)
    d_x, d_y = lines[None, :, 0], lines[None, :, 1]
    beside = jnp.abs(d_x * m_y - d_y * m_x)
    facing = d_x * e_y - d_y * e_x
    distance = to_face / (jnp.abs(facing) + 1e-20)
    # Distances are not negative, so their bits sort like integers, and the last bits can carry the block's number: one
    # minimum finds the nearest box and which it is.
    key = lax.bitcast_convert_type(distance.astype(jnp.float32), jnp.int32) & jnp.int32(-(1 << n_bits)) | number
    key = jnp.where(beside <= jnp.abs(facing) + thickness, key, NOTHING)
    return jnp.where(facing > least, key, NOTHING), jnp.where(-facing > least, key, NOTHING)


def _hits(
    tunnel: Tunnel,
    block: Int[Array, "n_beams n_blocks"],
    position: Float[Array, "2"],
    direction: Float[Array, "n_beams 2"],
) -> Float[Array, "n_beams n_blocks"]:
    """Distance at which each beam meets the nearest wall of each of a few blocks, m; `inf` where it meets none."""
    distance = _distances(tunnel, block, position, direction)
    # As integers, because a minimum of floats must look out for NaN, which costs a quarter of this function on a CPU.
    as_bits = jnp.dtype(f"int{8 * distance.dtype.itemsize}")
    bits = lax.bitcast_convert_type(distance, as_bits)
    return lax.bitcast_convert_type(jnp.min(bits, axis=-1), distance.dtype)


def _distances(
    tunnel: Tunnel,
    block: Int[Array, "n_beams n_blocks"],
    position: Float[Array, "2"],
    direction: Float[Array, "n_beams 2"],
) -> Float[Array, "n_beams n_blocks n_segments"]:
    """Distance at which each beam meets each segment of its blocks, m; `inf` where it does not."""
    m_x, m_y = tunnel.box[0, block] - position[0], tunnel.box[1, block] - position[1]
    d_x, d_y = direction[:, 0, None], direction[:, 1, None]
    # Middle first, then vertices from it: large coordinates cancel before anything is rounded.
    middle_left, middle_ahead = d_x * m_y - d_y * m_x, d_x * m_x + d_y * m_y
    x, y = tunnel.wall[block, 0], tunnel.wall[block, 1]
    d_x, d_y = d_x[..., None], d_y[..., None]
    left = middle_left[..., None] + (d_x * y - d_y * x)
    ahead = middle_ahead[..., None] + (d_x * x + d_y * y)
    a, b = left[..., :-1], left[..., 1:]
    # A beam through the joint of two blocks must meet one of them although their ends are rounded apart.
    joint = (2e-7 * (1.0 + jnp.abs(middle_ahead)))[..., None]
    meets = (jnp.minimum(a, b) <= joint) & (jnp.maximum(a, b) >= -joint)
    share = jnp.clip(a / jnp.where(a == b, 1.0, a - b), 0.0, 1.0)
    distance = ahead[..., :-1] + share * (ahead[..., 1:] - ahead[..., :-1])
    return jnp.where(meets & (distance >= 0.0), distance, jnp.inf)


def met(
    tunnel: Tunnel, first: Int[Array, ""], position: Float[Array, "2"], direction: Float[Array, "n_beams 2"]
) -> tuple[Int[Array, "n_beams"], Int[Array, "n_beams"]]:
    """Block and first vertex of the segment that each beam meets first; any segment for a beam that meets none."""
    block = _search(tunnel, first, position, direction, which=True).block
    distance = _distances(tunnel, block[:, None], position, direction)[:, 0]
    return block, jnp.argmin(distance, axis=-1).astype(jnp.int32)


def to_segment(
    tunnel: Tunnel,
    block: Int[Array, "n_beams"],
    vertex: Int[Array, "n_beams"],
    position: Float[Array, "2"],
    direction: Float[Array, "n_beams 2"],
) -> Float[Array, "n_beams"]:
    """Distance from the LiDAR to the line through a given segment, along each beam, m.

    Its derivatives are those of a range. With the wall's normal n, that by the position is -n / (n · direction).
    """
    middle = tunnel.box[:2, block].T - position[None]
    a, b = middle + tunnel.wall[block, :, vertex], middle + tunnel.wall[block, :, vertex + 1]
    edge = b - a
    beside = direction[:, 0] * edge[:, 1] - direction[:, 1] * edge[:, 0]
    return (a[:, 0] * edge[:, 1] - a[:, 1] * edge[:, 0]) / jnp.where(beside == 0.0, 1.0, beside)
