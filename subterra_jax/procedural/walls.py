"""Walls along a centreline: how far they are from it, their recesses, and furniture beside them."""

import numpy as np
from jaxtyping import Float

from subterra_jax.procedural.alignment import Alignment
from subterra_jax.tunnel.plan import Wall

_FINE = 8  # samples of a random course in one correlation length
_END = 0.1  # of a tunnel, where there are no recesses, m
BRACKET, POST, RAIL, AIR = 0.05, 0.05, 0.15, 0.01  # sides of both; gaps behind posts and brackets, m


def wander(
    rng: np.random.Generator, station: Float[np.ndarray, " n"], sd: float, correlation: float
) -> Float[np.ndarray, " n"]:
    """A smooth random course along the tunnel: Gaussian, with covariance `sd² exp(−d² / correlation²)`.

    Args:
        rng: Source of randomness.
        station: Where it is wanted, m, growing.
        sd: Its standard deviation, in the unit of the result.
        correlation: Its correlation length, m.
    """
    step = correlation / _FINE
    reach = 3 * _FINE
    at = station[0] + step * np.arange(-reach, int((station[-1] - station[0]) / step) + reach + 3)
    # Covariances add their squares: a kernel of half the square of the correlation length.
    kernel = np.exp(-2.0 * (np.arange(-reach, reach + 1) / _FINE) ** 2)
    noise = np.convolve(rng.standard_normal(len(at) + 2 * reach), kernel / np.linalg.norm(kernel), mode="valid")
    return sd * np.interp(station, at, noise)


def wall(
    alignment: Alignment, side: float, station: Float[np.ndarray, " n"], distance: Float[np.ndarray, " n"]
) -> Wall:
    """A wall `distance` metres to the left (`side` 1) or right (−1) of the centreline."""
    return Wall(vertex=alignment.offset(station, side * distance), station=station)


def recess_starts(
    rng: np.random.Generator, joint: Float[np.ndarray, " j"], offset: float, length: float, missing: float, end: float
) -> Float[np.ndarray, " p"]:
    """Where the recesses of one row begin: two for each joint, but for those that are missing, m.

    Args:
        rng: Source of randomness.
        joint: Ring joints, m.
        offset: Of a recess's middle from its joint, m.
        length: Of a recess, m.
        missing: Share that is missing.
        end: Length of the tunnel, m; recesses that it would cut are missing too.
    """
    starts = (joint[:, None] + np.array([-offset, offset]) - 0.5 * length).ravel()
    there = rng.random(len(starts)) >= missing
    return starts[there & (starts > _END) & (starts + length < end - _END)]


def recessed(
    station: Float[np.ndarray, " n"], distance: Float[np.ndarray, " n"], start: Float[np.ndarray, " p"],
    length: float, depth: float,
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:  # fmt: skip
    """A wall with recesses cut into it, each with its four corners as vertices and its sides across the tunnel.

    Args:
        station: Of the smooth wall's vertices, m.
        distance: From the centreline, m.
        start: Where the recesses begin, m, growing; they do not overlap.
        length: Along the wall, m.
        depth: Into the wall, m.

    Returns:
        Station and distance of the vertices, m.
    """
    end = start + length
    at_start, at_end = np.interp(start, station, distance), np.interp(end, station, distance)
    corner_station = np.stack([start, start, end, end], axis=1).ravel()
    corner_distance = np.stack([at_start, at_start + depth, at_end + depth, at_end], axis=1).ravel()
    # Between the start and the end of one recess, or a hair from them, no vertex of the smooth wall stays.
    began = np.searchsorted(start - 1e-6, station, side="right")
    ended = np.searchsorted(end + 1e-6, station, side="left")
    kept = began == ended
    all_station = np.concatenate([station[kept], corner_station])
    order = np.argsort(all_station, kind="stable")
    return all_station[order], np.concatenate([distance[kept], corner_distance])[order]


def outlines(
    alignment: Alignment, station: Float[np.ndarray, " f"], near: Float[np.ndarray, " f"],
    far: Float[np.ndarray, " f"], length: float,
) -> Float[np.ndarray, "g 4"]:  # fmt: skip
    """Closed outlines of boxes beside the centreline as segments `x0, y0, x1, y1`, m.

    Args:
        alignment: The centreline.
        station: Of the boxes' middles, m.
        near: One side of each, m to the left of the centreline.
        far: The other.
        length: Of each along the tunnel, m.
    """
    before, after = station - 0.5 * length, station + 0.5 * length
    corners = [alignment.offset(s, d) for s, d in ((before, near), (after, near), (after, far), (before, far))]
    outline = np.stack(corners, axis=1)
    return np.concatenate([outline, np.roll(outline, -1, axis=1)], axis=2).reshape(-1, 4)
