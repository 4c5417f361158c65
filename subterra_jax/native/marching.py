"""The march of `lidar3d.march` for one ray after another on a CPU."""

from typing import no_type_check

import numpy as np
from numba import njit

from subterra_jax.lidar3d.cells import FACES, MARGIN, N_FACES, N_WEDGES, N_X, NEAR_UNIT, STEP_BITS, X_BITS
from subterra_jax.lidar3d.meeting import FINE, PAST, SEAM
from subterra_jax.lidar3d.relief import N_FRAME, N_LINK
from subterra_jax.native.threads import addresses_at, argument, result

_F, _I, _W = np.float32, np.int32, np.uint32
_ZERO, _ONE, _FAR, _TINY = _F(0.0), _F(1.0), _F(np.inf), _F(1e-12)
_PAST, _SEAM, _OVER, _MARGIN, _UNIT = _F(-PAST), _F(-SEAM), _F(1.0 + SEAM), _F(MARGIN), _F(NEAR_UNIT)
_LEFT, _UP = FACES.astype(np.float32).T.copy()
_PER_TURN, _HALF = _F(N_WEDGES / 4), X_BITS // 2
_LOW_X, _MIDDLE, _FINE, _STEP = _I((1 << _HALF) - 1), _F(1 << X_BITS - 1), _F(FINE), _W((1 << STEP_BITS) - 1)

compiled = njit(error_model="numpy", fastmath={"contract"}, forceinline=True)


@compiled
@no_type_check
def _edge(turn):
    """Return the direction left and up at a fraction of 4 of a turn, as `march.wedge_edge`."""
    return abs(turn - _F(2.0)) - _ONE, abs(turn + (_ONE if turn < _ONE else _F(-3.0))) - _ONE


