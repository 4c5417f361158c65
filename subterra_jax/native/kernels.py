"""The planar LiDAR and the clearance for CPUs: plain loops over sixteen blocks, or sixteen segments, at a time.

Blocks are visited in groups in the order of `tunnel.order.Order`, until the plane at a group's first block tells that
nothing behind it is nearer than what has been met. Arrays are flat, since a compiler makes vector instructions of their
loops, and whole numbers without sign, since it then knows that none counts from an array's end.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit
from numba.cpython.unsafe.numbers import trailing_zeros

from subterra_jax.native.threads import argument, result
from subterra_jax.tunnel import GROUP, WIDTH

_F, _I, _U = np.float32, np.int32, np.uint64
_ZERO, _ONE, _JOINT = _F(0.0), _F(1.0), _F(2e-7)
_GROUP, _HALF, _WIDTH, _NONE = _U(GROUP), _U(GROUP // 2), _U(WIDTH), _I(0)

compiled = njit(error_model="numpy", fastmath={"contract", "nnan", "nsz"}, forceinline=True)


@compiled
@no_type_check
def _left(wall, n_vertices, v, side, d_x, d_y):
    return side + (d_x * wall[n_vertices + v] - d_y * wall[v])


@compiled
@no_type_check
def _meet(wall, n_vertices, block, m_x, m_y, d_x, d_y, ahead, behind):
    """Return the nearest walls ahead on a line and behind, also in a block whose middle is at `m_x`, `m_y`."""
    side, along = d_x * m_y - d_y * m_x, d_x * m_x + d_y * m_y
    joint = _JOINT * (_ONE + abs(along))
    at = _U(2) * n_vertices * block
    for some in range((n_vertices - _U(1)) // _WIDTH):
        first, met = at + some * _WIDTH, _NONE
        for k in range(_WIDTH):
            v = first + k
            a, b = _left(wall, n_vertices, v, side, d_x, d_y), _left(wall, n_vertices, v + _U(1), side, d_x, d_y)
            low, high = (a if a < b else b), (b if a < b else a)
            met = _I(met | (_I(1 << k) if (low <= joint) & (high >= -joint) else _NONE))
        # As a rule a line crosses one segment of a block: division is for that one.
        while met != _NONE:
            v = first + _U(trailing_zeros(met))
            a, b = _left(wall, n_vertices, v, side, d_x, d_y), _left(wall, n_vertices, v + _U(1), side, d_x, d_y)
            fraction = min(max(a / (_ONE if a == b else a - b), _ZERO), _ONE)
            start = along + (d_x * wall[v] + d_y * wall[n_vertices + v])
            end = along + (d_x * wall[v + _U(1)] + d_y * wall[n_vertices + v + _U(1)])
            distance = start + fraction * (end - start)
            ahead = distance if (distance >= _ZERO) & (distance < ahead) else ahead
            behind = -distance if (distance <= _ZERO) & (-distance < behind) else behind
            met = _I(met & (met - 1))
    return ahead, behind


@compiled
@no_type_check
def _look(box, n, wall, n_vertices, low, x, y, d_x, d_y, ahead, behind):
    """Return the nearest walls ahead on a line and behind, also in a group of blocks from `low` on."""
    met = _NONE
    for k in range(_GROUP):
        i = low + k
        beside = abs(d_x * (box[n + i] - y) - d_y * (box[i] - x))
        gap = beside - (abs(d_x * box[_U(3) * n + i] - d_y * box[_U(2) * n + i]) + box[_U(4) * n + i])
        met = _I(met | (_I(1 << k) if gap <= _ZERO else _NONE))
    while met != _NONE:
        i = low + _U(trailing_zeros(met))
        ahead, behind = _meet(wall, n_vertices, i, box[i] - x, box[n + i] - y, d_x, d_y, ahead, behind)
        met = _I(met & (met - 1))
    return ahead, behind


@compiled
@no_type_check
def scan_rows(results, operands, begin, end):
    """Take the scans `begin` to `end` of a call: start, needed, position, heading, box, wall, turn, limit to ranges."""
    start, needed = argument(operands, 0).view(_I), argument(operands, 1).view(_I)
    position, heading = argument(operands, 2), argument(operands, 3)
    box, wall = argument(operands, 4), argument(operands, 5)
    turn, limit = argument(operands, 6), argument(operands, 7)[0]
    n, n_beams = _U(len(box) // 10), _U(len(turn) // 2)
    n_vertices, ranges = _U(len(wall)) // (_U(2) * n), result(results, len(start) * len(turn) // 2)
    both = n_beams % _U(2) == _U(0)  # opposite beams share a line
    n_lines = n_beams // _U(2) if both else n_beams
    for row in range(_U(begin), _U(end)):
        if needed[row] == 0:
            continue
        cos, sin = _F(math.cos(heading[row])), _F(math.sin(heading[row]))
        x, y, middle = position[_U(2) * row], position[_U(2) * row + _U(1)], _U(start[row]) - _HALF
        for line in range(n_lines):
            d_x, d_y = cos * turn[line] - sin * turn[n_beams + line], sin * turn[line] + cos * turn[n_beams + line]
            ahead, behind = limit, (limit if both else _ZERO)
            ahead, behind = _look(box, n, wall, n_vertices, middle, x, y, d_x, d_y, ahead, behind)
            for side in range(2):
                way = _ONE if side == 0 else -_ONE
                i = middle + _GROUP if side == 0 else middle - _U(1)
                while True:
                    n_x, n_y = way * box[_U(6) * n + i], way * box[_U(7) * n + i]
                    gap = n_x * (box[i] - x) + n_y * (box[n + i] - y) + box[_U(8 + side) * n + i]
                    speed = n_x * d_x + n_y * d_y
                    if gap > _ZERO and gap > ahead * speed and gap > -behind * speed:
                        break
                    low = i if side == 0 else i - (_GROUP - _U(1))
                    ahead, behind = _look(box, n, wall, n_vertices, low, x, y, d_x, d_y, ahead, behind)
                    i = i + _GROUP if side == 0 else i - _GROUP
            ranges[n_beams * row + line] = ahead
            if both:
                ranges[n_beams * row + n_lines + line] = behind


@compiled
@no_type_check
def _squared(wall, n_vertices, block, m_x, m_y, best):
    """Return the squared distance to a block's nearest segment, m², if it is less than `best`."""
    at = _U(2) * n_vertices * block
    for some in range((n_vertices - _U(1)) // _WIDTH):
        for k in range(_WIDTH):
            v = at + some * _WIDTH + k
            x, y = m_x + wall[v], m_y + wall[n_vertices + v]
            edge_x, edge_y = wall[v + _U(1)] - wall[v], wall[n_vertices + v + _U(1)] - wall[n_vertices + v]
            size = edge_x * edge_x + edge_y * edge_y
            # Padding repeats a vertex: a segment of length 0, whose nearest point is its start.
            fraction = min(max(-(x * edge_x + y * edge_y) / (size if size > _ZERO else _ONE), _ZERO), _ONE)
            near_x, near_y = x + fraction * edge_x, y + fraction * edge_y
            squared = near_x * near_x + near_y * near_y
            best = squared if squared < best else best
    return best


@compiled
@no_type_check
def clearance_rows(results, operands, begin, end):
    """Measure the clearances `begin` to `end` of a call: start, position, box, wall, reach to distances."""
    start, position = argument(operands, 0).view(_I), argument(operands, 1)
    box, wall, reach = argument(operands, 2), argument(operands, 3), argument(operands, 4)[0]
    n, distance = _U(len(box) // 10), result(results, len(start))
    n_vertices = _U(len(wall)) // (_U(2) * n)
    for row in range(_U(begin), _U(end)):
        x, y, best = position[_U(2) * row], position[_U(2) * row + _U(1)], reach * reach
        for side in range(2):
            way, i = (_ONE if side == 0 else -_ONE), _U(start[row] - side)
            while True:
                m_x, m_y = box[i] - x, box[n + i] - y
                gap = way * (box[_U(6) * n + i] * m_x + box[_U(7) * n + i] * m_y) + box[_U(8 + side) * n + i]
                if gap > _ZERO and gap * gap > best:
                    break
                e_x, e_y, half = box[_U(2) * n + i], box[_U(3) * n + i], box[_U(5) * n + i]
                # Not the best so far: from within a pocket its wall is nearer than the box, whose lid closes it.
                near = reach + box[_U(4) * n + i] + _F(1e-5)
                beside = abs(m_x * e_y - m_y * e_x) <= near * half
                if beside and abs(m_x * e_x + m_y * e_y) <= (half + near) * half:
                    best = _squared(wall, n_vertices, i, m_x, m_y, best)
                i = i + _U(1) if side == 0 else i - _U(1)
        distance[row] = _F(math.sqrt(best))
