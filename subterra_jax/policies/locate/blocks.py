"""Inputs of a memory, one for each metre commanded, and what it answers."""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

DELAY = 12  # blocks after which all beams have passed a block
_SLOWEST = 25.0  # steps in a metre; more count as so many, since nobody drives so slowly in training


@struct.dataclass
class Block:
    """One metre of commanded distance."""

    # log likelihood of each error compared, by the block `DELAY` metres ago; 0 where there is none
    evidence: Float[Array, "n_fractions"]
    read: Float[Array, ""]  # distance that the odometer counted in this metre, less 1, m
    steps: Float[Array, ""]  # steps taken in this metre


@struct.dataclass
class Estimate:
    """Answer of a memory."""

    correction: Float[Array, ""]  # true less commanded distance since the start, m
    fraction: Float[Array, ""]  # the same for the metres to come, m per m
    log_scale: Float[Array, ""]  # log of the mean absolute error of `correction` that is expected, m


def matched_inputs(block: Block, fractions: Float[Array, "n_fractions"]) -> Float[Array, "n"]:
    """Returns evidence over the errors `fractions`, and odometry, as inputs of a network."""
    centred = block.evidence - jnp.mean(block.evidence, axis=-1, keepdims=True)
    belief = jnp.exp(block.evidence - jnp.max(block.evidence, axis=-1, keepdims=True))
    belief = belief / jnp.sum(belief, axis=-1, keepdims=True)
    mean = jnp.sum(belief * fractions, axis=-1, keepdims=True)
    sigma = jnp.sqrt(jnp.sum(belief * (fractions - mean) ** 2, axis=-1, keepdims=True) + 1e-10)
    read, steps = block.read[..., None], jnp.minimum(block.steps[..., None], _SLOWEST)
    return jnp.concatenate([0.3 * centred, 30.0 * mean, 30.0 * sigma, 20.0 * read, 0.1 * steps], axis=-1)