@compiled
@no_type_check
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
@no_type_check
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
@no_type_check
def _less(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled
@no_type_check
def _on(a, t, d):
    return a[0] + t * d[0], a[1] + t * d[1], a[2] + t * d[2]


@compiled
@no_type_check
def _three(frame, at):
    return frame[at], frame[at + 1], frame[at + 2]


@compiled
@no_type_check
def _corner(vertex, number):
    """Return a vertex in units of its relief along the axis, and in `FINE` parts of them across it."""
    one, two = vertex[2 * number], vertex[2 * number + 1]
    return _F(((one & _LOW_X) << _I(_HALF)) | (two & _LOW_X)), _F(one), _F(two)


@compiled
@no_type_check
def _meet(vertex, entry, first, last, first_vertex, origin, speed, best, which):
    """Return the distance to the nearest triangle of a list, m, and its entry; `best` and `which` if none is nearer."""
    for i in range(first, last):
        code = _W(entry[i])
        number = first_vertex + np.int64(code >> _W(2 * STEP_BITS))
        p = _corner(vertex, number)
        a = _less(_corner(vertex, number + np.int64((code >> _W(STEP_BITS)) & _STEP)), p)
        b = _less(_corner(vertex, number + np.int64(code & _STEP)), p)
        gap, across_b = _less(origin, p), _cross(speed, b)
        across_a = _cross(gap, a)
        inverse = _ONE / _dot(a, across_b)
        u, v, t = _dot(gap, across_b) * inverse, _dot(speed, across_a) * inverse, _dot(b, across_a) * inverse
        if u >= _SEAM and v >= _SEAM and u + v <= _OVER and t >= _PAST and t < best:
            best, which = t, i
    return best, which


@compiled
@no_type_check
def _meet_boxes(box, first, last, origin, d):
    """Return the distance to the nearest box of a list, m, `inf` if a ray meets none, and its number."""
    best, which = _FAR, -1
    for i in range(first, last):
        enter, leave = -_FAR, _FAR
        for side in range(3):
            at = 12 * i + 4 * side
            row = _three(box, at)
            speed = _dot(row, d)
            slope = _ONE / (_TINY if abs(speed) < _TINY else speed)
            middle, half = (box[at + 3] - _dot(row, origin)) * slope, abs(slope)
            enter, leave = max(enter, middle - half), min(leave, middle + half)
        t = enter if enter >= _PAST else leave
        if enter <= leave and t >= _PAST and t < best:
            best, which = t, i
    return best, which


@compiled
@no_type_check
def _leaving(frame, at, o, d, way):
    """Return the distance at which a ray leaves through a plane, m; `inf` if it runs along it or the other way."""
    normal = _three(frame, at)
    speed = _dot(normal, d)
    return (frame[at + 3] - _dot(normal, o)) / speed if way * speed > _F(1e-9) else _FAR


@compiled
@no_type_check
def _leap(prism, y, z, dy, dz):
    """Return how far a ray stays in the block's prism, in which there is nothing, m; 0 if it is not in it."""
    room, out = _FAR, _F(1e9)
    for i in range(N_FACES):
        gap, speed = prism[i] - (_LEFT[i] * y + _UP[i] * z), _LEFT[i] * dy + _UP[i] * dz
        room = min(room, gap)
        out = min(out, gap / speed if speed > _TINY else _F(1e9))
    return out if room >= _ZERO else _ZERO


@compiled
@no_type_check
def _cross_cells(numbers, first_vertex, first_cell, cell, entry, vertex, p, d, stop):
    """Take a ray through the cells of one block, from a place `p` of its frame, m, in a direction `d`.

    Args:
        numbers: Numbers of the block from the least place along the axis on, see `N_FRAME`.
        stop: Largest distance of interest, m.

    Returns:
        Distance to the first triangle, m, `inf` where there is none; and its entry, -1 where there is none.
    """
    low, per_cell, along, across = numbers[0], numbers[1], numbers[2], numbers[3] * _FINE
    units = p[0] * along + _MIDDLE, p[1] * across, p[2] * across
    speeds = d[0] * along, d[1] * across, d[2] * across
    start, forward = (p[0] - low) * per_cell, 1 if d[0] > _ZERO else 0
    slope = _ONE / ((_F(1e-9) if abs(d[0]) < _F(1e-9) else d[0]) * per_cell)
    onward = p[1] * d[2] - p[2] * d[1] > _ZERO
    x = int(min(max(start, _ZERO), _F(N_X - 1)))
    fraction = p[1] / max(abs(p[1]) + abs(p[2]), _F(1e-30))
    wedge = min(max(int((_ONE - fraction if p[2] >= _ZERO else _F(3.0) + fraction) * _PER_TURN), 0), N_WEDGES - 1)
    place, best, which = _ZERO, _FAR, -1
    while True:
        end = x + forward
        leave_x = _FAR if end <= 0 or end >= N_X else (_F(end) - start) * slope
        (y0, z0), (y1, z1) = _edge(_F(wedge) / _PER_TURN), _edge(_F(wedge + 1) / _PER_TURN)
        y, z = (y1, z1) if onward else (y0, z0)
        speed = y * d[2] - z * d[1]
        leave_wedge = (z * p[1] - y * p[2]) / speed if (speed if onward else -speed) > _TINY else _FAR
        away = max(min(leave_x, leave_wedge), place)
        y, z = y0 + y1, z0 + z1
        deeper = y * d[1] + z * d[2]
        depth = y * p[1] + z * p[2] + deeper * (min(away, stop) if deeper > _ZERO else place)
        number = 2 * (first_cell + x * N_WEDGES + wedge)
        word = _W(cell[number + 1])
        if depth + _MARGIN >= _F(word & _W(0xFFFF)) * _UNIT:
            first = np.int64(cell[number])
            last = first + np.int64(word >> _W(16))
            best, which = _meet(vertex, entry, first, last, first_vertex, units, speeds, best, which)
        # A cell also lists what reaches beyond it, so that a later one may not be nearer.
        if best <= away or away >= stop:
            return best, which
        if leave_x <= leave_wedge:
            x += 2 * forward - 1
        else:
            wedge = (wedge + (1 if onward else N_WEDGES - 1)) % N_WEDGES
        place = away


@compiled
@no_type_check
def march_rows(results, operands, begin, end):
    """March the rays `begin` to `end` of a call: origin, direction, block, limit, a relief's arrays to `Hits`."""
    origin, direction = argument(operands, 0), argument(operands, 1)
    block, limit = argument(operands, 2).view(_I), argument(operands, 3)
    frame, link = argument(operands, 4), argument(operands, 5).view(_I)
    cell, entry = argument(operands, 6).view(_I), argument(operands, 7).view(_I)
    vertex, box = argument(operands, 8).view(_I), argument(operands, 9)
    found_at, n = addresses_at(results), len(block)
    distance, found, home = result(found_at[0], n), result(found_at[1], n).view(_I), result(found_at[2], n).view(_I)
    for ray in range(begin, end):
        here, reached, farthest = np.int64(block[ray]), _ZERO, limit[ray]
        hit, which, at_home = _FAR, -1, here
        going = farthest >= _ZERO
        while going:
            f, k = here * N_FRAME, here * N_LINK
            axes = _three(frame, f + 3), _three(frame, f + 6), _three(frame, f + 9)
            gap, way = _less(_three(origin, 3 * ray), _three(frame, f)), _three(direction, 3 * ray)
            o = _dot(axes[0], gap), _dot(axes[1], gap), _dot(axes[2], gap)
            d = _dot(axes[0], way), _dot(axes[1], way), _dot(axes[2], way)
            back, front = _leaving(frame, f + 12, o, d, -_ONE), _leaving(frame, f + 16, o, d, _ONE)
            leave, following = (front, link[k + 1]) if front <= back else (back, link[k])
            q = _on(o, reached, d)
            if (
                link[k + 5] > 0
                and q[2] + max(min(leave, farthest) - reached, _ZERO) * min(d[2], _ZERO) <= frame[f + 24]
            ):
                first = np.int64(link[k + 4])
                near, number = _meet_boxes(box, first, first + link[k + 5], q, d)
                if reached + near < hit:
                    hit, which, at_home = reached + near, -2 - number, here
            start = min(reached + _leap(frame[f + 25 :], q[1], q[2], d[1], d[2]), max(leave, reached))
            stop = min(min(leave, farthest), hit) - start
            if stop >= _ZERO:
                best, number = _cross_cells(
                    frame[f + 20 :], np.int64(link[k + 2]), np.int64(link[k + 3]), cell, entry, vertex,
                    _on(q, start - reached, d), d, stop,
                )  # fmt: skip
                if start + best < hit:
                    hit, which, at_home = start + best, number, here
            going = leave < min(farthest, hit) and following >= 0
            if going:
                here, reached = np.int64(following), leave
        distance[ray], found[ray], home[ray] = hit, which, at_home
