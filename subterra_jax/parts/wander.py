"""An error that wanders over the distance travelled: Ornstein-Uhlenbeck, exact for any step."""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax import constants


@struct.dataclass
class WanderParams:
    """A stationary Ornstein-Uhlenbeck process over distance, which starts with a normal number of `sigma`.

    Attributes:
        sigma: Standard deviation at any place, in the unit of the error.
        length: Distance over which its correlation falls to 1/e, m.
    """

    sigma: float
    length: float = constants.WANDER_LENGTH


def advance_wander(
    value: Float[Array, ""], travelled: Float[Array, ""], noise: Float[Array, ""], params: WanderParams
) -> Float[Array, ""]:
    """Return the value a distance further on; unchanged where nothing was travelled.

    Args:
        travelled: Distance, m; its sign does not matter.

    Source: Gillespie 1996, Exact numerical simulation of the Ornstein-Uhlenbeck process.
    """
    ratio = jnp.abs(travelled) / params.length
    # The root has no derivative at 0: a standing robot gets 0, and neither branch a NaN.
    moves = ratio > 0.0
    # expm1, because 1 - exp(-x) has few digits left at a step of 0.2 m in 30 m.
    share = jnp.where(moves, jnp.sqrt(-jnp.expm1(-2.0 * jnp.where(moves, ratio, 1.0))), 0.0)
    return jnp.exp(-ratio) * value + params.sigma * share * noise
