"""Intensity and Doppler channels: brightness of the wall where beams end, and the speed at which it comes nearer."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from subterra_jax.tunnel import Tunnel, node_at

FULL_SCALE, SCALE_SIGMA = 150.0, 0.05  # reported for 100 % diffuse, as Livox scales it; relative noise
MOST = 255.0
DOPPLER_SIGMA = 0.03  # m/s. Source: Aeva's Aeries II, 3 cm/s
DOPPLER_MOST = 20.0  # m/s


def place_ends(
    tunnel: Tunnel, station: Float[Array, ""], position: Float[Array, "2"], x: Float[Array, "n"], y: Float[Array, "n"]
) -> tuple[Array, ...]:
    """Find the ends of beams by the axis of the tunnel.

    Nothing is stacked, nor are rows of the grid read as a whole: a GPU would write all of it to its memory. Pairs of
    numbers are read as one.

    Args:
        station: Station of the sensor, m.
        position: Its position in plan, tunnel frame, m.
        x: Ends of the beams in plan, tunnel frame, m.
        y: Likewise.

    Returns:
        Of each beam the nearest row of `grid`, the distance ahead of it (m), that to the left of the axis (m), the
        station (m), and the unit tangent x, y of the axis there.
    """
    middle, tangent = (jax.lax.complex(tunnel.grid[:, k], tunnel.grid[:, k + 1]) for k in (0, 2))
    ahead = tangent[node_at(tunnel, station)]
    near = station + (x - position[0]) * jnp.real(ahead) + (y - position[1]) * jnp.imag(ahead)
    node = jax.vmap(node_at, (None, 0))(tunnel, near)
    x, y = x - jnp.real(middle[node]), y - jnp.imag(middle[node])
    tangent_x, tangent_y = jnp.real(tangent[node]), jnp.imag(tangent[node])
    ahead, left = x * tangent_x + y * tangent_y, tangent_x * y - tangent_y * x
    at = tunnel.spacing * (node - tunnel.first_node).astype(ahead.dtype) + ahead
    return node, ahead, left, at, tangent_x, tangent_y


def normal_beside(normal: Float[Array, "n"], channel: int) -> Float[Array, "n"]:
    """Return nearly normal numbers for a further channel, uncorrelated with the first: drawing them costs more.

    They are sums of four hashed bytes, at most 3.5.
    """
    h: Any = jax.lax.bitcast_convert_type(normal, jnp.uint32) ^ np.uint32(channel)
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        h = (h ^ (h >> np.uint32(shift))) * np.uint32(factor)
    even = (h & np.uint32(0x00FF00FF)) + ((h >> np.uint32(8)) & np.uint32(0x00FF00FF))
    total = (even & np.uint32(0xFFFF)) + (even >> np.uint32(16))
    return (total.astype(jnp.float32) - 510.0) * np.float32((12.0 / (4.0 * (256.0**2 - 1.0))) ** 0.5)


def intensity(
    cosine: Float[Array, "n"], reflectivity: Float[Array, "n"], normal: Float[Array, "n"], full: float = FULL_SCALE
) -> Float[Array, "n"]:
    """Return reported intensities, whole numbers up to 255, with 5 % noise; 100 % diffuse gives `full`."""
    value: Any = full * reflectivity * cosine * (1.0 + SCALE_SIGMA * normal)
    return jnp.clip(jnp.round(value), 0.0, MOST)
