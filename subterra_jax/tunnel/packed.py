"""The blocks of a tunnel as NVIDIA GPUs read them: 32 bytes a block, which two instructions read, and its vertices.

Robots in a thousand tunnels read more than a chip's cache holds, and time is spent waiting for it. So numbers that may
err to one side have 16 bits, and the vertices of all blocks follow one another without padding.
"""

from collections.abc import Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

# Words of a block, and of a vertex pair.
BLOCK_WORDS, PAIR_WORDS = 8, 4
_HIGH = np.uint32(0xFFFF0000)


@struct.dataclass
class Packed:
    """Boxes, planes and walls of blocks; the walls are those of the `Tunnel`, the boxes hold its boxes."""

    # Words of each block: the middle x, y of its box (m, float32); half its long axis x, y; half its thickness and its
    # vertex pairs; the normal x, y of its plane; how far ahead and behind the plane is (m); its first vertex pair; 0.
    # Two numbers in one word have 16 bits each, floats the upper half of 32.
    block: Int[Array, "n_blocks 8"]
    # vertex pairs of all blocks as x, y, x, y, from the middle of the block's box, m; the last vertex of a block twice
    # if their number is odd
    wall: Float[Array, "n_pairs 4"]


def pack(
    box: Float[np.ndarray, "10 n_blocks"], wall: Float[np.ndarray, "n_blocks 2 k"], count: Int[np.ndarray, " n_blocks"]
) -> Packed:
    """Pack blocks.

    A rounded axis is off by a few millimetres, and the thickness grows by as much: a packed box holds the box.

    Args:
        box: As in `Tunnel`.
        wall: As in `Tunnel`.
        count: Vertices of each block without padding.
    """
    middle_x, middle_y, half_x, half_y, thickness, _, normal_x, normal_y, ahead, behind = box.astype(np.float32)
    axis_x, axis_y = _nearest(half_x), _nearest(half_y)
    off = np.hypot(half_x - axis_x.view(np.float32), half_y - axis_y.view(np.float32))
    pairs = (count.astype(np.int64) + 1) // 2
    words = [
        middle_x.view(np.uint32),
        middle_y.view(np.uint32),
        axis_x | axis_y >> 16,
        _upward(thickness + (1.0 + 1e-5) * off) | pairs.astype(np.uint32),
        _nearest(normal_x) | _nearest(normal_y) >> 16,
        _upward(-ahead) ^ 0x80000000 | (_upward(-behind) ^ 0x80000000) >> 16,
        (np.cumsum(pairs) - pairs).astype(np.uint32),
        np.zeros_like(axis_x),
    ]
    corners = pair_up(wall)
    block: Any = np.stack(words, axis=1).view(np.int32)  # on the host until the tunnel goes to a device
    points: Any = corners[np.arange(corners.shape[1]) < pairs[:, None]]
    return Packed(block=block, wall=points)


def pair_up(wall: Float[np.ndarray, "n_blocks 2 k"]) -> Float[np.ndarray, "n_blocks n_pairs 4"]:
    """Return the vertices of each block in pairs; the last one twice if they are odd."""
    wall = np.pad(wall, ((0, 0), (0, 0), (0, wall.shape[2] % 2)), mode="edge")
    return np.swapaxes(wall, 1, 2).reshape(len(wall), wall.shape[2] // 2, PAIR_WORDS)


def join(parts: Sequence[Packed]) -> Packed:
    """Join the packed blocks of several tunnels."""
    first = np.cumsum([0, *(len(part.wall) for part in parts)])[:-1]
    block = np.concatenate([np.asarray(part.block) for part in parts])
    block[:, 6] += np.repeat(first, [len(part.block) for part in parts]).astype(np.int32)
    words, points = cast(Any, block), cast(Any, np.concatenate([np.asarray(part.wall) for part in parts]))
    return Packed(block=words, wall=points)


def unpack(words: Sequence[Array]) -> tuple[Array, ...]:
    """Return the middle x, y, half axis x, y and half thickness (m), vertex pairs, normal x, y, plane ahead and behind.

    Args:
        words: The first six words of blocks.
    """
    x, y = (jax.lax.bitcast_convert_type(word, jnp.float32) for word in words[:2])
    axis, thickness, normal, plane = words[2:6]
    pairs = thickness & jnp.int32(0xFFFF)
    return x, y, *_two(axis), _two(thickness)[0], pairs, *_two(normal), *_two(plane)


def _two(word: Array) -> tuple[Array, Array]:
    upper, lower = word & jnp.int32(-(1 << 16)), word << 16
    return jax.lax.bitcast_convert_type(upper, jnp.float32), jax.lax.bitcast_convert_type(lower, jnp.float32)


def _nearest(number: np.ndarray) -> np.ndarray:
    """Return the bits of the nearest number of which only the upper half of the bits is set."""
    return ((number.view(np.uint32) + np.uint32(0x8000)) & _HIGH).astype(np.uint32)


def _upward(number: np.ndarray) -> np.ndarray:
    """Return the bits of the next larger number of which only the upper half of the bits is set."""
    bits = np.ascontiguousarray(number, np.float32).view(np.uint32)
    # Cutting the last bits makes a positive number less, and a negative one more.
    grown = bits + np.where((bits >> 31 == 0) & (bits != 0x7F800000), np.uint32(0xFFFF), np.uint32(0))
    return (grown & _HIGH).astype(np.uint32)
