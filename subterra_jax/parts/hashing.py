"""Random numbers of a place: equal for equal seed and slot, and never stored."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32


def uniform(seed: UInt32[Array, ""], slot: Int[Array, "*n"], index: int) -> Float[Array, "*n"]:
    """Return uniform numbers in [0, 1).

    Args:
        seed: Seed of the episode.
        slot: Places.
        index: Number of the draw at a place; any small constant.

    Source: the finaliser of MurmurHash3 (Appleby), twice, because slots are consecutive.
    """
    mixed = slot.astype(jnp.uint32) * jnp.uint32(0x9E3779B1) + jnp.uint32((index * 0x85EBCA77 + 1) & 0xFFFFFFFF)
    mixed = _finish(_finish(mixed) ^ seed)
    return (mixed >> 8).astype(jnp.float32) * jnp.float32(2.0**-24)


def _finish(bits: UInt32[Array, "*n"]) -> UInt32[Array, "*n"]:
    bits = (bits ^ (bits >> 16)) * jnp.uint32(0x85EBCA6B)
    bits = (bits ^ (bits >> 13)) * jnp.uint32(0xC2B2AE35)
    return bits ^ (bits >> 16)
