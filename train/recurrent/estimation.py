"""What the estimation head got wrong."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def missed(logits: Float[Array, "*batch bins"], error: Float[Array, "*batch"], width: float) -> Float[Array, "*batch"]:
    """Cross entropy with the truth shared between its two nearest bins, whose middles lie evenly about 0.

    Args:
        logits: Of the bins.
        error: True less reckoned distance, m; beyond the last bin it counts as in the last.
        width: Of a bin, m.
    """
    bins = logits.shape[-1]
    place = jnp.clip(error / width + 0.5 * (bins - 1), 0.0, bins - 1.001)
    lower = jnp.floor(place).astype(jnp.int32)
    share = (place - lower)[..., None]
    log_share = jax.nn.log_softmax(logits)
    low = jnp.take_along_axis(log_share, lower[..., None], axis=-1)
    high = jnp.take_along_axis(log_share, lower[..., None] + 1, axis=-1)
    return -((1.0 - share) * low + share * high)[..., 0]
