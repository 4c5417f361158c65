"""Turning round where one stands, as far as the odometer's heading tells."""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.baselines.mission import TURN_SPEED
from subterra_jax.parts.unicycle import wrap
from subterra_jax.state import EnvParams

_TURNED = 0.1  # rad; what is left is for the steering


@struct.dataclass
class Turn:
    """A turn.

    Attributes:
        left: Angle still to turn, rad; 0 while it drives.
        heading: Last reading of the odometer's heading, rad.
    """

    left: Float[Array, ""]
    heading: Float[Array, ""]


def straight(heading: Float[Array, ""]) -> Turn:
    """No turn; `heading` is the odometer's, rad."""
    return Turn(jnp.zeros(()), heading)


def turning(turn: Turn) -> Bool[Array, ""]:
    """Whether it is turning round."""
    return turn.left > 0.0


def begun(turn: Turn, wanted: Bool[Array, ""]) -> Turn:
    """Half a turn to the left from here on, where it is wanted and not under way."""
    return dataclasses.replace(turn, left=jnp.where(wanted & ~turning(turn), jnp.pi, turn.left))


def watched(turn: Turn, heading: Float[Array, ""]) -> tuple[Turn, Bool[Array, ""]]:
    """The turn after a reading of the heading (rad), and whether it is done with that."""
    left = turn.left - wrap(heading - turn.heading)
    done = turning(turn) & (left < _TURNED)
    return Turn(jnp.where(turning(turn) & ~done, left, 0.0), heading), done


def command(turn: Turn, params: EnvParams) -> Float[Array, "2"]:
    """Creeping round on the spot: one that stands for a second has reported."""
    rate = jnp.minimum(jnp.asarray(params.vehicle.yaw_rate_max), turn.left / params.vehicle.period)
    return jnp.stack([jnp.full_like(rate, TURN_SPEED), rate])
