"""The march of `lidar3d.march` for one ray after another on a CPU: each meets eight triangles or boxes at a time."""

from typing import no_type_check

import numpy as np
from numba import njit

from subterra_jax.lidar3d.cells import FACES, MARGIN, N_FACES, N_WEDGES, NEAR_UNIT, X_BITS
from subterra_jax.lidar3d.meeting import FINE, PAST, SEAM
from subterra_jax.lidar3d.relief import N_FRAME, N_LINK
from subterra_jax.native.frames import argument, result
from subterra_jax.native.gathers import load_corners, load_rows
from subterra_jax.native.lanes import (
    N_HALF,
    N_LANES,
    as_floats,
    first_set,
    fma,
    load,
    lowest,
    magnitude,
    negative,
    pick,
    repeat,
    where,
)

_F, _I = np.float32, np.int32
_ZERO, _ONE, _FAR, _TINY = _F(0.0), _F(1.0), _F(np.inf), _F(1e-12)
_PAST, _SEAM, _OVER, _MARGIN, _UNIT = _F(-PAST), _F(-SEAM), _F(1.0 + SEAM), _F(MARGIN), _F(NEAR_UNIT)
# Left and up of the faces, and as many as a vector has lanes.
_FACES = np.concatenate([*FACES.astype(np.float32).T])
if N_FACES != N_LANES:
    raise ImportError(f"the march of a CPU takes {N_LANES} faces of a prism at a time, and a relief has {N_FACES}")
_QUARTER = N_WEDGES // 4
_SHARE = _F(1.0 / _QUARTER)
_HALF = X_BITS // 2
_LOW_X, _MIDDLE, _FINE = _I((1 << _HALF) - 1), _F(1 << X_BITS - 1), _F(FINE)

compiled = njit(error_model="numpy", fastmath={"contract"}, forceinline=True)


@compiled
@no_type_check
def wedge_edge(number):
    """Return the direction in which a wedge begins, as `cells.wedge_edge`."""
    turn = number // _QUARTER
    share = _F(number - turn * _QUARTER) * _SHARE
    rest = _ONE - share
    if turn == 0:
        return rest, share
    if turn == 1:
        return -share, rest
    if turn == 2:
        return -rest, -share
    return share, -rest


@compiled
@no_type_check
def wedge_at(y, z):
    """Return the wedge in which a point lies, as `cells.wedge_place`."""
    size = max(abs(y) + abs(z), _F(1e-30))
    turn = (0 if y > _ZERO else 1) if z >= _ZERO else (2 if y < _ZERO else 3)
    part = abs(y) if turn & 1 else abs(z)
    wedge = turn * _QUARTER + int(part / size * _F(_QUARTER))
    return 0 if wedge >= N_WEDGES else wedge


@compiled
@no_type_check
def leaving(frame, at, ox, oy, oz, dx, dy, dz, outwards):
    """Return the distance at which a ray leaves through a plane, m; `inf` if it runs along it or the other way."""
    speed = frame[at] * dx + frame[at + 1] * dy + frame[at + 2] * dz
    if outwards * speed > _F(1e-9):
        return (frame[at + 3] - (frame[at] * ox + frame[at + 1] * oy + frame[at + 2] * oz)) / speed
    return _FAR


@compiled
@no_type_check
def point(one, two):
    """Return eight vertices in units of their relief: along the axis, and `FINE` parts of them across it."""
    x = ((one & _LOW_X) << _I(_HALF)) | (two & _LOW_X)
    return as_floats(x), as_floats(one), as_floats(two)


@compiled
@no_type_check
def minor(a, b, c, d):
    """Return a · b − c · d."""
    return fma(a, b, negative(c * d))


@compiled
@no_type_check
def meet(vertex, entry, first, count, first_vertex, ox, oy, oz, dx, dy, dz, hit, which):
    """Compare a ray with the triangles of a list; return the nearest distance, m, and its entry."""
    best, batch, last = repeat(_FAR), repeat(_I(-1)), first + count - 1
    for i in range(first, first + count, N_HALF):
        one, one_x, two, two_x, three, three_x = load_corners(vertex, entry, i, last, first_vertex)
        x, y, z = point(one, one_x)
        ax, ay, az = point(two, two_x)
        bx, by, bz = point(three, three_x)
        ax, ay, az, bx, by, bz = ax - x, ay - y, az - z, bx - x, by - y, bz - z
        gx, gy, gz = ox - x, oy - y, oz - z
        px, py, pz = minor(bz, dy, by, dz), minor(bx, dz, bz, dx), minor(by, dx, bx, dy)
        qx, qy, qz = minor(gy, az, gz, ay), minor(gz, ax, gx, az), minor(gx, ay, gy, ax)
        inverse = _ONE / fma(ax, px, fma(ay, py, az * pz))
        u = fma(gx, px, fma(gy, py, gz * pz)) * inverse
        v = fma(qx, dx, fma(qy, dy, qz * dz)) * inverse
        t = fma(bx, qx, fma(by, qy, bz * qz)) * inverse
        meets = (u >= _SEAM) & (v >= _SEAM) & (u + v <= _OVER) & (t >= _PAST) & (t < best)
        best, batch = where(meets, t, best), where(meets, _I(i), batch)
    nearest = lowest(best)
    if nearest < hit:
        lane = np.intp(first_set(best == nearest))
        return nearest, min(np.int64(pick(batch, lane)) + lane, last)
    return hit, which


