"""`vehicle.clearance` on a CPU's vector registers: sixteen blocks, then sixteen segments at a time."""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from subterra_jax.native.lanes import (
    N_LANES,
    bits,
    following,
    from_bits,
    least,
    load_some,
    numbered,
    root,
    where,
)

_F, _I = np.float32, np.int32
_ZERO, _ONE, _NOTHING = _F(0.0), _F(1.0), _I(2**31 - 1)
# What a block's distance may lose to rounding and to its number in the last bits: relative, and m.
_LESS, _MARGIN = _F(1.0 - 2.0**-18), _F(1e-3)

compiled = njit(error_model="numpy", fastmath={"contract"}, forceinline=True)


@compiled
@no_type_check
def distance_squared(wall, n_vertices, block, m_x, m_y):
    """Bits of the squared distance to the nearest segment of a block whose middle is at `m_x`, `m_y`, m²."""
    start, found = block * 2 * n_vertices, _NOTHING
    for vertex in range(0, n_vertices - 1, N_LANES - 1):
        there = numbered() < _I(n_vertices - vertex)
        x = m_x + load_some(wall, start + vertex, there)
        y = m_y + load_some(wall, start + n_vertices + vertex, there)
        edge_x, edge_y = following(x) - x, following(y) - y
        size = edge_x * edge_x + edge_y * edge_y
        # Padding repeats a vertex: a segment of length 0, whose nearest point is its start.
        share = (_ZERO - (x * edge_x + y * edge_y)) / where(size > _ZERO, size, _ONE)
        share = where(share < _ZERO, _ZERO, share)
        share = where(share > _ONE, _ONE, share)
        near_x, near_y = x + share * edge_x, y + share * edge_y
        is_segment = numbered() < _I(min(n_vertices - vertex, N_LANES) - 1)
        found = min(found, least(where(is_segment, bits(near_x * near_x + near_y * near_y), _NOTHING)))
    return found


@compiled
@no_type_check
def clearance_rows(begin, end, first, position, box, wall, n_vertices, reach, n_contact, distance):
    """Distances number `begin` to `end` of a batch; all arrays are flat.

    Args:
        begin: First point to look at.
        end: The one after the last.
        first: First block of each window.
        position: Points x, y, m.
        box: The tunnel's boxes, six rows.
        wall: The tunnel's walls.
        n_vertices: Vertices of a block.
        reach: What is further away is said to be here, m.
        n_contact: Blocks in a window.
        distance: Receives the distances, m.
    """
    n_blocks = len(box) // 6
    for row in range(begin, end):
        best = bits(reach * reach)
        for number in range(0, n_contact, N_LANES):
            there = numbered() < _I(n_contact - number)
            block = np.intp(first[row]) + number
            m_x = load_some(box, block, there) - position[2 * row]
            m_y = load_some(box, n_blocks + block, there) - position[2 * row + 1]
            thickness, length = load_some(box, 4 * n_blocks + block, there), load_some(box, 5 * n_blocks + block, there)
            gap = root(m_x * m_x + m_y * m_y) * _LESS - length - thickness - _MARGIN
            gap = where(gap > _ZERO, gap, _ZERO)
            keys = where(there, (bits(gap * gap) & _I(-N_LANES)) | numbered(), _NOTHING)
            while True:
                key = least(keys)
                if (key & _I(-N_LANES)) >= best:
                    break
                keys = where(keys == key, _NOTHING, keys)
                which = block + np.intp(key & _I(N_LANES - 1))
                x, y = box[which] - position[2 * row], box[n_blocks + which] - position[2 * row + 1]
                best = min(best, distance_squared(wall, n_vertices, which, x, y))
        distance[row] = _F(math.sqrt(from_bits(best)))
