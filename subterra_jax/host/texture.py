"""Brightness of a wall from place to place: one function for the batch, the simulated survey and pictures.

It is fixed to the wall, a product of what is cast, what runs down it and what was painted on it. NumPy and JAX give the
same numbers. All sizes are ours: published ones are of single tunnels. Rock and sprayed concrete have no pattern of
their own.
"""

import zlib
from types import ModuleType
from typing import Any

import numpy as np

AXIS_HEIGHT = 1.5  # m above the ground, of the axis that angles are measured about
RING, SEGMENTS = 1.5, 6  # m of a ring; segments round it, staggered by half from ring to ring
_ROUND = 17.6  # m round the wall, of a radius of 2.8 m
# Cells along and round (m), spread of the logarithm: patches of damp, soot and repair, then grain; streaks are upright.
_PATCHES = ((2.0, 2.0, 0.2), (0.5, 0.5, 0.25), (0.16, 0.16, 0.3))
_STREAK, _STREAK_DEPTH = (0.25, 1.5), 0.5  # they only darken
_CAST = 0.2  # spread between segments
_JOINT_HALF, _JOINT_DEPTH = 0.03, 0.5  # m; of the logarithm
_MARK, _MARK_SHARE, _MARK_SIZE = 0.3, 0.02, 0.6  # m of a painted mark; share of the wall; of the logarithm


def check_dial(texture: float) -> None:
    """Refuse a dial that is not between 0 and 1.

    Raises:
        ValueError: It is not.
    """
    if not 0.0 <= texture <= 1.0:
        raise ValueError(f"texture must lie between 0 and 1, got {texture:g}")


def texture_seed(name: str) -> int:
    """Return the seed of the texture of a tunnel by its name."""
    return zlib.crc32(name.encode()) & 0x7FFFFFFF


def wall_angle(xp: ModuleType, left: Any, above: Any) -> Any:
    """Return angles round the wall, rad: 0 at the crown, growing to the left.

    Args:
        xp: `numpy` or `jax.numpy`.
        left: Distance to the left of the axis, m.
        above: Height above the ground, m.
    """
    return xp.arctan2(left, above - AXIS_HEIGHT)


def brightness(xp: ModuleType, station: Any, angle: Any, seed: Any, texture: Any) -> Any:
    """Return factors on the reflectivity of a lining, about 1.

    Args:
        xp: `numpy` or `jax.numpy`.
        station: Stations, m.
        angle: Angles of `wall_angle`, rad.
        seed: Number of the tunnel's texture.
        texture: Dial, from 0, everywhere exactly 1, to 1, an old, wet metro.
    """
    station, angle = xp.asarray(station, np.float32), xp.asarray(angle, np.float32)
    turn = angle * np.float32(0.5 / np.pi) + np.float32(0.5)
    hashed = _Hash(xp, seed)
    ring = xp.floor(station * np.float32(1.0 / RING))
    segment = xp.floor(turn * SEGMENTS + np.float32(0.5) * (ring - 2.0 * xp.floor(0.5 * ring)))
    into = station - RING * ring
    joint = xp.maximum(1.0 - xp.minimum(into, RING - into) * np.float32(1.0 / _JOINT_HALF), 0.0)
    log = _CAST * (2.0 * hashed(ring, segment - SEGMENTS * (segment >= SEGMENTS), 0) - 1.0) - _JOINT_DEPTH * joint
    for layer, (along, around, spread) in enumerate(_PATCHES):
        log = log + spread * _smooth(hashed, station, turn, along, around, 1 + layer)
    log = log + _STREAK_DEPTH * xp.minimum(_smooth(hashed, station, turn, *_STREAK, 5), 0.0)
    n_marks = round(_ROUND / _MARK)
    drawn = hashed(xp.floor(station * np.float32(1.0 / _MARK)), xp.floor(turn * n_marks), 6)
    log = log + _MARK_SIZE * (drawn < _MARK_SHARE)
    return xp.exp(texture * log)


class _Hash:
    """Even numbers from 0 to 1 for pairs of whole numbers, without a table."""

    def __init__(self, xp: ModuleType, seed: Any) -> None:
        self.xp, self.seed = xp, xp.atleast_1d(xp.asarray(seed)).astype(np.uint32)  # of 1: a scalar would warn

    def __call__(self, i: Any, j: Any, layer: int) -> Any:
        bits = lambda x: x.astype(np.int32).astype(np.uint32)  # noqa: E731
        h = bits(i) * np.uint32(0x9E3779B1) ^ bits(j) * np.uint32(0x85EBCA77)
        h = h ^ (self.seed * np.uint32(0xC2B2AE3D) + np.uint32(0x27D4EB2F * (layer + 1) & 0xFFFFFFFF))
        for shift, factor in ((15, 0x2C1B3C6D), (12, 0x297A2D39)):
            h = (h ^ (h >> np.uint32(shift))) * np.uint32(factor)
        return (h >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)


def _smooth(hashed: _Hash, station: Any, turn: Any, along: float, around: float, layer: int) -> Any:
    """Return numbers from -1 to 1 that change from cell to cell, of `along` by `around` m, without a seam."""
    xp, n = hashed.xp, round(_ROUND / around)
    u, v = station * np.float32(1.0 / along), turn * n
    i, j = xp.floor(u), xp.floor(v)
    u, v = u - i, v - j
    u, v = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v)
    first, second = j - n * (j >= n), (j + 1.0) - n * (j + 1.0 >= n)
    low = hashed(i, first, layer) * (1.0 - v) + hashed(i, second, layer) * v
    high = hashed(i + 1.0, first, layer) * (1.0 - v) + hashed(i + 1.0, second, layer) * v
    return 2.0 * (low + u * (high - low)) - 1.0