@compiled
@no_type_check
def meet_boxes(box, first, count, ox, oy, oz, dx, dy, dz):
    """Compare a ray with the boxes of a list; return the nearest distance, m, and the box's number."""
    best, batch, last = repeat(_FAR), repeat(_I(-1)), first + count - 1
    for i in range(first, first + count, N_HALF):
        enter, leave = repeat(-_FAR), repeat(_FAR)
        for side in range(3):
            a, b, c, middle = load_rows(box, i, last, side)
            speed = fma(a, dx, fma(b, dy, c * dz))
            slope = _ONE / where(magnitude(speed) < _TINY, _TINY, speed)
            middle = (middle - fma(a, ox, fma(b, oy, c * oz))) * slope
            half = magnitude(slope)
            enter, leave = greater(enter, middle - half), less(leave, middle + half)
        t = where(enter >= _PAST, enter, leave)
        meets = (enter <= leave) & (t >= _PAST) & (t < best)
        best, batch = where(meets, t, best), where(meets, _I(i), batch)
    nearest = lowest(best)
    if nearest < _FAR:
        lane = np.intp(first_set(best == nearest))
        return nearest, min(np.int64(pick(batch, lane)) + lane, last)
    return _FAR, -1


@compiled
@no_type_check
def greater(a, b):
    """Return the greater of two numbers, lane by lane."""
    return where(a > b, a, b)


@compiled
@no_type_check
def less(a, b):
    """Return the lesser of two numbers, lane by lane."""
    return where(a < b, a, b)


@compiled
@no_type_check
def leap(frame, f, y, z, dy, dz):
    """Return how far a ray stays in the block's prism, in which there is nothing, m; 0 if it is not in it."""
    left, up = load(_FACES, 0), load(_FACES, N_LANES)
    gap = load(frame, f) - fma(left, y, up * z)
    if lowest(gap) < _ZERO:
        return _ZERO
    speed = fma(left, dy, up * dz)
    return lowest(where(speed > _TINY, gap / speed, _F(1e9)))


@compiled
@no_type_check
def turn_into(frame, f, x, y, z):
    """Return a vector in a block's frame."""
    return (
        frame[f + 3] * x + frame[f + 4] * y + frame[f + 5] * z,
        frame[f + 6] * x + frame[f + 7] * y + frame[f + 8] * z,
        frame[f + 9] * x + frame[f + 10] * y + frame[f + 11] * z,
    )


@compiled
@no_type_check
def step_wedge(wedge, onward):
    """Return the number of the wedge beside one."""
    if onward:
        return 0 if wedge + 1 == N_WEDGES else wedge + 1
    return N_WEDGES - 1 if wedge == 0 else wedge - 1


