"""The driver in training: what velocity is asked for, and how the robot is kept between the rails."""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.b2 import rotation
from subterra_jax.b2.params import CommandParams
from subterra_jax.b2.physics import Body

_TURN, _SIDESTEP, _AIM, _FREE = 1.5, 1.0, 1.5, 0.5  # 1/s, 1/s, rad/m, rad


@struct.dataclass
class Place:
    """Where the robot is on the track.

    Attributes:
        ahead: Of the anchor, m.
        lateral: To the left of the axis, m.
        height: Of the trunk's middle over the tops of the sleepers, m.
        forward: Direction of the trunk's x along the track and to its left.
    """

    ahead: Float[Array, ""]
    lateral: Float[Array, ""]
    height: Float[Array, ""]
    forward: Float[Array, "2"]


def locate(body: Body, quaternion: Float[Array, "4"]) -> Place:
    """Where a robot is.

    Args:
        body: Positions from the anchor.
        quaternion: Of the anchor.
    """
    back = rotation.inverse(quaternion)
    ahead, lateral, height = rotation.rotate(back, body.qpos[:3])
    forward = rotation.rotate(back, rotation.rotate(body.qpos[3:7], jnp.array([1.0, 0.0, 0.0])))
    return Place(ahead, lateral, height, forward[:2])


def wish(noise: Float[Array, "4"], params: CommandParams) -> Float[Array, "3"]:
    """A new command: uniform, or to stand.

    Args:
        noise: In [-1, 1): the velocities, and whether to stand.
        params: The driver.
    """
    low, high = jnp.asarray(params.low), jnp.asarray(params.high)
    drawn = low + 0.5 * (noise[:3] + 1.0) * (high - low)
    return jnp.where(0.5 * (noise[3] + 1.0) < params.still, 0.0, drawn)


def keep(wanted: Float[Array, "3"], place: Place, facing: Float[Array, ""], params: CommandParams) -> Float[Array, "3"]:
    """The command to a robot that is not to leave the track: as wanted where that does not lead off it.

    Args:
        wanted: Forward and to the left (m/s), yaw rate (rad/s).
        place: Where the robot is.
        facing: 1 where it is to face growing station, -1 the other way.
        params: The driver.
    """
    astray = facing * place.lateral
    heading = jnp.arctan2(facing * place.forward[1], facing * place.forward[0])
    towards = jnp.where(wanted[0] < 0.0, -1.0, 1.0)
    aim = towards * jnp.clip(-_AIM * astray, -0.5, 0.5)
    yaw_rate = jnp.clip(wanted[2], _TURN * (aim - _FREE - heading), _TURN * (aim + _FREE - heading))
    room = params.corridor
    left = jnp.clip(wanted[1], _SIDESTEP * (-room - astray), _SIDESTEP * (room - astray))
    kept = jnp.clip(jnp.stack([wanted[0], left, yaw_rate]), jnp.asarray(params.low), jnp.asarray(params.high))
    return jnp.where(stands(wanted), 0.0, kept)


def stands(wanted: Float[Array, "3"]) -> Bool[Array, ""]:
    """Whether a command asks to stand."""
    return (wanted[0] == 0.0) & (wanted[1] == 0.0) & (wanted[2] == 0.0)
