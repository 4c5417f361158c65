"""Intensity and Doppler channels: brightness of the wall where beams end, and the speed at which it comes nearer."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from subterra_jax import constants
from subterra_jax.host.texture import brightness, wall_angle
from subterra_jax.tunnel import Tunnel, at_station, node_at

FULL_SCALE, SCALE_SIGMA = 150.0, 0.05  # reported for 100 % diffuse, as Livox scales it; relative noise
MOST = 255.0
DOPPLER_SIGMA = 0.03  # m/s. Source: Aeva's Aeries II, 3 cm/s
DOPPLER_MOST = 20.0  # m/s


def wall_brightness(
    tunnel: Tunnel,
    station: Float[Array, ""],
    position: Float[Array, "2"],
    ends: Float[Array, "n d"],
    texture: Float[Array, ""] | float | None,
) -> tuple[Float[Array, "n"] | float, Float[Array, "n 2"]]:
    """Return factors on the reflectivity of the lining where beams end, and the tangent of the axis there.

    Args:
        station: Station of the sensor, m.
        position: Its position in plan, tunnel frame, m.
        ends: Ends of the beams, tunnel frame, m; in plan those of a planar LiDAR.
        texture: Dial, 0 to 1; `None` is 0.
    """
    _, _, tangent_x, tangent_y, _ = at_station(tunnel, station)
    near = station + (ends[:, 0] - position[0]) * tangent_x + (ends[:, 1] - position[1]) * tangent_y
    node = jax.vmap(node_at, (None, 0))(tunnel, near)
    row = tunnel.grid[node]
    away, tangent = ends[:, :2] - row[:, :2], row[:, 2:4]
    if texture is None:
        return 1.0, tangent
    ahead = away[:, 0] * tangent[:, 0] + away[:, 1] * tangent[:, 1]
    left = tangent[:, 0] * away[:, 1] - tangent[:, 1] * away[:, 0]
    above: Any = constants.SPATIAL_HEIGHT
    if ends.shape[1] == 3:
        ground = tunnel.space.ground[node]
        above = ends[:, 2] - ground[:, 0] - ground[:, 1] * ahead
    at = tunnel.spacing * (node - tunnel.first_node).astype(ahead.dtype) + ahead
    return brightness(jnp, at, wall_angle(jnp, left, above), tunnel.texture, texture), tangent


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
