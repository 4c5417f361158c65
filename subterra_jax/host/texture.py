"""Brightness of a wall from place to place: one function for the batch, the simulated survey and pictures.

It is fixed to the wall: each segment of a ring is a window, drawn by a hash, of one table of damp, soot, streaks and
painted marks. So a place costs one hash and one read. NumPy and JAX give the same numbers. All sizes are ours:
published ones are of single tunnels. Rock and sprayed concrete have no pattern of their own.
"""

import functools
import zlib
from types import ModuleType
from typing import Any

import numpy as np

AXIS_HEIGHT = 1.5  # m above the ground, of the axis that angles are measured about
RING, SEGMENTS = 1.5, 6  # m of a ring; segments round it, staggered by half from ring to ring
_ROUND = 17.6  # m round the wall, of a radius of 2.8 m
_SIDE, _CELL = 256, 0.08  # cells of the table along each side, which repeats; m of a cell
# Patches along and round (m), spread of the logarithm: damp, soot and repair, then grain; streaks are upright.
_PATCHES = ((2.0, 2.0, 0.2), (0.5, 0.5, 0.25), (0.16, 0.16, 0.3))
_STREAK, _STREAK_DEPTH = (0.25, 1.5), 0.5  # they only darken
_CAST = 0.2  # spread between segments
_JOINT_HALF, _JOINT_DEPTH = 0.03, 0.5  # m; of the logarithm
_MARK, _MARK_FRACTION, _MARK_SIZE = 0.3, 0.02, 0.6  # m of a painted mark; fraction of the wall; of the logarithm
_LOWEST, _STEP = -1.3, 2.8 / 255.0  # logarithm of the table's 0, and of one of its 255 steps


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
    place = station * np.float32(1.0 / RING)
    ring = xp.floor(place)
    odd = ring.astype(np.int32) & 1
    turn = angle * np.float32(SEGMENTS * 0.5 / np.pi) + (np.float32(0.5 * SEGMENTS) + np.float32(0.5) * odd)
    segment = xp.floor(turn)
    along, around = RING * (place - ring), np.float32(_ROUND / SEGMENTS) * (turn - segment)
    drawn = _hash(xp, ring, segment - SEGMENTS * (segment >= SEGMENTS), seed)
    u, v = along * np.float32(1.0 / _CELL), around * np.float32(1.0 / _CELL)
    i, j = xp.floor(u), xp.floor(v)
    u, v = u - i, v - j
    row, column = i.astype(np.int32) + _bits(drawn, 0), j.astype(np.int32) + _bits(drawn, 8)
    corners = xp.take(xp.asarray(_table()), (row & 255) * _SIDE + (column & 255), mode="clip")
    low, low_next, high, high_next = (_bits(corners, shift).astype(np.float32) for shift in (0, 8, 16, 24))
    low, high = low + v * (low_next - low), high + v * (high_next - high)
    cast = _bits(drawn, 16).astype(np.float32) * np.float32(2.0 * _CAST / 255.0) - np.float32(_CAST - _LOWEST)
    joint = xp.maximum(1.0 - xp.minimum(along, RING - along) * np.float32(1.0 / _JOINT_HALF), 0.0)
    return xp.exp(texture * (cast + np.float32(_STEP) * (low + u * (high - low)) - np.float32(_JOINT_DEPTH) * joint))


def _bits(number: Any, shift: int) -> Any:
    return ((number >> np.uint32(shift)) & np.uint32(255)).astype(np.int32)


def _hash(xp: ModuleType, i: Any, j: Any, seed: Any) -> Any:
    """Return 32 random bits for pairs of whole numbers."""
    bits = lambda x: x.astype(np.int32).astype(np.uint32)  # noqa: E731
    start = xp.atleast_1d(xp.asarray(seed)).astype(np.uint32) * np.uint32(0xC2B2AE3D)  # of 1: a scalar would warn
    h = bits(i) * np.uint32(0x9E3779B1) ^ bits(j) * np.uint32(0x85EBCA77) ^ start
    for shift, factor in ((15, 0x2C1B3C6D), (12, 0x297A2D39)):
        h = (h ^ (h >> np.uint32(shift))) * np.uint32(factor)
    return h ^ (h >> np.uint32(15))


@functools.cache
def _table() -> np.ndarray:
    """Return the logarithms of the table in bytes, and those of the next cells along and round: four in a `uint32`."""
    rng, size = np.random.default_rng(0), _SIDE * _CELL
    log = np.zeros((_SIDE, _SIDE))
    for along, around, spread in _PATCHES:
        log += spread * _smooth(rng.uniform(-1.0, 1.0, (round(size / along), round(size / around))))
    log += _STREAK_DEPTH * np.minimum(_smooth(rng.uniform(-1.0, 1.0, [round(size / side) for side in _STREAK])), 0.0)
    marks = rng.random(2 * [round(size / _MARK)]) < _MARK_FRACTION
    cell = np.arange(_SIDE) * len(marks) // _SIDE
    log += _MARK_SIZE * marks[cell[:, None], cell]
    steps = np.clip(np.rint((log - _LOWEST) / _STEP), 0, 255).astype(np.uint32)
    after = np.roll(steps, -1, axis=0)
    return (steps | np.roll(steps, -1, 1) << 8 | after << 16 | np.roll(after, -1, 1) << 24).ravel()


def _smooth(corners: np.ndarray) -> np.ndarray:
    """Return the table's numbers that change smoothly between those at the corners of patches, without a seam."""
    for axis in (0, 1):
        n = corners.shape[axis]
        place = np.arange(_SIDE) * n / _SIDE
        first = place.astype(int)
        fraction = np.expand_dims((place - first) ** 2 * (3.0 - 2.0 * (place - first)), 1 - axis)
        corners = corners.take(first, axis) * (1.0 - fraction) + corners.take((first + 1) % n, axis) * fraction
    return corners
