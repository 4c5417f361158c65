"""Faults of version 1: their sizes are drawn for each episode and never told, and no exact zero gives them away."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax import constants
from subterra_jax.parts.faults import MAX_DELAY, FaultParams, Faults, FaultState
from subterra_jax.parts.part import Batch, Drive, Keys, Sight
from subterra_jax.parts.unicycle import wrap
from subterra_jax.state import EnvParams, State

SIZES = ("dropout_share", "dropout_steps", "dust_rate", "freeze_steps", "delay", "wet_share", "wet_loss")


@struct.dataclass
class DrawnFaultParams(FaultParams):
    """Middles of the ranges from which the sizes of the faults are drawn; the ranges are public.

    Attributes:
        spread: Each of `SIZES` is drawn evenly between 1 - spread and 1 + spread times its middle, by itself.
        origin_distance: Standard deviation of the odometer's distance at the start, m.
        origin_heading: Standard deviation of its heading there, rad.
    """

    dropout_share: float = constants.DRAWN_DROPOUT_SHARE
    delay: float = constants.DRAWN_DELAY
    spread: float = constants.FAULT_SPREAD
    origin_distance: float = constants.ORIGIN_DISTANCE_SIGMA
    origin_heading: float = constants.ORIGIN_HEADING_SIGMA


@struct.dataclass
class DrawnFaultState(FaultState):
    """Faults of one episode, and their sizes.

    Attributes:
        scale: Factors on the middles of `SIZES`, 1.
        origin: Readings of the odometer at the start, m and rad.
    """

    scale: Float[Array, "7"]
    origin: Float[Array, "2"]


@dataclasses.dataclass(frozen=True)
class DrawnFaults(Faults):
    """Faults of sizes that an agent has to find out.

    A frozen odometer goes on with its noise, as does one of a standing robot, and late observations begin with readings
    from before the start: neither shows as an exact zero.
    """

    streams: ClassVar[tuple[int, ...]] = (6, 7, 8, 9)

    def defaults(self) -> dict[str, Any]:
        """Return `faults`."""
        return {"faults": DrawnFaultParams()}

    def draw_reset(self, key: Keys, batch: Batch, params: EnvParams) -> tuple[Array, ...]:
        """Draw what `Faults` draws, seven uniform numbers for the sizes, and normal ones for what was read before."""
        bits, severity = super().draw_reset(key[:2], batch, params)
        sizes = jax.random.uniform(key[2], (*batch, len(SIZES)), jnp.float32)
        return bits, severity, sizes, jax.random.normal(key[3], (*batch, MAX_DELAY + 1, 2), jnp.float32)

    def begin(self, draw: tuple[Array, ...], state: State, params: EnvParams) -> DrawnFaultState:
        """Begin an episode without faults; the robot has stood still until now."""
        begun, faults, odometry = super().begin(draw[:2], state, params), params.faults, params.odometry
        noise = jnp.stack([jnp.asarray(odometry.distance_sigma), jnp.asarray(odometry.heading_sigma)])
        past = noise * jnp.cumsum(draw[3][:-1], axis=0)
        origin = jnp.stack([jnp.asarray(faults.origin_distance), jnp.asarray(faults.origin_heading)]) * draw[3][-1]
        fields = {field.name: getattr(begun, field.name) for field in dataclasses.fields(begun)}
        fields["seen"] = begun.seen.at[1:, 4:].add(-past)
        return DrawnFaultState(**fields, scale=1.0 + faults.spread * (2.0 * draw[2] - 1.0), origin=origin)

    def sizes(self, own: Any, params: EnvParams) -> FaultParams:
        """Return the sizes of the faults of an episode at severity 4."""
        middle = params.faults
        return middle.replace(**{name: getattr(middle, name) * own.scale[i] for i, name in enumerate(SIZES)})

    def drive(self, own: Any, drive: Drive, state: State, params: EnvParams) -> Drive:
        """Take speed from the robot on wet rail; the wheels of a frozen odometer seem to stand."""
        drive = super().drive(own, drive, state, params)
        return Drive(jnp.where(super().holds_odometer(own), 0.0, drive.wheels), drive.motion)

    def holds_odometer(self, own: Any) -> Bool[Array, ""]:
        """Hold nothing: the odometer counts wheels that seem to stand, with its noise."""
        del own
        return jnp.zeros((), bool)

    def look_from(self, own: Any, sight: Sight, params: EnvParams) -> Sight:
        """Show an earlier moment, by an odometer that did not begin at 0."""
        sight = super().look_from(own, sight, params)
        reading = sight.parts["odometry"]
        shifted = dataclasses.replace(
            reading, distance=reading.distance + own.origin[0], heading=wrap(reading.heading + own.origin[1])
        )
        return dataclasses.replace(sight, parts={**sight.parts, "odometry": shifted})

    def privileged(self, own: Any) -> dict[str, Array]:
        """Return the severity, and the factors on the middles of the sizes that a bound may know."""
        return {**super().privileged(own), **{f"fault_{name}": own.scale[i] for i, name in enumerate(SIZES)}}
