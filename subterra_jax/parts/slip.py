"""Slip between the command and the true motion, and the error that wanders over the distance, also of the odometer."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax import constants
from subterra_jax.parts.part import Batch, Drive, Keys, Noise, Part, Step
from subterra_jax.state import EnvParams, State


@struct.dataclass
class WanderParams:
    """A stationary Ornstein-Uhlenbeck process over distance, which starts with a normal number of `sigma`.

    Attributes:
        sigma: Standard deviation at any place, in the unit of the error.
        length: Distance over which its correlation falls to 1/e, m.
    """

    sigma: float
    length: float = constants.WANDER_LENGTH


def advance_wander(
    value: Float[Array, ""], travelled: Float[Array, ""], noise: Float[Array, ""], params: WanderParams
) -> Float[Array, ""]:
    """Return the value a distance further on; unchanged where nothing was travelled.

    Args:
        travelled: Distance, m; its sign does not matter.

    Source: Gillespie 1996, Exact numerical simulation of the Ornstein-Uhlenbeck process.
    """
    ratio = jnp.abs(travelled) / params.length
    # The root has no derivative at 0: a standing robot gets 0, and neither branch a NaN.
    moves = ratio > 0.0
    # expm1, because 1 - exp(-x) has few digits left at a step of 0.2 m in 30 m.
    fraction = jnp.where(moves, jnp.sqrt(-jnp.expm1(-2.0 * jnp.where(moves, ratio, 1.0))), 0.0)
    return jnp.exp(-ratio) * value + params.sigma * fraction * noise


@struct.dataclass
class SlipParams:
    """Sizes of the slip. Without slip, the sum of the commands is a perfect odometer.

    Attributes:
        gain_sigma: Standard deviation over episodes of the relative error of the speed, 1.
        yaw_sigma: Standard deviation over episodes of the error of the yaw rate, rad/s.
        wander: Relative error of the speed that changes along the way, 1.
    """

    gain_sigma: float = constants.SLIP_GAIN_SIGMA
    yaw_sigma: float = constants.SLIP_YAW_SIGMA
    wander: WanderParams = struct.field(default_factory=lambda: WanderParams(sigma=constants.SLIP_WANDER_SIGMA))


@struct.dataclass
class SlipState:
    """The slip of one episode."""

    gain: Float[Array, ""]  # relative error of the speed, 1
    yaw: Float[Array, ""]  # error of the yaw rate, rad/s
    wander: Float[Array, ""]  # relative error of the speed at present, on top of `gain`, 1


def true_motion(command: Float[Array, "2"], state: SlipState) -> Float[Array, "2"]:
    """Return the true speed (m/s), not below 0, and yaw rate (rad/s); a standing robot does not turn."""
    speed = command[0] * jnp.maximum(1.0 + state.gain + state.wander, 0.0)
    moves = (command[0] != 0.0) | (command[1] != 0.0)
    return jnp.stack([speed, command[1] + jnp.where(moves, state.yaw, 0.0)])


@dataclasses.dataclass(frozen=True)
class Slip(Part):
    """A robot that does not do exactly what it is commanded."""

    name: ClassVar[str] = "slip"
    streams: ClassVar[tuple[int, ...]] = (3,)

    def defaults(self) -> dict[str, Any]:
        return {"slip": SlipParams()}

    def draw_reset(self, key: Keys, batch: Batch, params: EnvParams) -> Float[Array, "*batch 3"]:
        return jax.random.normal(key, (*batch, 3), jnp.float32)

    def normals(self, params: EnvParams) -> int:
        return 1

    def begin(self, draw: Float[Array, "3"], state: State, params: EnvParams) -> SlipState:
        slip = params.slip
        return SlipState(slip.gain_sigma * draw[0], slip.yaw_sigma * draw[1], slip.wander.sigma * draw[2])

    def drive(self, own: SlipState, drive: Drive, state: State, params: EnvParams) -> Drive:
        wheels = true_motion(drive.wheels, own)
        return Drive(wheels, wheels)

    def advance(self, own: SlipState, step: Step, noise: Noise, params: EnvParams) -> SlipState:
        wander = advance_wander(own.wander, step.moved, noise.normal[0], params.slip.wander)
        return dataclasses.replace(own, wander=wander)

    def privileged(self, own: SlipState) -> dict[str, Array]:
        """Return the slip of the speed (1) and of the yaw rate (rad/s)."""
        return {"slip": own.gain + own.wander, "yaw_slip": own.yaw}
