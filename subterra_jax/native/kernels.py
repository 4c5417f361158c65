"""LiDAR and clearance on a CPU's vector registers: sixteen boxes, then sixteen segments at a time, nearest first.

One scan is cast from beginning to end before the next. So a beam enters only the boxes that are nearer than its hit so
far, and as a rule meets the segments of one block.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from subterra_jax.native.lanes import (
    N_LANES,
    bits,
    following,
    from_bits,
    lane_numbers,
    least,
    load,
    load_some,
    magnitude,
    root,
    store,
    where,
)

_F, _I = np.float32, np.int32
_ZERO, _ONE, _TINY = _F(0.0), _F(1.0), _F(1e-20)
_NOTHING, _FAR = _I(2**31 - 1), _F(1e6)
# Error of a box's distance through rounding and through the number in its last bits: relative, and m.
_LESS, _MARGIN = _F(1.0 - 2.0**-18), _F(1e-3)
_JOINT = _F(2e-7)

compiled = njit(error_model="numpy", fastmath={"contract"}, forceinline=True)


@compiled
@no_type_check
def window_width(n_scan):
    """Return the lanes for a window's boxes: an odd number of groups of 16, so that one is in the middle."""
    return N_LANES * (1 + 2 * ((max(n_scan - N_LANES, 0) + 2 * N_LANES - 1) // (2 * N_LANES)))


@compiled
@no_type_check
def look_around(box, first, n_scan, x, y, near, width, bound):
    """Transform the boxes of a window to the LiDAR's position, for all beams.

    Args:
        box: The tunnel's boxes, flat, six rows.
        first: First block of the window.
        n_scan: Blocks in it.
        x: Position of the LiDAR along x, m.
        y: Position of the LiDAR along y, m.
        near: Output, rows of `width`: middle x, y from the LiDAR; half axis x, y, turned so that middle × axis is not
            negative; half thickness; and that product less thickness × half length, as `cast._entries`. Padded at
            both ends with boxes that no beam enters.
        width: Lanes of the window.
        bound: Output, least distance to any box of each group of 16, m.
    """
    n_blocks = len(box) // 6
    pad = (width - n_scan) // 2
    for group in range(width // N_LANES):
        number = group * N_LANES - pad
        there = (lane_numbers() >= _I(-number)) & (lane_numbers() < _I(n_scan - number))
        block, lane = first + number, group * N_LANES
        m_x = where(there, load_some(box, block, there) - x, _FAR)
        m_y = where(there, load_some(box, n_blocks + block, there) - y, _FAR)
        e_x, e_y = load_some(box, 2 * n_blocks + block, there), load_some(box, 3 * n_blocks + block, there)
        thickness, length = load_some(box, 4 * n_blocks + block, there), load_some(box, 5 * n_blocks + block, there)
        turn = m_x * e_y - m_y * e_x
        flip = turn < _ZERO
        store(near, lane, m_x)
        store(near, width + lane, m_y)
        store(near, 2 * width + lane, where(flip, _ZERO - e_x, e_x))
        store(near, 3 * width + lane, where(flip, _ZERO - e_y, e_y))
        store(near, 4 * width + lane, where(there, thickness, -_ONE))
        store(near, 5 * width + lane, magnitude(turn) - thickness * length)
        gap = root(m_x * m_x + m_y * m_y) - length - thickness - _MARGIN
        bound[group] = from_bits(least(bits(where(gap > _ZERO, gap, _ZERO))))


@compiled
@no_type_check
def bound_outward(bound, n_groups):
    """Append the least distance to all groups at least r groups from the middle, for each r."""
    middle, reach = n_groups // 2, _FAR
    for r in range(middle, 0, -1):
        reach = min(reach, min(bound[middle - r], bound[middle + r]))
        bound[n_groups + r] = reach
    bound[n_groups] = _ZERO


@compiled
@no_type_check
def meet(wall, n_vertices, block, d_x, d_y, m_x, m_y):
    """Return the bits of the distance at which a beam meets one block, as `cast.hits`; `_NOTHING` if it misses.

    Args:
        wall: The tunnel's walls, flat.
        n_vertices: Vertices of a block.
        block: Its number.
        d_x: Unit vector of the beam, x.
        d_y: Unit vector of the beam, y.
        m_x: Middle of the block from the LiDAR, x, m.
        m_y: Middle of the block from the LiDAR, y, m.
    """
    start = block * 2 * n_vertices
    middle_ahead, middle_left = d_x * m_x + d_y * m_y, d_x * m_y - d_y * m_x
    joint = _JOINT * (_ONE + abs(middle_ahead))
    nearest = _NOTHING
    for vertex in range(0, n_vertices - 1, N_LANES - 1):
        there = lane_numbers() < _I(n_vertices - vertex)
        x = load_some(wall, start + vertex, there)
        y = load_some(wall, start + n_vertices + vertex, there)
        a, a_ahead = middle_left + (d_x * y - d_y * x), middle_ahead + (d_x * x + d_y * y)
        b, b_ahead = following(a), following(a_ahead)
        rises = a < b
        low, high = where(rises, a, b), where(rises, b, a)
        meets = (low <= joint) & (high >= -joint) & (lane_numbers() < _I(min(n_vertices - vertex, N_LANES) - 1))
        share = a / where(a == b, _ONE, a - b)
        share = where(share < _ZERO, _ZERO, share)
        share = where(share > _ONE, _ONE, share)
        distance = a_ahead + share * (b_ahead - a_ahead)
        nearest = min(nearest, least(where(meets & (distance >= _ZERO), bits(distance), _NOTHING)))
    return nearest


@compiled
@no_type_check
def nearest_hit(keys, best, lane, block, near, width, wall, n_vertices, d_x, d_y):
    """Return the bits of the distance to a beam's nearest hit in a group of boxes, or `best` if that is nearer.

    Args:
        keys: Distance at which the beam enters each box, its last bits the lane; `_NOTHING` where it does not.
        best: Nearest hit so far.
        lane: First lane of the group in `near`.
        block: Number of the group's first block.
        near: Output of `look_around`.
        width: Lanes of the window.
        wall: The tunnel's walls, flat.
        n_vertices: Vertices of a block.
        d_x: Unit vector of the beam, x.
        d_y: Unit vector of the beam, y.
    """
    while True:
        key = least(keys)
        if key >= best:
            return best
        keys = where(keys == key, _NOTHING, keys)
        which = np.intp(key & _I(N_LANES - 1))
        m_x, m_y = near[lane + which], near[width + lane + which]
        best = min(best, meet(wall, n_vertices, block + which, d_x, d_y, m_x, m_y))


@compiled
@no_type_check
def cast_line(d_x, d_y, limit, both, origin, near, width, bound, wall, n_vertices):
    """Return the distances to the nearest wall ahead on a line and, if `both`, behind, m; at most `limit`."""
    n_groups = width // N_LANES
    middle = n_groups // 2
    ahead, behind = bits(limit), bits(limit) if both else _I(0)
    for i in range(n_groups):
        r = (i + 1) // 2
        if bits(bound[n_groups + r]) >= max(ahead, behind):
            break
        group = middle + r if i % 2 == 0 else middle - r
        if bits(bound[group]) >= max(ahead, behind):
            continue
        lane = group * N_LANES
        block = origin + lane
        e_x, e_y = load(near, 2 * width + lane), load(near, 3 * width + lane)
        to_face = load(near, 5 * width + lane)
        facing = d_x * e_y - d_y * e_x
        size = magnitude(facing)
        beside = magnitude(d_x * load(near, width + lane) - d_y * load(near, lane))
        crosses = beside <= size + load(near, 4 * width + lane)
        between = to_face <= _ZERO
        distance = where(between, _ZERO, to_face) * _LESS / (size + _TINY)
        key = (bits(distance) & _I(-N_LANES)) | lane_numbers()
        key = where(crosses, key, _NOTHING)
        keys = where((facing > _ZERO) | between, key, _NOTHING)
        ahead = nearest_hit(keys, ahead, lane, block, near, width, wall, n_vertices, d_x, d_y)
        if both:
            keys = where((facing < _ZERO) | between, key, _NOTHING)
            behind = nearest_hit(keys, behind, lane, block, near, width, wall, n_vertices, -d_x, -d_y)
    return from_bits(ahead), from_bits(behind)


@compiled
@no_type_check
def scan_rows(begin, end, first, wanted, position, heading, box, wall, n_vertices, turn, limit, n_scan, ranges):
    """Take the scans `begin` to `end` of a batch; all arrays are flat.

    Args:
        begin: First scan to take.
        end: One after the last.
        first: First block of each window.
        wanted: 0 where the ranges may be anything.
        position: Position x, y of each scan, m.
        heading: Their headings, rad.
        box: The tunnel's boxes.
        wall: The tunnel's walls.
        n_vertices: Vertices of a block.
        turn: Cosines of the beams' bearings, then sines.
        limit: Largest range, m.
        n_scan: Blocks in a window.
        ranges: Output, ranges, m.
    """
    n_beams = len(turn) // 2
    both = n_beams % 2 == 0
    n_lines = n_beams // 2 if both else n_beams
    width = window_width(n_scan)
    pad = (width - n_scan) // 2
    near, bound = np.empty(6 * width, np.float32), np.empty(2 * (width // N_LANES), np.float32)
    for row in range(begin, end):
        if wanted[row] == 0:
            continue
        start = np.intp(first[row])
        look_around(box, start, n_scan, position[2 * row], position[2 * row + 1], near, width, bound)
        bound_outward(bound, width // N_LANES)
        cos, sin = _F(math.cos(heading[row])), _F(math.sin(heading[row]))
        for line in range(n_lines):
            along, across = turn[line], turn[n_beams + line]
            d_x, d_y = cos * along - sin * across, sin * along + cos * across
            ahead, behind = cast_line(d_x, d_y, limit, both, start - pad, near, width, bound, wall, n_vertices)
            ranges[row * n_beams + line] = ahead
            if both:
                ranges[row * n_beams + n_lines + line] = behind


@compiled
@no_type_check
def distance_squared(wall, n_vertices, block, m_x, m_y):
    """Return the bits of the squared distance to a block's nearest segment, m²; its middle is at `m_x`, `m_y`."""
    start, nearest = block * 2 * n_vertices, _NOTHING
    for vertex in range(0, n_vertices - 1, N_LANES - 1):
        there = lane_numbers() < _I(n_vertices - vertex)
        x = m_x + load_some(wall, start + vertex, there)
        y = m_y + load_some(wall, start + n_vertices + vertex, there)
        edge_x, edge_y = following(x) - x, following(y) - y
        size = edge_x * edge_x + edge_y * edge_y
        # Padding repeats a vertex: a segment of length 0, whose nearest point is its start.
        share = (_ZERO - (x * edge_x + y * edge_y)) / where(size > _ZERO, size, _ONE)
        share = where(share < _ZERO, _ZERO, share)
        share = where(share > _ONE, _ONE, share)
        near_x, near_y = x + share * edge_x, y + share * edge_y
        is_segment = lane_numbers() < _I(min(n_vertices - vertex, N_LANES) - 1)
        nearest = min(nearest, least(where(is_segment, bits(near_x * near_x + near_y * near_y), _NOTHING)))
    return nearest


@compiled
@no_type_check
def clearance_rows(begin, end, first, position, box, wall, n_vertices, reach, n_contact, distance):
    """Measure the clearances `begin` to `end` of a batch; all arrays are flat.

    Args:
        begin: First point to look at.
        end: One after the last.
        first: First block of each window.
        position: Points x, y, m.
        box: The tunnel's boxes, six rows.
        wall: The tunnel's walls.
        n_vertices: Vertices of a block.
        reach: Largest distance to report, m.
        n_contact: Blocks in a window.
        distance: Output, distances, m.
    """
    n_blocks = len(box) // 6
    for row in range(begin, end):
        best = bits(reach * reach)
        for number in range(0, n_contact, N_LANES):
            there = lane_numbers() < _I(n_contact - number)
            block = np.intp(first[row]) + number
            m_x = load_some(box, block, there) - position[2 * row]
            m_y = load_some(box, n_blocks + block, there) - position[2 * row + 1]
            thickness, length = load_some(box, 4 * n_blocks + block, there), load_some(box, 5 * n_blocks + block, there)
            gap = root(m_x * m_x + m_y * m_y) * _LESS - length - thickness - _MARGIN
            gap = where(gap > _ZERO, gap, _ZERO)
            keys = where(there, (bits(gap * gap) & _I(-N_LANES)) | lane_numbers(), _NOTHING)
            while True:
                key = least(keys)
                if (key & _I(-N_LANES)) >= best:
                    break
                keys = where(keys == key, _NOTHING, keys)
                which = block + np.intp(key & _I(N_LANES - 1))
                x, y = box[which] - position[2 * row], box[n_blocks + which] - position[2 * row + 1]
                best = min(best, distance_squared(wall, n_vertices, which, x, y))
        distance[row] = _F(math.sqrt(from_bits(best)))
