"""Kinematics of the four legs in closed form: where the feet are, which angles put them there, what load costs.

Legs in the order of `constants.LEGS`, joints in that of `constants.PARTS`; feet are points, in the trunk's axes, from
their leg's abduction axis.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from subterra_jax.b2 import constants as b2

SIDE = np.array([1.0, -1.0, 1.0, -1.0], np.float32)  # left is positive
END = np.array([1.0, 1.0, -1.0, -1.0], np.float32)  # front is positive
HIPS = np.stack([END * b2.HIP_X, SIDE * b2.HIP_Y, 0.0 * SIDE], axis=1)  # abduction axes in the trunk, m
STIFFNESS = np.array([b2.JOINT[part].stiffness for part in b2.PARTS], np.float32)  # of a leg's servos, N m/rad
_REACH = (0.12, 0.695)  # between a thigh's axis and its foot, m: short of folded and of straight


def feet(angles: Float[Array, "4 3"]) -> Float[Array, "4 3"]:
    """Where the feet are.

    Args:
        angles: Hip, thigh and calf of each leg, rad.

    Returns:
        x forward, y to the left, z up, m.
    """
    hip, thigh, calf = angles[:, 0], angles[:, 1], angles[:, 2]
    x = -b2.LINK * (jnp.sin(thigh) + jnp.sin(thigh + calf))
    depth = b2.LINK * (jnp.cos(thigh) + jnp.cos(thigh + calf))
    across = SIDE * b2.THIGH_Y
    cos, sin = jnp.cos(hip), jnp.sin(hip)
    return jnp.stack([x, across * cos + depth * sin, across * sin - depth * cos], axis=1)


def angles(feet: Float[Array, "4 3"]) -> Float[Array, "4 3"]:
    """The angles, knees behind, that put the feet there; out of reach, as near as the leg gets along its direction."""
    x, y, z = feet[:, 0], feet[:, 1], feet[:, 2]
    across = SIDE * b2.THIGH_Y
    depth = jnp.sqrt(jnp.maximum(y * y + z * z - b2.THIGH_Y**2, 1e-4))
    hip = jnp.arctan2(z * across + y * depth, y * across - z * depth)
    reach = jnp.clip(jnp.sqrt(x * x + depth * depth), *_REACH)
    bend = jnp.arccos(reach / (2.0 * b2.LINK))
    return jnp.stack([hip, jnp.arctan2(-x, depth) + bend, -2.0 * bend], axis=1)


def standing() -> tuple[Float[Array, "12"], Float[Array, "12"]]:
    """Joint angles of the default pose, and the servos' targets that hold it under the robot's weight, rad."""
    pose = jnp.array([[b2.STAND[part] for part in b2.PARTS]] * len(b2.LEGS))
    quarter = jnp.full(len(b2.LEGS), b2.TOTAL_MASS * b2.GRAVITY / len(b2.LEGS))
    return pose.reshape(-1), (pose + carrying(pose, quarter) / STIFFNESS).reshape(-1)


def foot_motion(angles: Float[Array, "4 3"], speeds: Float[Array, "4 3"]) -> Float[Array, "4 3"]:
    """Velocities of the feet against the trunk, m/s, for joint speeds in rad/s."""
    jacobian = _jacobian(angles)
    return jnp.sum(jacobian * speeds[:, None, :], axis=2)


def carrying(angles: Float[Array, "4 3"], load: Float[Array, "4"]) -> Float[Array, "4 3"]:
    """Torques with which each leg carries a vertical load on its foot, N m for N; the trunk level, the legs weightless.

    Source: virtual work, torque = -Jᵀ force.
    """
    return -_jacobian(angles)[:, 2, :] * load[:, None]


def _jacobian(angles: Float[Array, "4 3"]) -> Float[Array, "4 3 3"]:
    """Derivatives of x, y and z of each foot by its three angles, m/rad."""
    hip, thigh, calf = angles[:, 0], angles[:, 1], angles[:, 2]
    place = feet(angles)
    shank_x, shank_depth = -b2.LINK * jnp.sin(thigh + calf), b2.LINK * jnp.cos(thigh + calf)
    depth = b2.LINK * jnp.cos(thigh) + shank_depth
    cos, sin, nothing = jnp.cos(hip), jnp.sin(hip), jnp.zeros_like(hip)
    x, y, z = place[:, 0], place[:, 1], place[:, 2]
    return jnp.stack(
        [
            jnp.stack([nothing, -depth, -shank_depth], axis=1),
            jnp.stack([-z, x * sin, shank_x * sin], axis=1),
            jnp.stack([y, -x * cos, -shank_x * cos], axis=1),
        ],
        axis=1,
    )
