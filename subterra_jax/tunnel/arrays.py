"""Tunnels from arrays: a centreline with half widths and pockets, or two walls as polylines.

Everything is checked on the host. A mistake is one sentence that names the array and the place.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from subterra_jax.host.errors import TunnelError
from subterra_jax.host.texture import texture_seed
from subterra_jax.tunnel.distances import crossings, gaps_near
from subterra_jax.tunnel.plan import Lining, TunnelPlan, Wall

ArrayLike = Any  # a number, an array or nested lists of numbers

ROBOT_RADIUS = 0.4  # m, of `VehicleParams`
_SPACING = 0.25  # m, of the station grid
_UNEVEN = 5.0  # m: a smooth wall is the median over this length, so that pockets do not move it
_BACK = 1.0  # m, that a wall may run backwards, as in the corner of a niche
_SHORT = 3.0  # m, that a wall may end before or behind a mouth, as in a skew portal


def from_centreline(
    xy: ArrayLike,
    half_width: ArrayLike,
    *,
    pockets: ArrayLike = (),
    name: str = "from arrays",
    elevation: ArrayLike = 0.0,
    lidar_height: float = 0.6,
    ring_pitch: float = 0.0,
) -> TunnelPlan:
    """Make a tunnel from its centreline and half widths.

    Args:
        xy: Vertices of the centreline in the direction of growing station, m, `(n, 2)`. They are joined by straight
            lines, so give a bend about one vertex per metre.
        half_width: Distance from the centreline to either wall, m, one number or `(n,)`.
        pockets: Rows of station of the middle (m), side (1 left, -1 right), length (m) and depth (m), `(p, 4)`.
        name: Name of the tunnel.
        elevation: Height of the ground, m, one number or `(n,)`.
        lidar_height: Height of the LiDAR plane above the ground, m.
        ring_pitch: Distance between ring joints, m; 0 if there are none.

    Returns:
        A plan with the lining `smooth`, and `pockets` if there are any. `st.make` takes it as `tunnel=`.

    Raises:
        TunnelError: An array is malformed, or the tunnel cannot be driven; see `docs/guide`.
    """
    plan = _bare_plan(xy, half_width, name, elevation, lidar_height, ring_pitch)
    distance = {side: plan.half_width for side in (1.0, -1.0)}
    linings = {"smooth": _offset_lining(plan, {side: (plan.station, plan.half_width) for side in distance})}
    rows = _numbers("pockets", np.reshape(pockets, (0, 4)) if np.size(pockets) == 0 else pockets, (None, 4))
    if len(rows):
        _check_pockets(rows, plan.length)
        cut = {}
        for side in distance:
            middle, _, length, depth = rows[rows[:, 1] == side].T
            cut[side] = cut_pockets(plan.station, plan.half_width, middle - 0.5 * length, length, depth)
        linings["pockets"] = _offset_lining(plan, cut)
    plan.linings.update(linings)
    return _check_drivable(plan)


def from_polylines(
    left: ArrayLike,
    right: ArrayLike,
    *,
    centreline: ArrayLike | None = None,
    furniture: ArrayLike = (),
    lining: str = "smooth",
    name: str = "from arrays",
    elevation: ArrayLike = 0.0,
    lidar_height: float = 0.6,
    ring_pitch: float = 0.0,
) -> TunnelPlan:
    """Make a tunnel from its two walls.

    Args:
        left: Vertices of the left wall in the direction of growing station, m, `(k, 2)`; pockets and niches included.
        right: Vertices of the right wall in the same direction, m, `(m, 2)`.
        centreline: Vertices of the centreline, m, `(n, 2)`; the line midway between the walls if `None`.
        furniture: Further wall segments `x0, y0, x1, y1`, m, `(f, 4)`.
        lining: Name of this variant of the walls.
        name: Name of the tunnel.
        elevation: Height of the ground, m, one number or `(n,)`.
        lidar_height: Height of the LiDAR plane above the ground, m.
        ring_pitch: Distance between ring joints, m; 0 if there are none.

    Raises:
        TunnelError: An array is malformed, or the tunnel cannot be driven; see `docs/guide`.
    """
    walls = {side: _numbers(side, values, (None, 2)) for side, values in (("left", left), ("right", right))}
    for side, vertex in walls.items():
        if len(vertex) < 2:
            raise TunnelError(f"{side} needs at least 2 vertices, got {len(vertex)}")
    extra = _numbers("furniture", np.reshape(furniture, (0, 4)) if np.size(furniture) == 0 else furniture, (None, 4))
    xy = _midline(walls["left"], walls["right"]) if centreline is None else centreline
    plan = _bare_plan(xy, 1.0, name, elevation, lidar_height, ring_pitch)
    plan.half_width[:] = _half_widths(plan, walls)
    plan.linings[lining] = Lining(_wall(plan, "left", walls["left"]), _wall(plan, "right", walls["right"]), extra)
    return _check_drivable(plan)


def cut_pockets(
    station: Float[np.ndarray, " n"],
    distance: Float[np.ndarray, " n"],
    start: Float[np.ndarray, " p"],
    length: Float[np.ndarray, " p"] | float,
    depth: Float[np.ndarray, " p"] | float,
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Cut pockets into a wall, each with four corners and its sides across the tunnel.

    Args:
        station: Stations of the smooth wall's vertices, m.
        distance: Their distances from the centreline, m.
        start: Stations at which the pockets begin, m, growing; they must not overlap.
        length: Length along the wall, m.
        depth: Depth into the wall, m.

    Returns:
        Stations and distances of the new vertices, m.
    """
    end = start + length
    at_start, at_end = np.interp(start, station, distance), np.interp(end, station, distance)
    corner_station = np.stack([start, start, end, end], axis=1).ravel()
    corner_distance = np.stack([at_start, at_start + depth, at_end + depth, at_end], axis=1).ravel()
    # No vertex of the smooth wall stays between the start and the end of a pocket, or within 1e-6 m of them.
    began = np.searchsorted(start - 1e-6, station, side="right")
    ended = np.searchsorted(end + 1e-6, station, side="left")
    kept = began == ended
    all_station = np.concatenate([station[kept], corner_station])
    order = np.argsort(all_station, kind="stable")
    return all_station[order], np.concatenate([distance[kept], corner_distance])[order]


