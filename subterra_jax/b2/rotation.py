"""Quaternions, real part first, written out: a product by `dot` may round to TF32 on a GPU."""

import jax.numpy as jnp
from jaxtyping import Array, Float

Quaternion = Float[Array, "4"]


def rotate(quaternion: Quaternion, vector: Float[Array, "3"]) -> Float[Array, "3"]:
    """A vector of the turned frame in the frame outside."""
    w, x, y, z = quaternion
    a, b, c = vector
    # v + 2 w (r × v) + 2 r × (r × v)
    s, t, u = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return jnp.stack([a + w * s + y * u - z * t, b + w * t + z * s - x * u, c + w * u + x * t - y * s])


def inverse(quaternion: Quaternion) -> Quaternion:
    """Of a unit quaternion."""
    w, x, y, z = quaternion
    return jnp.stack([w, -x, -y, -z])


def times(first: Quaternion, second: Quaternion) -> Quaternion:
    """The turn `second` within the frame turned by `first`."""
    a, b, c, d = first
    w, x, y, z = second
    return jnp.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ]
    )


def yaw_only(angle: Float[Array, ""]) -> Quaternion:
    """A turn about z, rad."""
    nothing = jnp.zeros_like(angle)
    return jnp.stack([jnp.cos(0.5 * angle), nothing, nothing, jnp.sin(0.5 * angle)])
