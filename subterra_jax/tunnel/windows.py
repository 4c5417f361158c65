"""Which blocks of wall can matter to a robot: windows along the tunnel, made once on the host in float64."""

import numpy as np
from jaxtyping import Float, Int

from subterra_jax.tunnel.blocks import Blocks
from subterra_jax.tunnel.boxes import distance_to_segment
from subterra_jax.tunnel.plan import TunnelPlan

_ROWS = 128  # segments looked at together: near enough to one another that they share most of their blocks


def windows(plan: TunnelPlan, blocks: Blocks, reach: float) -> tuple[np.ndarray, int]:
    """For each node of the chainage grid, the blocks within reach of a robot near that node.

    Args:
        plan: The tunnel, for its chainage grid.
        blocks: Its blocks.
        reach: Distance that the window must cover, m, wherever across the tunnel the robot is and up to half a grid
            step along it; beyond a mouth, up to 0.5 m outside.

    Returns:
        First block of each node's window `(n,)`, and the number of blocks in a window, the same for all.
    """
    spacing = plan.station[1] - plan.station[0]
    slack = np.full(len(plan.station), 0.6 * spacing + 0.01)
    slack[[0, -1]] += 0.5
    normal = np.stack([-plan.tangent[:, 1], plan.tangent[:, 0]], axis=-1)
    node, block = _within(plan.centre, plan.half_width[:, None] * normal, np.zeros(len(slack)), blocks, reach + slack)
    first = np.full(len(plan.station), len(blocks.centre) - 1)
    last = np.zeros(len(plan.station), int)
    np.minimum.at(first, node, block)
    np.maximum.at(last, node, block)
    size = int(np.clip(np.max(last - first) + 1, 1, len(blocks.centre)))
    return np.clip(first, 0, len(blocks.centre) - size), size


def separation(blocks: Blocks, reach: float) -> int:
    """Least number of places in the order such that blocks that far apart are never within `reach` of one another."""
    limit = np.full(len(blocks.centre), reach)
    first, second = _within(blocks.centre, blocks.half, blocks.thickness, blocks, limit)
    return int(np.max(np.abs(first - second), initial=0)) + 1


def _within(
    middle: Float[np.ndarray, "n 2"],
    half: Float[np.ndarray, "n 2"],
    thickness: Float[np.ndarray, " n"],
    blocks: Blocks,
    limit: Float[np.ndarray, " n"],
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Pairs of a thin box `middle ± half` and a block that come within a distance of one another.

    Both may be thicker than a line. What hides behind a lid is at most a pocket further away than the box, never
    nearer.

    Args:
        middle: Of each box, m.
        half: Half its long axis, m.
        thickness: Half its thickness, m.
        blocks: The blocks.
        limit: The distance, of each box, m.

    Returns:
        Number of the box, and of the block.
    """
    length, size = np.hypot(*half.T), np.hypot(*blocks.half.T)
    found = []
    for first in range(0, len(middle), _ROWS):
        rows = slice(first, first + _ROWS)
        most = (limit[rows] + thickness[rows]).max() + (size + blocks.thickness).max() + length[rows].max()
        low, high = middle[rows].min(axis=0) - most, middle[rows].max(axis=0) + most
        near = np.flatnonzero(np.all((blocks.centre >= low) & (blocks.centre <= high), axis=1))
        x, y = (middle[rows, i, None] - blocks.centre[near, i] for i in range(2))
        room = (limit + thickness)[rows, None] + blocks.thickness[near]
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
    """Distance between segments `middle ± half` that do not cross: it is at an end of one of them."""
    ends = (
        distance_to_segment(middle + half, other, other_half),
        distance_to_segment(middle - half, other, other_half),
        distance_to_segment(other + other_half, middle, half),
        distance_to_segment(other - other_half, middle, half),
    )
    return np.minimum(np.minimum(ends[0], ends[1]), np.minimum(ends[2], ends[3]))