def _numbers(name: str, values: ArrayLike, shape: tuple[int | None, ...]) -> np.ndarray:
    """Return a finite float64 array of a shape, in which `None` stands for any length."""
    try:
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError) as error:
        raise TunnelError(f"{name} must hold numbers ({error})") from error
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        needed = ", ".join("n" if n is None else str(n) for n in shape)
        raise TunnelError(f"{name} must have shape ({needed}), got {array.shape}")
    if not np.all(np.isfinite(array)):
        place = f" at index {np.argwhere(~np.isfinite(array))[0].tolist()}" if array.ndim else ""
        raise TunnelError(f"{name} is not finite{place}")
    return array


def _per_vertex(name: str, values: ArrayLike, n: int) -> Float[np.ndarray, " n"]:
    array = _numbers(name, values, (None,) if np.ndim(values) else ())
    if array.ndim and len(array) != n:
        raise TunnelError(f"{name} has {len(array)} values, the centreline {n} vertices")
    return np.broadcast_to(array, (n,))


def _bare_plan(
    xy: ArrayLike,
    half_width: ArrayLike,
    name: str,
    elevation: ArrayLike,
    lidar_height: float,
    ring_pitch: float,
) -> TunnelPlan:
    """Return a plan without walls: the centreline on its uniform station grid."""
    vertex = _numbers("centreline", xy, (None, 2))
    n = len(vertex)
    if n < 2:
        raise TunnelError(f"centreline needs at least 2 vertices, got {n}")
    width, height = _per_vertex("half_width", half_width, n), _per_vertex("elevation", elevation, n)
    if width.min() <= ROBOT_RADIUS:
        raise TunnelError(
            f"the corridor is narrower than the robot: half_width is {width.min():.2f} m at index "
            f"{int(np.argmin(width))}, the robot's radius {ROBOT_RADIUS} m"
        )
    at = _distances_along(vertex)
    station = np.linspace(0.0, at[-1], max(2, round(at[-1] / _SPACING) + 1))

    def along(values: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(station, at, column) for column in values.T], axis=-1)

    centre = along(vertex)
    directions = np.gradient(centre, axis=0)
    return TunnelPlan(
        name=name,
        provenance="simulated",
        station=station,
        centre=centre,
        tangent=directions / np.linalg.norm(directions, axis=1, keepdims=True),
        elevation=np.interp(station, at, height),
        half_width=np.interp(station, at, width),
        lidar_height=float(_numbers("lidar_height", lidar_height, ())),
        linings={},
        ring_pitch=float(_numbers("ring_pitch", ring_pitch, ())),
        texture=texture_seed(name),
    )


