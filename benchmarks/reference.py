"""Reference for the planar LiDAR: float64 brute force against every segment of the tunnel's polylines.

NumPy on the host, sharing no code with the casting on the device; slow. The tests use it too.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial

import jax
import numpy as np

from subterra_jax import lidar
from subterra_jax.state import EnvParams
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.plan import TunnelPlan

# Numbers in one chunk of the table of rays by points; small enough to stay in a processor's cache.
_CHUNK = 200_000


def scan(
    segments: np.ndarray,
    position: np.ndarray,
    heading: np.ndarray,
    n_beams: int = 16,
    range_max: float = 30.0,
    turn: float = 0.0,
) -> np.ndarray:
    """Scans without noise.

    Args:
        segments: Wall segments `x0, y0, x1, y1`, m, `(m, 4)`; every one is tested against every beam.
        position: Positions of the LiDAR, m, `(n, 2)`.
        heading: Headings, rad, `(n,)`.
        n_beams: Beams, evenly spaced, the first straight ahead, the others counter-clockwise.
        range_max: Largest range, m.
        turn: Angle by which every beam is turned further, rad; to ask how sharply a range depends on it.

    Returns:
        Ranges, m, `(n, n_beams)`; `range_max` where a beam meets nothing within it.
    """
    angle = np.asarray(heading, np.float64)[:, None] + turn + np.arange(n_beams) * (2.0 * np.pi / n_beams)
    origin = np.repeat(np.asarray(position, np.float64), n_beams, axis=0)
    direction = np.stack([np.cos(angle).ravel(), np.sin(angle).ravel()], axis=-1)
    if n_beams % 2:
        return np.minimum(cast(segments, origin, direction)[0], range_max).reshape(-1, n_beams)
    # Opposite beams share a line, which halves the work.
    ahead = np.arange(len(origin)).reshape(-1, n_beams)[:, : n_beams // 2].ravel()
    forward, backward = cast(segments, origin[ahead], direction[ahead])
    both = np.concatenate([forward.reshape(-1, n_beams // 2), backward.reshape(-1, n_beams // 2)], axis=1)
    return np.minimum(both, range_max)


def cast(segments: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance along each line to the nearest segment ahead, and to the nearest behind.

    Args:
        segments: Segments `x0, y0, x1, y1`, m, `(m, 4)`.
        origin: Origins, m, `(n, 2)`.
        direction: Unit vectors, `(n, 2)`.

    Returns:
        Distances ahead and behind, m, both `(n,)` and not negative; `inf` where there is nothing.
    """
    segments = np.asarray(segments, np.float64)
    forward, backward = np.full(len(origin), np.inf), np.full(len(origin), np.inf)
    # Segments that begin where the last one ended share that point, which halves the work once more.
    joined = np.append(np.all(segments[1:, :2] == segments[:-1, 2:], axis=1), False)
    owner = np.repeat(np.arange(len(segments)), np.where(joined, 1, 2))
    is_end = np.append(owner[1:] != owner[:-1], True) & ~joined[owner]
    point = np.where(is_end[:, None], segments[owner, 2:], segments[owner, :2])
    chunk = max(1, _CHUNK // len(point))
    for first in range(0, len(origin), chunk):
        o, d = origin[first : first + chunk], direction[first : first + chunk]
        level = d[:, 0] * o[:, 1] - d[:, 1] * o[:, 0]
        # Not a matrix product: those are slow for three columns.
        left = d[:, 0, None] * point[:, 1] - d[:, 1, None] * point[:, 0] > level[:, None]
        crossed = left[:, 1:] != left[:, :-1]
        crossed[:, is_end[:-1]] = False
        ray, place = np.divmod(np.flatnonzero(crossed), len(point) - 1)
        distance = _intersect(segments[owner[place]], o[ray], d[ray])
        ahead = distance >= 0.0
        np.minimum.at(forward, first + ray[ahead], distance[ahead])
        np.minimum.at(backward, first + ray[~ahead], -distance[~ahead])
    return forward, backward


def _intersect(segment: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Signed distance along lines that are known to cross their segments."""
    a, b = segment[:, :2] - origin, segment[:, 2:] - origin
    side_a = direction[:, 0] * a[:, 1] - direction[:, 1] * a[:, 0]
    side_b = direction[:, 0] * b[:, 1] - direction[:, 1] * b[:, 0]
    fraction = side_a / (side_a - side_b)
    return np.sum((a + fraction[:, None] * (b - a)) * direction, axis=1)


def clearance(segments: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Distance from each position to the nearest segment, m, `(n,)`."""
    start, edge = segments[:, :2], segments[:, 2:] - segments[:, :2]
    nearest = np.empty(len(position))
    for i, p in enumerate(np.asarray(position, np.float64)):
        along = np.clip(np.sum((p - start) * edge, axis=1) / np.maximum(np.sum(edge * edge, axis=1), 1e-300), 0.0, 1.0)
        nearest[i] = np.sqrt(np.min(np.sum((start + along[:, None] * edge - p) ** 2, axis=1)))
    return nearest


def simulate(tunnel: Tunnel, poses: Poses, params: lidar.LidarParams, batch: int = 1000) -> np.ndarray:
    """Return the ranges that the LiDAR on this device has at some poses, m, `(n, n_beams)`, some poses at a time."""
    one = jax.jit(jax.vmap(partial(lidar.scan, params=params), in_axes=(None, 0, 0, 0)))
    parts = np.array_split(np.arange(len(poses.station)), -(-len(poses.station) // batch))
    ranges = [one(tunnel, poses.position[i], poses.heading[i], poses.station[i]) for i in parts]
    return np.concatenate([np.asarray(part) for part in ranges])


@dataclasses.dataclass(frozen=True)
class Agreement:
    """Agreement of ranges with the reference."""

    n_rays: int  # Rays compared
    max_error: float  # Largest error of the rays that are not ambiguous, m
    # Rays off by more than the tolerance whose range the reference itself gives when they are turned by up to 3e-6 rad:
    # they pass an edge, or graze a wall, more closely than float32 can say
    n_ambiguous: int
    n_wrong: int  # Rays off by more than the tolerance for no such reason


def agreement(segments: np.ndarray, poses: Poses, ranges: np.ndarray, tolerance: float = 1e-3) -> Agreement:
    """Compare ranges without noise, of `range_max` 30 m, with the reference.

    Args:
        segments: Wall segments, m, `(m, 4)`.
        poses: Where the scans were taken.
        ranges: The scans, m, `(n, n_beams)`.
        tolerance: Error from which on a ray counts as off, m.
    """
    n_beams = ranges.shape[1]
    error = np.abs(ranges - scan(segments, poses.position, poses.heading, n_beams))
    off = ~(error < tolerance)  # a range that is no number is off
    rows = np.flatnonzero(off.any(axis=1))
    turned = [
        np.abs(ranges[rows] - scan(segments, poses.position[rows], poses.heading[rows], n_beams, turn=turn))
        for turn in (-3e-6, -1e-6, -3e-7, 3e-7, 1e-6, 3e-6)
    ]
    excused = np.zeros_like(off)
    excused[rows] = off[rows] & (np.min(turned, axis=0) < tolerance)
    return Agreement(
        n_rays=error.size,
        max_error=float(error[~excused].max()),
        n_ambiguous=int(excused.sum()),
        n_wrong=int((off & ~excused).sum()),
    )


@dataclasses.dataclass(frozen=True)
class Poses:
    """Poses in a tunnel: `position (n, 2)` m, `heading (n,)` rad, `station (n,)` m, all exactly float32."""

    position: np.ndarray
    heading: np.ndarray
    station: np.ndarray


def random_poses(
    plan: TunnelPlan, n: int, rng: np.random.Generator, gap: float = 0.4, near_mouths: bool = False
) -> Poses:
    """Poses anywhere that a robot fits, at any heading.

    Args:
        plan: The tunnel.
        n: How many.
        rng: Source of randomness.
        gap: Least distance from the smooth walls, m.
        near_mouths: Draw stations from the two metres next to either mouth, and half a metre outside, only.
    """
    station = rng.uniform(0.0, plan.length, n)
    if near_mouths:
        depth = rng.uniform(-0.4, min(2.0, plan.length), n)
        station = np.where(rng.random(n) < 0.5, depth, plan.length - depth)

    def at(values: np.ndarray) -> np.ndarray:
        return np.interp(station, plan.station, values)

    tangent = np.stack([at(plan.tangent[:, 0]), at(plan.tangent[:, 1])], axis=-1)
    beyond = station - np.clip(station, 0.0, plan.length)
    lateral = (at(plan.half_width) - gap) * rng.uniform(-1.0, 1.0, n)
    centre = np.stack([at(plan.centre[:, 0]), at(plan.centre[:, 1])], axis=-1) + beyond[:, None] * tangent
    position = centre + lateral[:, None] * np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
    heading = rng.uniform(-np.pi, np.pi, n)
    return Poses(*(value.astype(np.float32) for value in (position, heading, station)))


def measure_exactness(
    plans: Sequence[TunnelPlan], lining: str | None, params: EnvParams, n_poses: int, seed: int
) -> Agreement:
    """Compares the LiDAR on this device with float64 brute force over every segment of the same walls.

    Args:
        plans: Whole tunnels.
        lining: Variant of their walls; None is the usual one of each.
        params: Params of an environment made of these tunnels, in this order.
        n_poses: Random poses, spread over the tunnels, 16 rays each.
        seed: Seed for the poses.
    """
    found = []
    for index, plan in enumerate(plans):
        poses = random_poses(plan, -(-n_poses // len(plans)), np.random.default_rng(seed + index))
        tunnel = params.tunnel.pick(index) if len(plans) > 1 else params.tunnel
        segments = plan.lining(lining or plan.default_lining).segments
        found.append(agreement(segments, poses, simulate(tunnel, poses, params.lidar)))
    return Agreement(
        n_rays=sum(each.n_rays for each in found),
        max_error=max(each.max_error for each in found),
        n_ambiguous=sum(each.n_ambiguous for each in found),
        n_wrong=sum(each.n_wrong for each in found),
    )
