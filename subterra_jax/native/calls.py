"""The kernels as functions of JAX, over many rows in one tunnel."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.native.handlers import CLEARANCE, SCAN
from subterra_jax.tunnel import CONTACT_REACH, Tunnel


def scan(
    tunnel: Tunnel,
    position: Float[Array, "n 2"],
    heading: Float[Array, " n"],
    first: Int[Array, " n"],
    wanted: Bool[Array, " n"],
    range_max: Float[Array, ""],
    bearing: np.ndarray,
) -> Float[Array, "n n_beams"]:
    """True ranges of many scans in one tunnel.

    Args:
        tunnel: The tunnel, one for all.
        position: Positions of the LiDAR, tunnel frame, m.
        heading: Its headings, rad.
        first: First block of each window.
        wanted: Which scans to take; the others cost nothing, and hold anything.
        range_max: Largest range, m.
        bearing: Of each beam from the heading, rad; if their number is even, the second half opposes the first.

    Returns:
        As `lidar.scan`.
    """
    shape = jax.ShapeDtypeStruct((position.shape[0], len(bearing)), jnp.float32)
    return jax.ffi.ffi_call(SCAN, shape)(
        first,
        wanted.astype(jnp.int32),
        position,
        heading,
        tunnel.box,
        tunnel.wall,
        np.concatenate([np.cos(bearing), np.sin(bearing)]).astype(np.float32),
        jnp.asarray(range_max, jnp.float32).reshape(1),
        np.full(1, tunnel.n_scan, np.int32),
    )


def clearance(tunnel: Tunnel, position: Float[Array, "n 2"], first: Int[Array, " n"]) -> Float[Array, " n"]:
    """Distances from many points in one tunnel to its nearest wall or furniture.

    Args:
        tunnel: The tunnel, one for all.
        position: The points, tunnel frame, m.
        first: First block of each contact window.

    Returns:
        Distances, m; exact up to `CONTACT_REACH`, and exactly that where the truth is beyond.
    """
    shape = jax.ShapeDtypeStruct(position.shape[:1], jnp.float32)
    return jax.ffi.ffi_call(CLEARANCE, shape)(
        first,
        position,
        tunnel.box,
        tunnel.wall,
        np.full(1, CONTACT_REACH, np.float32),
        np.full(1, tunnel.n_contact, np.int32),
    )
