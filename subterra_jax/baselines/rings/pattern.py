"""The relief of one ring of the lining, learnt on the way: the first harmonics of the ring's pitch for each wall."""

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

HARMONICS = 4  # pockets are 0.2 m long and 0.4 m apart; a fifth harmonic adds more noise than it tells

Pattern = Float[Array, "*batch 2 harmonics 2"]


@struct.dataclass
class Turns:
    """Phases in the ring, times 1, 2, … `HARMONICS`.

    Attributes:
        cosine: Of each multiple.
        sine: Of each multiple.
    """

    cosine: Float[Array, "harmonics *batch 2 side"]
    sine: Float[Array, "harmonics *batch 2 side"]


def turns(phase: Float[Array, "*batch 2 side"]) -> Turns:
    """Of phases, rad."""
    cosine, sine = [jnp.cos(phase)], [jnp.sin(phase)]
    for _ in range(HARMONICS - 1):
        real, imaginary = cosine[-1], sine[-1]
        cosine.append(real * cosine[0] - imaginary * sine[0])
        sine.append(real * sine[0] + imaginary * cosine[0])
    return Turns(jnp.stack(cosine), jnp.stack(sine))


def heights(pattern: Pattern, at: Turns, further: Float[np.ndarray, "n"]) -> Float[Array, "*batch 2 side n"]:
    """Heights of the relief at the phases of `at` and further phases (rad) beyond them, m."""
    total = jnp.zeros((*at.cosine.shape[1:], len(further)))
    for order in range(HARMONICS):
        real, imaginary = pattern[..., order, 0, None], pattern[..., order, 1, None]
        cosine, sine = at.cosine[order], at.sine[order]
        here, aside = real * cosine - imaginary * sine, real * sine + imaginary * cosine
        angle = np.float32(order + 1) * further
        total = total + 2.0 * (here[..., None] * np.cos(angle) - aside[..., None] * np.sin(angle))
    return total


def learnt(pattern: Pattern, rest: Float[Array, "*batch 2 side"], at: Turns, gain: Float[Array, "*batch"]) -> Pattern:
    """The pattern after one more scan.

    Args:
        pattern: Before.
        rest: Heights seen less heights expected, m; 0 for a beam that does not count.
        at: Where.
        gain: Weight of the scan, 1.
    """
    mean = jnp.stack([jnp.mean(rest * at.cosine, axis=-1), -jnp.mean(rest * at.sine, axis=-1)], axis=-1)
    return pattern + gain[..., None, None, None] * jnp.moveaxis(mean, 0, -2)


def power(pattern: Pattern) -> Float[Array, "*batch"]:
    """Mean square of the heights, the sum of both walls, m²."""
    return jnp.sum(2.0 * jnp.square(pattern), axis=(-3, -2, -1))


def sides(pattern: Pattern, direction: Float[Array, "*batch"]) -> Pattern:
    """The tunnel's left and right as the robot's, or the other way round: they differ on the way back."""
    return jnp.where((direction > 0.0)[..., None, None, None], pattern, jnp.flip(pattern, axis=-3))