def _distances_along(vertex: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Return the distance of each vertex along a centreline, m, which may not repeat a vertex or double back."""
    step = np.diff(vertex, axis=0)
    size = np.linalg.norm(step, axis=1)
    if np.any(size < 1e-6):
        raise TunnelError(f"centreline repeats the vertex at index {int(np.argmax(size < 1e-6))}")
    back = np.sum(step[1:] * step[:-1], axis=1) <= 0.0
    if np.any(back):
        corner = int(np.argmax(back)) + 1
        raise TunnelError(f"centreline doubles back at index {corner}, or has a corner of 90 degrees there")
    return np.concatenate([[0.0], np.cumsum(size)])


def _offset_lining(plan: TunnelPlan, distances: dict[float, tuple[np.ndarray, np.ndarray]]) -> Lining:
    """Return the lining whose walls stand at distances from the centreline; 1 is the left side, -1 the right."""
    walls = []
    for side, (station, distance) in distances.items():
        centre, tangent = (
            np.stack([np.interp(station, plan.station, column) for column in values.T], axis=-1)
            for values in (plan.centre, plan.tangent)
        )
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1) / np.linalg.norm(tangent, axis=1)[:, None]
        vertex = centre + side * distance[:, None] * normal
        folded = np.sum(np.diff(vertex, axis=0) * tangent[:-1], axis=1) < -1e-9
        if np.any(folded):
            place = station[int(np.argmax(folded))]
            raise TunnelError(f"the bend at station {place:.1f} m is tighter than the half width: the inner wall folds")
        walls.append(Wall(vertex, station))
    return Lining(walls[0], walls[1], np.zeros((0, 4)))


def _check_pockets(rows: Float[np.ndarray, "p 4"], length: float) -> None:
    """Check that pockets lie on a wall, have a size and do not overlap."""
    if not np.all(np.isin(rows[:, 1], (1.0, -1.0))):
        raise TunnelError(f"the side of a pocket must be 1 (left) or -1 (right), got {rows[:, 1].tolist()}")
    if not np.all(rows[:, 2:] > 0.0):
        raise TunnelError("length and depth of a pocket must be positive")
    for side in (1.0, -1.0):
        middle, _, size, _ = rows[rows[:, 1] == side].T
        start, end = middle - 0.5 * size, middle + 0.5 * size
        if np.any(start[1:] <= end[:-1]):
            raise TunnelError(f"pockets {int(np.argmax(start[1:] <= end[:-1]))} and the next of a side overlap, or are "
                              "not in order of station")  # fmt: skip
        if np.any((start <= 0.0) | (end >= length)):
            raise TunnelError(f"a pocket lies outside the tunnel's 0..{length:.1f} m")


def _smooth(values: Float[np.ndarray, " n"], spacing: float) -> Float[np.ndarray, " n"]:
    """Return the median over `_UNEVEN` metres; values that are not finite are filled from their neighbours."""
    known = np.flatnonzero(np.isfinite(values))
    filled = np.interp(np.arange(len(values)), known, values[known])
    beside = round(0.5 * _UNEVEN / spacing)
    padded = np.pad(filled, beside, mode="edge")
    return np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * beside + 1), axis=-1)


def _midline(left: Float[np.ndarray, "k 2"], right: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "n 2"]:
    """Return the line midway between two walls, one vertex per metre."""
    if np.linalg.norm(left[0] - right[0]) > np.linalg.norm(left[0] - right[-1]):
        raise TunnelError("left and right run in opposite directions: list both in the direction of growing station")

    def even(vertex: np.ndarray, n: int) -> np.ndarray:
        at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(vertex, axis=0), axis=1))])
        return np.stack([np.interp(np.linspace(0.0, at[-1], n), at, column) for column in vertex.T], axis=-1)

    n = max(3, round(float(np.linalg.norm(np.diff(left, axis=0), axis=1).sum())) + 1)
    line = 0.5 * (even(left, n) + even(right, n))
    around = min(round(_UNEVEN), n - 1)
    mean = np.full(2 * around + 1, 1.0 / (2 * around + 1))
    for _ in range(6):
        # A niche moves the line aside: a moving average, odd about the ends, calms it before it is centred again.
        padded = np.pad(line, ((around, around), (0, 0)), mode="reflect", reflect_type="odd")
        line = even(np.stack([np.convolve(column, mean, "valid") for column in padded.T], axis=-1), n)
        spacing = float(np.linalg.norm(line[1] - line[0]))
        if spacing < 1e-6:
            raise TunnelError("left and right are the same line")
        tangent = np.gradient(line, axis=0)
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1) / np.linalg.norm(tangent, axis=1, keepdims=True)
        to_left, to_right = _reaches(line, normal, left, right)
        with np.errstate(invalid="ignore"):  # where neither wall is met, which is left out
            aside = 0.5 * (to_left - to_right)
        line = line + _smooth(aside, spacing)[:, None] * normal
    return line


def _half_widths(plan: TunnelPlan, walls: dict[str, np.ndarray]) -> Float[np.ndarray, " n"]:
    """Return half the distance between two walls across the tunnel, m, with pockets smoothed out."""
    normal = np.stack([-plan.tangent[:, 1], plan.tangent[:, 0]], axis=-1)
    to_left, to_right = _reaches(plan.centre, normal, walls["left"], walls["right"])
    return _smooth(0.5 * (to_left + to_right), plan.station[1])


def _reaches(
    centre: Float[np.ndarray, "n 2"], normal: Float[np.ndarray, "n 2"], left: np.ndarray, right: np.ndarray
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the distances across the tunnel to the left and right walls, m; `inf` where there is none."""
    to_left, to_right = crossings(centre, normal, left), crossings(centre, -normal, right)
    if not np.isfinite(to_left + to_right).any():
        swapped = np.isfinite(crossings(centre, -normal, left) + crossings(centre, normal, right)).any()
        raise TunnelError("left and right are swapped" if swapped else "the walls are not beside the centreline")
    return to_left, to_right


def _wall(plan: TunnelPlan, name: str, vertex: Float[np.ndarray, "k 2"]) -> Wall:
    from scipy.spatial import KDTree  # half a second to import, and only tunnels by hand need it

    node = KDTree(plan.centre).query(vertex)[1]
    station = plan.station[node] + np.sum((vertex - plan.centre[node]) * plan.tangent[node], axis=1)
    behind = np.maximum.accumulate(station) - station
    if np.any(behind > _BACK):
        raise TunnelError(f"{name} doubles back at index {int(np.argmax(behind > _BACK))}")
    if station[0] > _SHORT or station[-1] < plan.length - _SHORT:
        raise TunnelError(
            f"{name} goes from station {station[0]:.1f} to {station[-1]:.1f} m, the centreline to {plan.length:.1f} m"
        )
    return Wall(vertex, np.maximum.accumulate(station))


def _check_drivable(plan: TunnelPlan) -> TunnelPlan:
    """Return the plan itself if a robot can drive along it.

    Raises:
        TunnelError: It comes back to itself, a wall stands across it, or it is narrower than the robot.
    """
    from scipy.spatial import KDTree  # as above

    widest = float(plan.half_width.max())
    tree, every = KDTree(plan.centre), max(1, round(1.0 / plan.station[1]))
    for i in range(0, len(plan.station), every):
        near = np.array(tree.query_ball_point(plan.centre[i], 2.0 * plan.half_width[i]))
        apart = plan.station[near] - plan.station[i]
        if np.any(apart > 2.0 * np.pi * widest):
            there = plan.station[near[np.argmax(apart)]]
            raise TunnelError(f"centreline comes back to itself: stations {plan.station[i]:.0f} and {there:.0f} m meet")
    for lining in plan.linings.values():
        gap = gaps_near(tree, lining.segments, ROBOT_RADIUS)
        at, least = plan.station[int(np.argmin(gap))], float(gap.min())
        if least <= 0.5 * plan.station[1]:
            raise TunnelError(f"a wall stands across the way at station {at:.1f} m")
        if least <= ROBOT_RADIUS:
            raise TunnelError(
                f"the corridor is narrower than the robot: at station {at:.1f} m a wall is {least:.2f} m from the "
                f"centreline, the robot's radius is {ROBOT_RADIUS} m"
            )
    return plan
