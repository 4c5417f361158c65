"""Slip between the command and the true motion."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax import constants
from subterra_jax.parts.part import Batch, Drive, Keys, Noise, Part, Step
from subterra_jax.parts.wander import WanderParams, advance_wander
from subterra_jax.state import EnvParams, State


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
