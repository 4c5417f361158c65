"""The kinematics of the four legs in closed form.

Products are written out: a `dot` may round to TF32 on a GPU. Legs are in the
order of `constants.LEGS`, joints in that of `constants.PARTS`. Feet are points in the trunk's axes, measured from
their leg's abduction axis.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from subterra_jax.b2 import constants as b2

SIDE = np.array([1.0, -1.0, 1.0, -1.0], np.float32)  # left is positive
END = np.array([1.0, 1.0, -1.0, -1.0], np.float32)  # front is positive
HIPS = np.stack([END * b2.HIP_X, SIDE * b2.HIP_Y, 0.0 * SIDE], axis=1)  # abduction axes in the trunk, m
STIFFNESS = np.array([b2.JOINT[part].stiffness for part in b2.PARTS], np.float32)  # of a leg's servos, N m/rad
_REACH = (0.12, 0.695)  # between a thigh's axis and its foot, m: short of folded and of straight


def foot_positions(angles: Float[Array, "4 3"]) -> Float[Array, "4 3"]:
    """Computes the positions of the feet from the joint angles.

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


def joint_angles(feet: Float[Array, "4 3"]) -> Float[Array, "4 3"]:
    """Computes the joint angles (rad), knees behind, that put the feet at given positions (m).

    A foot out of reach gets as near as its leg can along the same direction.
    """
    x, y, z = feet[:, 0], feet[:, 1], feet[:, 2]
    across = SIDE * b2.THIGH_Y
    depth = jnp.sqrt(jnp.maximum(y * y + z * z - b2.THIGH_Y**2, 1e-4))
    hip = jnp.arctan2(z * across + y * depth, y * across - z * depth)
    reach = jnp.clip(jnp.sqrt(x * x + depth * depth), *_REACH)
    bend = jnp.arccos(reach / (2.0 * b2.LINK))
    return jnp.stack([hip, jnp.arctan2(-x, depth) + bend, -2.0 * bend], axis=1)


def foot_velocities(angles: Float[Array, "4 3"], speeds: Float[Array, "4 3"]) -> Float[Array, "4 3"]:
    """Computes the velocities of the feet relative to the trunk (m/s) from joint speeds (rad/s)."""
    return jax.jvp(foot_positions, (angles,), (speeds,))[1]


def load_torques(angles: Float[Array, "4 3"], load: Float[Array, "4"]) -> Float[Array, "4 3"]:
    """Computes the joint torques (N m) with which each leg carries a vertical load on its foot (N).

    The trunk is taken to be level and the legs weightless. Source: virtual work, torque = -Jᵀ force.
    """
    return -jax.vjp(foot_positions, angles)[1](load[:, None] * jnp.array([0.0, 0.0, 1.0]))[0]


def standing_pose() -> tuple[Float[Array, "12"], Float[Array, "12"]]:
    """Return the joint angles of the default pose, and the servo targets that hold it under the robot's weight, rad."""
    pose = jnp.array([[b2.STAND[part] for part in b2.PARTS]] * len(b2.LEGS))
    quarter = jnp.full(len(b2.LEGS), b2.TOTAL_MASS * b2.GRAVITY / len(b2.LEGS))
    return pose.reshape(-1), (pose + load_torques(pose, quarter) / STIFFNESS).reshape(-1)
