"""The blocks of a tunnel as NVIDIA GPUs read them: few bytes a block, in words that one instruction reads four of.

Robots in a thousand tunnels read more than a chip's cache holds, and time is spent waiting for it. So the vertices of
all blocks follow one another without padding.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

# Words of a box, and bits of the two counts in its last one.
WORDS, WINDOW_BITS, PAIR_BITS = 4, 11, 5
ALL_WINDOW, ALL_PAIRS = (1 << WINDOW_BITS) - 1, (1 << PAIR_BITS) - 1
_HIGH = np.int32(-(1 << 16))


@struct.dataclass
class Packed:
    """Boxes and walls of blocks; the walls are those of the `Tunnel`, the boxes hold its boxes.

    Attributes:
        box: Words of the box around each block: the middle x and y (m, float32); half its long axis x and y (m,
            bfloat16); half its thickness (m, bfloat16), vertex pairs and blocks in the largest scan window that begins
            with it. A count with all bits set says "all there are".
        start: First vertex pair of each block.
        wall: Vertex pairs of all blocks as x, y, x, y, from the middle of the block's box, m; the last vertex of a
            block twice if their number is odd.
    """

    box: Int[Array, "n_blocks 4"]
    start: Int[Array, "n_blocks"]
    wall: Float[Array, "n_pairs 4"]


def pack(box: Any, wall: Any, count: Any, window: Any) -> Packed:
    """Pack blocks, of NumPy on the host or traced.

    A rounded axis is off by a few millimetres, and the thickness grows by as much: a packed box holds the box.

    Args:
        box: As in `Tunnel`.
        wall: As in `Tunnel`.
        count: Vertices of each block without padding, `(n_blocks,)`; `None` keeps the padding.
        window: Blocks in the largest scan window that begins with each block, `(n_blocks,)`; 0 where none does.
    """
    xp = np if isinstance(box, np.ndarray) else jnp
    middle_x, middle_y, half_x, half_y, thickness = box[:5]
    axis_x, axis_y = (_top(xp, half) for half in (half_x, half_y))
    off_x, off_y = half_x - _float(xp, axis_x), half_y - _float(xp, axis_y)
    thickness = thickness + (1.0 + 1e-5) * xp.sqrt(off_x * off_x + off_y * off_y)
    bits = _bits(xp, thickness)
    # Towards larger numbers: cutting the last bits makes a positive number less, and a negative one more.
    up = (bits + xp.where(bits >= 0, 0xFFFF, 0).astype(np.int32)) & _HIGH
    wall = pair_up(xp, wall)
    n_blocks, n_pairs = wall.shape[:2]
    there = np.full(n_blocks, n_pairs) if count is None else (np.asarray(count).astype(np.int32) + 1) // 2
    pairs = np.minimum(there, ALL_PAIRS)
    kept = np.where(pairs == ALL_PAIRS, n_pairs, there)
    start: Any = (np.cumsum(kept) - kept).astype(np.int32)
    wall = wall.reshape(-1, WORDS) if count is None else wall[np.arange(n_pairs) < kept[:, None]]
    window = xp.minimum(xp.asarray(window).astype(np.int32), ALL_WINDOW)
    last = up | (pairs.astype(np.int32) << WINDOW_BITS) | window
    axis = axis_x | ((axis_y >> 16) & 0xFFFF)
    words = xp.stack([_bits(xp, middle_x), _bits(xp, middle_y), axis, last], axis=1)
    return Packed(box=words, start=start, wall=wall)


def packed_blocks(tunnel: Any) -> Packed:
    """Return the packed blocks of a tunnel; made of its boxes and walls where it has none."""
    if tunnel.packed is not None:
        return tunnel.packed
    return pack(tunnel.box, tunnel.wall, None, jnp.full(tunnel.box.shape[1], tunnel.n_scan))


def counts(word: Any) -> tuple[Any, Any]:
    """Return the vertex pairs and the windows of boxes, of their last word; see `Packed`."""
    return (word >> WINDOW_BITS) & ALL_PAIRS, word & ALL_WINDOW


def pair_up(xp: Any, wall: Any) -> Any:
    """Return the vertices of each block in pairs, `(n_blocks, n_pairs, 4)`; the last one twice if they are odd."""
    wall = xp.pad(wall, ((0, 0), (0, 0), (0, wall.shape[2] % 2)), mode="edge")
    return xp.swapaxes(wall, 1, 2).reshape(wall.shape[0], -1, WORDS)


def unpack(words):
    """Return the middle x, y, half axis x, y, half thickness (m), vertex pairs and window of boxes; see `Packed`."""
    x, y = (jax.lax.bitcast_convert_type(word, jnp.float32) for word in words[:2])
    return x, y, _high(words[2]), _low(words[2]), _high(words[3]), *counts(words[3])


def all_if_full(count, full: int, everything: int):
    """Return a count of which the largest number stands for everything."""
    return jnp.where(count == full, jnp.int32(everything), count)


def _high(word: Any) -> Any:
    """Return the number in the upper half of a word."""
    return jax.lax.bitcast_convert_type(word & _HIGH, jnp.float32)


def _low(word: Any) -> Any:
    """Return the number in the lower half of a word."""
    return jax.lax.bitcast_convert_type(word << 16, jnp.float32)


def _bits(xp: Any, number: Any) -> Any:
    if xp is np:
        return np.ascontiguousarray(number, np.float32).view(np.int32)
    return jax.lax.bitcast_convert_type(number.astype(jnp.float32), jnp.int32)


def _float(xp: Any, bits: Any) -> Any:
    return bits.view(np.float32) if xp is np else jax.lax.bitcast_convert_type(bits, jnp.float32)


def _top(xp: Any, number: Any) -> Any:
    """Return the bits of the nearest number of which only the upper half of the bits is set."""
    return (_bits(xp, number) + np.int32(0x8000)) & _HIGH
