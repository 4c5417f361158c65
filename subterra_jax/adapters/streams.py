"""Streams of keys: each environment draws from its own, so that it does the same alone and among others.

A stream is the two words of a Threefry key. Each reset and each step takes one key from it and leaves the next.
"""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Array, PRNGKeyArray, UInt32

_WORD = 0xFFFFFFFF


def start_streams(seeds: Sequence[int | None], fallback: np.random.Generator) -> UInt32[np.ndarray, "n 2"]:
    """Streams that begin at seeds.

    Args:
        seeds: One for each stream, from 0 to 2⁶⁴ - 1; None takes a number from `fallback`.
        fallback: Source of the seeds that nobody named.

    Raises:
        ValueError: A seed is out of range.
    """
    chosen = [int(fallback.integers(2**63)) if seed is None else int(seed) for seed in seeds]
    for seed in chosen:
        if not 0 <= seed < 2**64:
            raise ValueError(f"a seed must be from 0 to 2**64 - 1, got {seed}")
    return np.array([[seed >> 32, seed & _WORD] for seed in chosen], np.uint32).reshape(-1, 2)


def take_key(stream: UInt32[Array, "2"]) -> tuple[PRNGKeyArray, UInt32[Array, "2"]]:
    """The next key of a stream, and the stream after it."""
    now, rest = jax.random.split(jax.random.wrap_key_data(stream, impl="threefry2x32"))
    return now, jax.random.key_data(rest)