@compiled
@no_type_check
def march_block(frame, f, link, here, cell, entry, vertex, n_x, px, py, pz, dx, dy, dz, stop):
    """March a ray through the cells of one block.

    Args:
        frame: Frames of the relief's blocks; `link`, `cell`, `entry` and `vertex` are the relief's as well.
        f: First number of this block's frame.
        link: Links of the blocks.
        here: This block.
        cell: Cells.
        entry: Entries.
        vertex: Vertices.
        n_x: Cells of a block along the axis.
        px: Place along the axis at which the march begins, block's frame, m.
        py: Place to the left, m.
        pz: Place upwards, m.
        dx: Direction along the axis.
        dy: Direction to the left.
        dz: Direction upwards.
        stop: Largest distance of interest, m; below 0 no cell is looked at.

    Returns:
        Distance to the first triangle, m, `inf` where there is none; and its entry, -1 where there is none.
    """
    low, per_cell, along, across = frame[f + 20], frame[f + 21], frame[f + 22], frame[f + 23]
    pitch = _ONE / per_cell
    across *= _FINE
    ux, uy, uz, vx, vy, vz = px * along + _MIDDLE, py * across, pz * across, dx * along, dy * across, dz * across
    first_vertex, first_cell = np.int64(link[N_LINK * here + 2]), np.int64(link[N_LINK * here + 3])
    forward, onward = dx > _ZERO, py * dz - pz * dy > _ZERO
    slope = _ONE / (_F(1e-9) if abs(dx) < _F(1e-9) else dx)
    x = int(min(max(np.floor((px - low) * per_cell), _ZERO), _F(n_x - 1)))
    wedge = wedge_at(py, pz)
    place, best, chosen = _ZERO, _FAR, -1
    inside = stop >= _ZERO
    while inside:
        edge = x + (1 if forward else 0)
        leave_x = _FAR if edge <= 0 or edge >= n_x else (low + _F(edge) * pitch - px) * slope
        y0, z0 = wedge_edge(wedge)
        y1, z1 = wedge_edge(step_wedge(wedge, True))
        y, z = (y1, z1) if onward else (y0, z0)
        speed = y * dz - z * dy
        leave_wedge = _FAR
        if (speed if onward else -speed) > _TINY:
            leave_wedge = -(y * pz - z * py) / speed
        away = max(min(leave_x, leave_wedge), place)
        y, z = y0 + y1, z0 + z1
        deeper = y * dy + z * dz
        depth = y * py + z * pz + deeper * (min(away, stop) if deeper > _ZERO else place)
        number = 2 * (first_cell + x * N_WEDGES + wedge)
        word = np.uint32(cell[number + 1])
        if depth + _MARGIN >= _F(word & np.uint32(0xFFFF)) * _UNIT:
            best, chosen = meet(
                vertex, entry, np.int64(cell[number]), np.int64(word >> np.uint32(16)), first_vertex,
                ux, uy, uz, vx, vy, vz, best, chosen,
            )  # fmt: skip
        if not (away < stop and best > away):
            inside = False
        elif leave_x <= leave_wedge:
            x += 1 if forward else -1
        else:
            wedge = step_wedge(wedge, onward)
        place = away
    return best, chosen


@compiled
@no_type_check
def _ints(call, i):
    return argument(call, i).view(_I)


@njit(error_model="numpy", fastmath={"contract"})
@no_type_check
def march_rows(call, begin, end):
    """March the rays `begin` to `end` of a call: origin, direction, block, limit, a relief's arrays, n_x to `Hits`."""
    origin, direction, block, limit = argument(call, 0), argument(call, 1), _ints(call, 2), argument(call, 3)
    frame, link, cell, entry, vertex = (
        argument(call, 4),
        _ints(call, 5),
        _ints(call, 6),
        _ints(call, 7),
        _ints(call, 8),
    )
    box, n_x = argument(call, 9), _ints(call, 10)[0]
    distance, found, home = result(call, 0), result(call, 1).view(_I), result(call, 2).view(_I)
    for ray in range(begin, end):
        here, reached, hit, which, at_home = np.int64(block[ray]), _ZERO, _FAR, -1, np.int64(block[ray])
        farthest = limit[ray]
        going = farthest >= _ZERO
        while going:
            f = here * N_FRAME
            ox, oy, oz = turn_into(
                frame, f, origin[3 * ray] - frame[f], origin[3 * ray + 1] - frame[f + 1],
                origin[3 * ray + 2] - frame[f + 2],
            )  # fmt: skip
            dx, dy, dz = turn_into(frame, f, direction[3 * ray], direction[3 * ray + 1], direction[3 * ray + 2])
            back = leaving(frame, f + 12, ox, oy, oz, dx, dy, dz, -_ONE)
            front = leaving(frame, f + 16, ox, oy, oz, dx, dy, dz, _ONE)
            leave, following = (front, link[N_LINK * here + 1]) if front <= back else (back, link[N_LINK * here])
            qx, qy, qz = ox + reached * dx, oy + reached * dy, oz + reached * dz
            start = min(reached + leap(frame, f + 25, qy, qz, dy, dz), max(leave, reached))
            px, py, pz = ox + start * dx, oy + start * dy, oz + start * dz
            farther = max(min(leave, farthest) - reached, _ZERO)
            if qz + farther * min(dz, _ZERO) <= frame[f + 24] and link[N_LINK * here + 5] > 0:
                nearest, number = meet_boxes(
                    box, np.int64(link[N_LINK * here + 4]), np.int64(link[N_LINK * here + 5]),
                    qx, qy, qz, dx, dy, dz,
                )  # fmt: skip
                if reached + nearest < hit:
                    hit, which, at_home = reached + nearest, -2 - number, here
            best, chosen = march_block(
                frame, f, link, here, cell, entry, vertex, n_x, px, py, pz, dx, dy, dz,
                min(min(leave, farthest), hit) - start,
            )  # fmt: skip
            if start + best < hit:
                hit, which, at_home = start + best, chosen, here
            going = leave < min(farthest, hit) and following >= 0
            if going:
                here, reached = np.int64(following), leave
        distance[ray], found[ray], home[ray] = hit, which, at_home
