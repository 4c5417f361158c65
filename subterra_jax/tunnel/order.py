"""Which blocks are within reach of every place along a tunnel, and in which order a beam visits them.

Everything here runs once, on the host, in float64.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from subterra_jax.tunnel.blocks import Blocks
from subterra_jax.tunnel.distances import distance_to_segment
from subterra_jax.tunnel.plan import TunnelPlan

# Bounds are made to be less than true by this, m: more than any rounding on the device.
_BOUND_MARGIN = 1e-3
_BOUND_ROWS = 64  # blocks at a time, against memory
_ROWS = 128  # segments compared together: close enough to one another to share most of their blocks


@dataclasses.dataclass(frozen=True)
class Order:
    """The order in which a beam visits blocks, and a bound by which it may stop.

    A beam visits the blocks from `start` on, and then those before it, outward. Across the tunnel at each block lies a
    plane. Whatever is still to be visited lies beyond it, however the tunnel bends, so a beam that does not reach the
    plane before the wall that it has met is done.
    """

    start: np.ndarray  # first block at or beyond each node of the station grid, `(n,)`
    # of the plane at each block, along the tunnel, `(n_blocks, 2)`; at most of length 1, with coordinates of 16 bits,
    # so that all kernels read the same
    normal: np.ndarray
    # distance along the normal from the middle of each block to the plane behind which it and all later blocks lie, m,
    # `(n_blocks,)`, scaled like the normal
    ahead: np.ndarray
    behind: np.ndarray  # the same against the normal, for it and all earlier blocks


def order(plan: TunnelPlan, blocks: Blocks, first: np.ndarray, count: np.ndarray) -> Order:
    """Return the order of blocks.

    Args:
        plan: The tunnel, for its station grid.
        first: First block within reach of each node, as from `windows`.
        count: Number of blocks from there on that may be within reach.
    """
    n = len(blocks.centre)
    start = np.searchsorted(blocks.station, plan.station)
    # Blocks that nobody sees who passes this one on the way out do not count.
    last, least = np.arange(n), np.arange(n)
    np.maximum.at(last, np.minimum(start, n - 1), first + count - 1)
    np.minimum.at(least, np.maximum(start - 1, 0), first)
    last = np.maximum.accumulate(last)
    least = np.minimum.accumulate(least[::-1])[::-1]
    tangent = np.stack([np.interp(blocks.station, plan.station, plan.tangent[:, i]) for i in range(2)], axis=-1)
    normal = half_float((1.0 - 2.0**-7) * tangent / np.linalg.norm(tangent, axis=1, keepdims=True))
    along = blocks.half / np.maximum(np.hypot(*blocks.half.T), 1e-12)[:, None]
    aside = blocks.thickness[:, None] * np.stack([-along[:, 1], along[:, 0]], axis=-1)
    ahead, behind = np.empty(n), np.empty(n)
    for begin in range(0, n, _BOUND_ROWS):
        rows = np.arange(begin, min(begin + _BOUND_ROWS, n))
        low, high = least[rows].min(), last[rows].max() + 1
        off = normal[rows] @ blocks.centre[low:high].T - np.sum(normal[rows] * blocks.centre[rows], axis=1)[:, None]
        size = np.abs(normal[rows] @ blocks.half[low:high].T) + np.abs(normal[rows] @ aside[low:high].T)
        # What lies behind a lid counts too: a clearance may be measured from within a pocket.
        vertices = np.abs(blocks.offset[low:high].reshape(-1, 2) @ normal[rows].T)
        size = np.maximum(size, vertices.reshape(high - low, -1, len(rows)).max(axis=1).T)
        which, row = np.arange(low, high), rows[:, None]
        later, earlier = (which >= row) & (which <= last[row]), (which <= row) & (which >= least[row])
        ahead[rows] = np.where(later, off - size, np.inf).min(axis=1) - _BOUND_MARGIN
        behind[rows] = np.where(earlier, -off - size, np.inf).min(axis=1) - _BOUND_MARGIN
    return Order(start, normal, ahead, behind)


def half_float(values: np.ndarray) -> np.ndarray:
    """Return the nearest numbers of which only the upper 16 bits of 32 are set."""
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    return ((bits + 0x8000) & 0xFFFF0000).astype(np.uint32).view(np.float32).astype(np.float64)


def windows(plan: TunnelPlan, blocks: Blocks, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Return, for each node of the station grid, the blocks within reach of a robot near that node.

    Args:
        plan: The tunnel, for its station grid.
        reach: Distance that the window must cover, m, wherever across the tunnel the robot is and up to half a grid
            step along it; beyond a mouth, up to 0.5 m outside.

    Returns:
        First block of each node's window, and the number of blocks in it, both `(n,)`. As many blocks as the largest
        window holds follow every first block.
    """
    spacing = plan.station[1] - plan.station[0]
    slack = np.full(len(plan.station), 0.6 * spacing + 0.01)
    slack[[0, -1]] += 0.5
    normal = np.stack([-plan.tangent[:, 1], plan.tangent[:, 0]], axis=-1)
    node, block = _within(plan.centre, plan.half_width[:, None] * normal, blocks, reach + slack)
    first = np.full(len(plan.station), len(blocks.centre) - 1)
    last = np.zeros(len(plan.station), int)
    np.minimum.at(first, node, block)
    np.maximum.at(last, node, block)
    size = int(np.clip(np.max(last - first) + 1, 1, len(blocks.centre)))
    first = np.clip(first, 0, len(blocks.centre) - size)
    return first, np.maximum(last - first + 1, 1)


