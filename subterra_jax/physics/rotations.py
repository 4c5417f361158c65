"""Rotations by unit quaternions with the real part first; products are written out, since a `dot` may round to TF32."""

import jax.numpy as jnp
from jaxtyping import Array, Float

Quaternion = Float[Array, "4"]


def rotate(quaternion: Quaternion, vector: Float[Array, "3"]) -> Float[Array, "3"]:
    """Rotates a vector from the turned frame into the outer frame."""
    w, x, y, z = quaternion
    a, b, c = vector
    # v + 2 w (r × v) + 2 r × (r × v)
    s, t, u = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return jnp.stack([a + w * s + y * u - z * t, b + w * t + z * s - x * u, c + w * u + x * t - y * s])


def inverse(quaternion: Quaternion) -> Quaternion:
    """Return the inverse of a unit quaternion."""
    w, x, y, z = quaternion
    return jnp.stack([w, -x, -y, -z])


def compose(first: Quaternion, second: Quaternion) -> Quaternion:
    """Return the rotation `second` within the frame turned by `first`."""
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


def yaw_quaternion(angle: Float[Array, ""]) -> Quaternion:
    """Return a rotation about z by an angle, rad."""
    zero = jnp.zeros_like(angle)
    return jnp.stack([jnp.cos(0.5 * angle), zero, zero, jnp.sin(0.5 * angle)])


def yaw(quaternion: Quaternion) -> Float[Array, ""]:
    """Return the direction of the turned x axis, seen from above, rad."""
    x, y, _ = rotate(quaternion, jnp.array([1.0, 0.0, 0.0]))
    return jnp.arctan2(y, x)


def upright(normal: Float[Array, "3"]) -> Quaternion:
    """Return the shortest rotation that turns z into a unit vector, which must not point straight down."""
    x, y, z = normal
    raw = jnp.stack([1.0 + z, -y, x, jnp.zeros_like(z)])
    return raw / jnp.sqrt(jnp.maximum(2.0 * (1.0 + z), 1e-6))
