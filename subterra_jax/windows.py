"""Which blocks of wall can matter to a robot: windows along the tunnel, made once on the host in float64."""

import numpy as np

from subterra_jax.blocks import Blocks, distance_to_segment
from subterra_jax.plan import TunnelPlan


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
    across = plan.half_width[:, None] * normal
    node, block = _near(plan.centre, plan.half_width, blocks, reach + slack.max())
    distance = _gap(plan.centre[node], across[node], blocks.centre[block], blocks.half[block])
    # What hides behind a lid is at most a pocket further away than the box, never nearer.
    within = distance - blocks.thickness[block] <= reach + slack[node]
    node, block = node[within], block[within]
    first = np.full(len(plan.station), len(blocks.centre) - 1)
    last = np.zeros(len(plan.station), int)
    np.minimum.at(first, node, block)
    np.maximum.at(last, node, block)
    size = int(np.clip(np.max(last - first) + 1, 1, len(blocks.centre)))
    return np.clip(first, 0, len(blocks.centre) - size), size


def separation(blocks: Blocks, reach: float) -> int:
    """Least number of places in the order such that blocks that far apart are never within `reach` of one another."""
    first, second = _near(blocks.centre, np.linalg.norm(blocks.half, axis=1), blocks, reach)
    gap = _gap(blocks.centre[first], blocks.half[first], blocks.centre[second], blocks.half[second])
    within = gap - blocks.thickness[first] - blocks.thickness[second] <= reach
    return int(np.max(np.abs(first - second)[within], initial=0)) + 1


def _near(middle: np.ndarray, half_length: np.ndarray, blocks: Blocks, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of a segment, given by its middle and half length, and a block that may be within reach of it."""
    distance = np.hypot(*(middle[:, None, i] - blocks.centre[None, :, i] for i in range(2)))
    size = np.linalg.norm(blocks.half, axis=1) + blocks.thickness
    first, second = np.nonzero(distance <= reach + half_length[:, None] + size[None, :])
    return first, second


def _gap(middle: np.ndarray, half: np.ndarray, other: np.ndarray, other_half: np.ndarray) -> np.ndarray:
    """Distance between segments `middle ± half`, `(n, 2)`, that do not cross: it is at an end of one of them."""
    return np.min(
        [
            distance_to_segment(middle + half, other, other_half),
            distance_to_segment(middle - half, other, other_half),
            distance_to_segment(other + other_half, middle, half),
            distance_to_segment(other - other_half, middle, half),
        ],
        axis=0,
    )
