"""What the servos are told, and what they do."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from subterra_jax.b2 import constants as b2
from subterra_jax.b2 import gait
from subterra_jax.b2.params import WalkParams
from subterra_jax.b2.physics import Body, Build
from subterra_jax.b2.state import WalkState

_STIFFNESS = np.tile(np.array([b2.JOINT[part].stiffness for part in b2.PARTS], np.float32), 4)
_DAMPING = np.tile(np.array([b2.JOINT[part].damping for part in b2.PARTS], np.float32), 4)
_TORQUE = np.tile(np.array([b2.JOINT[part].torque for part in b2.PARTS], np.float32), 4)


def command_joints(
    state: WalkState, action: Float[Array, "12"], period: float, params: WalkParams
) -> tuple[gait.GaitState, Float[Array, "12"]]:
    """The gait a moment later, and the servos' targets: its own and the action's offsets, rad."""
    felt, told = state.feeling, state.gait.velocity
    drift = jnp.concatenate([felt.velocity, felt.rates[2:]]) - told
    walking = gait.advance(state.gait, state.command, drift, period, params.gait)
    offset = jnp.tile(jnp.asarray(params.action_scale), 4) * action
    return walking, gait.targets(walking, felt.gravity, params.gait) + offset


def torques(body: Body, targets: Float[Array, "12"], build: Build) -> Float[Array, "12"]:
    """What the servos do, N m."""
    wanted = build.stiffness * _STIFFNESS * (targets - body.qpos[7:]) - build.damping * _DAMPING * body.qvel[6:]
    return jnp.clip(wanted, -_TORQUE, _TORQUE)
