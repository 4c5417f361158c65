"""A belief over cells, as Bayes' rule moves it: what histogram and ring filters have in common."""

from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Edge = Literal["edge", "constant"]


def diffuse(
    mass: Float[Array, "*cells"], variance: Float[Array, "*#cells"], axis: int = -1, beyond: Edge = "edge"
) -> Float[Array, "*cells"]:
    """Spread mass over neighbouring cells, as the noise of a step does.

    Args:
        mass: The belief; it need not sum to 1.
        variance: Variance added, in squares of a cell, from 0 to 1; it must broadcast against `mass`.
        axis: Axis of the cells.
        beyond: What lies beyond the first and the last cell: `edge`, as much as in them, so that nothing is lost; or
            `constant`, nothing, so that mass leaves.
    """
    low, high = neighbours(mass, axis, beyond)
    return mass + 0.5 * variance * (low + high - 2.0 * mass)


def neighbours(
    mass: Float[Array, "*cells"], axis: int = -1, beyond: Edge = "edge"
) -> tuple[Float[Array, "*cells"], Float[Array, "*cells"]]:
    """Return the mass of the cell before each cell, and of the one behind it. Arguments are those of `diffuse`."""
    axis %= mass.ndim
    wide = jnp.pad(mass, [(1, 1) if i == axis else (0, 0) for i in range(mass.ndim)], mode=beyond)
    before, behind = (jax.lax.slice_in_dim(wide, first, first + mass.shape[axis], axis=axis) for first in (0, 2))
    return before, behind


def normalised(log_mass: Float[Array, "*cells"], least: float) -> Float[Array, "*cells"]:
    """Scale a belief to a sum of 1, given and returned as logs; no cell falls below `least`."""
    return jnp.maximum(log_mass - jax.scipy.special.logsumexp(log_mass), least)
