"""A plant that does not quite do what it is told: slip between the command and the true motion."""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.wander import WanderParams, advance_wander, start_wander

N_RESET_NOISE, N_STEP_NOISE = 3, 1


@struct.dataclass
class SlipParams:
    """Sizes of the slip. Without it the sum of one's own commands is a perfect odometer.

    Attributes:
        gain_sigma: Standard deviation over episodes of the relative error of the speed, 1.
        yaw_sigma: Standard deviation over episodes of the error of the yaw rate, rad/s.
        wander: Slip that changes along the way, 1.
    """

    gain_sigma: float = 0.02
    yaw_sigma: float = 0.002
    wander: WanderParams = struct.field(default_factory=lambda: WanderParams(sigma=0.02))


@struct.dataclass
class SlipState:
    """The slip of one episode.

    Attributes:
        gain: Relative error of the speed, 1.
        yaw: Error of the yaw rate, rad/s.
        wander: The part that changes along the way, 1.
    """

    gain: Float[Array, ""]
    yaw: Float[Array, ""]
    wander: Float[Array, ""]


def start_slip(noise: Float[Array, "3"], params: SlipParams) -> SlipState:
    """The slip at the start of an episode; `noise` is standard normal."""
    return SlipState(
        gain=params.gain_sigma * noise[0],
        yaw=params.yaw_sigma * noise[1],
        wander=start_wander(noise[2], params.wander),
    )


def true_motion(command: Float[Array, "2"], state: SlipState) -> Float[Array, "2"]:
    """What the robot really does: speed (m/s), not below 0, and yaw rate (rad/s); a standing robot does not turn."""
    speed = command[0] * jnp.maximum(1.0 + state.gain + state.wander, 0.0)
    moves = (command[0] != 0.0) | (command[1] != 0.0)
    return jnp.stack([speed, command[1] + jnp.where(moves, state.yaw, 0.0)])


def advance_slip(
    state: SlipState, travelled: Float[Array, ""], noise: Float[Array, "1"], params: SlipParams
) -> SlipState:
    """The slip after a distance (m); `noise` is standard normal."""
    return dataclasses.replace(state, wander=advance_wander(state.wander, travelled, noise[0], params.wander))
