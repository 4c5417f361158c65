"""Planar LiDAR: exact ranges to the wall polylines."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.tunnel import Tunnel, node_at


@struct.dataclass
class LidarParams:
    """Planar LiDAR model.

    Attributes:
        range_max: Largest range, m. A beam that hits nothing reports exactly this.
        range_sigma: Standard deviation of the range noise, m.
        n_beams: Beams in one scan; fixes array shapes, so it is static.
    """

    range_max: float = 30.0
    range_sigma: float = 0.05
    n_beams: int = struct.field(pytree_node=False, default=16)


def beam_directions(heading: Float[Array, ""], n_beams: int) -> Float[Array, "n_beams 2"]:
    """Unit vectors of the beams in the tunnel frame: beam 0 straight ahead, the others counter-clockwise, evenly spaced."""
    bearing = np.arange(n_beams) * (2.0 * np.pi / n_beams)
    # Rotating constants keeps more digits than adding a bearing to a heading in float32.
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    along, across = np.float32(np.cos(bearing)), np.float32(np.sin(bearing))
    return jnp.stack([cos * along - sin * across, sin * along + cos * across], axis=-1)


def cast(
    tunnel: Tunnel,
    position: Float[Array, "2"],
    station: Float[Array, ""],
    direction: Float[Array, "n_beams 2"],
    range_max: Float[Array, ""],
) -> Float[Array, "n_beams"]:
    """Distance along each beam to the nearest wall.

    Args:
        tunnel: The tunnel.
        position: Position of the LiDAR, tunnel frame, m.
        station: Its station, m; chooses the window of walls.
        direction: Unit vectors of the beams, tunnel frame.
        range_max: Largest range, m.

    Returns:
        Ranges without noise, m, in [0, range_max]. Exactly `range_max` where a beam meets no wall within it.
    """
    window = tunnel.scan_first[node_at(tunnel, station)] + jnp.arange(tunnel.n_scan)
    vertex = (tunnel.box_centre[window] - position)[:, None, :] + tunnel.vertices[window]
    x, y = vertex[..., 0], vertex[..., 1]
    dx, dy = direction[:, 0, None, None], direction[:, 1, None, None]
    across, along = dx * y - dy * x, dx * x + dy * y
    return jnp.minimum(jnp.min(hits(across, along), axis=(-2, -1)), range_max)


# A beam through the joint of two segments must meet one of them although their ends were rounded apart: m.
JOINT_TOLERANCE = 2e-6


def hits(across: Float[Array, "*k m"], along: Float[Array, "*k m"]) -> Float[Array, "*k m-1"]:
    """Distance at which a ray meets each segment of polylines given in its own frame.

    Args:
        across: Distance of each vertex to the left of the ray, m.
        along: Distance of each vertex ahead along the ray, m.

    Returns:
        Distance, m; `inf` where the ray does not meet the segment.
    """
    a, b = across[..., :-1], across[..., 1:]
    meets = (jnp.minimum(a, b) <= JOINT_TOLERANCE) & (jnp.maximum(a, b) >= -JOINT_TOLERANCE)
    share = jnp.clip(a / jnp.where(a == b, 1.0, a - b), 0.0, 1.0)
    distance = along[..., :-1] + share * (along[..., 1:] - along[..., :-1])
    return jnp.where(meets & (distance >= 0.0), distance, jnp.inf)


def add_noise(
    ranges: Float[Array, "n_beams"], noise: Float[Array, "n_beams"], params: LidarParams
) -> Float[Array, "n_beams"]:
    """Ranges as measured: true ranges plus noise, clipped to [0, range_max], m.

    Args:
        ranges: True ranges, m.
        noise: Standard normal numbers.
        params: The noise's size and the largest range.
    """
    return jnp.clip(ranges + params.range_sigma * noise, 0.0, params.range_max)