def _within(
    middle: Float[np.ndarray, "n 2"],
    half: Float[np.ndarray, "n 2"],
    blocks: Blocks,
    limit: Float[np.ndarray, " n"],
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Return numbers of the pairs of a line `middle ± half` and a block within a distance of one another, m.

    A wall behind a lid is at most a pocket further away than the block's box, never nearer.
    """
    length, size = np.hypot(*half.T), np.hypot(*blocks.half.T)
    found = []
    for first in range(0, len(middle), _ROWS):
        rows = slice(first, first + _ROWS)
        most = limit[rows].max() + (size + blocks.thickness).max() + length[rows].max()
        low, high = middle[rows].min(axis=0) - most, middle[rows].max(axis=0) + most
        near = np.flatnonzero(np.all((blocks.centre >= low) & (blocks.centre <= high), axis=1))
        x, y = (middle[rows, i, None] - blocks.centre[near, i] for i in range(2))
        room = limit[rows, None] + blocks.thickness[near]
        squared, surely = x * x + y * y, np.maximum(room, 0.0)
        maybe = surely + length[rows, None] + size[near]
        sure = squared <= surely * surely
        row, column = np.nonzero(~sure & (squared <= maybe * maybe))
        gap = _gap(middle[rows][row], half[rows][row], blocks.centre[near[column]], blocks.half[near[column]])
        sure[row, column] = gap <= room[row, column]
        row, column = np.nonzero(sure)
        found.append((first + row, near[column]))
    box, block = (np.concatenate(part) for part in zip(*found, strict=True))
    return box, block


def _gap(
    middle: Float[np.ndarray, "n 2"],
    half: Float[np.ndarray, "n 2"],
    other: Float[np.ndarray, "n 2"],
    other_half: Float[np.ndarray, "n 2"],
) -> Float[np.ndarray, " n"]:
    """Return the distance between segments `middle ± half` that do not cross: it is at an end of one of them."""
    ends = (
        distance_to_segment(middle + half, other, other_half),
        distance_to_segment(middle - half, other, other_half),
        distance_to_segment(other + other_half, middle, half),
        distance_to_segment(other - other_half, middle, half),
    )
    return np.minimum(np.minimum(ends[0], ends[1]), np.minimum(ends[2], ends[3]))
