"""Steering along the tunnel: one controller for all who see walls, pure pursuit, and one for who sees nothing."""

from typing import Any, Protocol

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.baselines.agent import Observed
from subterra_jax.baselines.corridor import Corridor, first_look, look, moved, turned
from subterra_jax.lidar import bearings
from subterra_jax.parts.unicycle import wrap
from subterra_jax.state import EnvParams


class Steering(Protocol):
    """Turns a wanted speed into a command; a `flax.struct.dataclass` without state."""

    uses_lidar: bool

    def begin(self, obs: Observed, params: EnvParams) -> Any:
        """Its memory at the start."""

    def look(self, memory: Any, obs: Observed, command: Float[Array, "2"], params: EnvParams) -> Any:
        """Its memory after a command and the observation that followed."""

    def cosine(self, memory: Any) -> Float[Array, ""]:
        """Of the angle between heading and axis."""

    def steer(self, memory: Any, speed: Float[Array, ""], params: EnvParams) -> Float[Array, "2"]:
        """Speed (m/s), not above the wanted one, and yaw rate (rad/s)."""

    def turned(self, memory: Any) -> Any:
        """Its memory after it was turned round."""


@struct.dataclass
class CentreLine:
    """PD control of offset and angle between the walls.

    Attributes:
        offset_gain: Yaw rate for an offset, rad/s for each metre.
        angle_gain: Yaw rate for an angle, 1/s.
    """

    offset_gain: float = 0.8
    angle_gain: float = 2.0
    uses_lidar: bool = struct.field(pytree_node=False, default=True)

    def begin(self, obs: Observed, params: EnvParams) -> Corridor:
        """The walls as first seen."""
        return first_look(obs.ranges, params)

    def look(self, memory: Corridor, obs: Observed, command: Float[Array, "2"], params: EnvParams) -> Corridor:
        """The walls tracked."""
        return look(moved(memory, command, params), obs.ranges, params)

    def cosine(self, memory: Corridor) -> Float[Array, ""]:
        """Of the tracked angle."""
        return jnp.cos(memory.angle)

    def steer(self, memory: Corridor, speed: Float[Array, ""], params: EnvParams) -> Float[Array, "2"]:
        """Towards the middle."""
        del params
        return jnp.stack([speed, -self.offset_gain * memory.offset - self.angle_gain * memory.angle])

    def turned(self, memory: Corridor) -> Corridor:
        """Left is right now."""
        return turned(memory)


@struct.dataclass
class Pursuit:
    """Pure pursuit of a point midway between the walls, from one scan alone.

    Attributes:
        beam: Which beam on either side gives the two points between which it lies, the first one left of straight ahead
            being 1; 2 of 16 looks 45° to the side.

    Source: Coulter 1992, Implementation of the Pure Pursuit Path Tracking Algorithm.
    """

    beam: int = struct.field(pytree_node=False, default=2)
    uses_lidar: bool = struct.field(pytree_node=False, default=True)

    def begin(self, obs: Observed, params: EnvParams) -> Float[Array, "2"]:
        """The point in the first scan."""
        return self.look(jnp.zeros(2), obs, jnp.zeros(2), params)

    def look(
        self, memory: Float[Array, "2"], obs: Observed, command: Float[Array, "2"], params: EnvParams
    ) -> Float[Array, "2"]:
        """The point in this scan, ahead and to the left, m."""
        del memory, command, params
        bearing = float(bearings(obs.ranges.shape[0])[self.beam])
        left, right = obs.ranges[self.beam], obs.ranges[-self.beam]
        return 0.5 * jnp.stack([(left + right) * jnp.cos(bearing), (left - right) * jnp.sin(bearing)])

    def cosine(self, memory: Float[Array, "2"]) -> Float[Array, ""]:
        """It takes itself to be parallel to the axis."""
        return jnp.ones_like(memory[0])

    def steer(self, memory: Float[Array, "2"], speed: Float[Array, ""], params: EnvParams) -> Float[Array, "2"]:
        """On the circle through the point."""
        del params
        square = memory[0] * memory[0] + memory[1] * memory[1]
        return jnp.stack([speed, 2.0 * jnp.maximum(speed, 0.1) * memory[1] / jnp.maximum(square, 0.01)])

    def turned(self, memory: Float[Array, "2"]) -> Float[Array, "2"]:
        """Nothing to keep."""
        return memory


@struct.dataclass
class HeadingHold:
    """Keeps the heading it began with, by the odometer; blind.

    Attributes:
        gain: Yaw rate for an angle, 1/s; 0 drives straight on whatever the odometer says.
    """

    gain: float = 2.0
    uses_lidar: bool = struct.field(pytree_node=False, default=False)

    def begin(self, obs: Observed, params: EnvParams) -> Float[Array, "2"]:
        """Heading and the one to hold, rad."""
        del params
        return jnp.stack([obs.heading, obs.heading])

    def look(
        self, memory: Float[Array, "2"], obs: Observed, command: Float[Array, "2"], params: EnvParams
    ) -> Float[Array, "2"]:
        """The heading read."""
        del command, params
        return jnp.stack([obs.heading, memory[1]])

    def cosine(self, memory: Float[Array, "2"]) -> Float[Array, ""]:
        """It takes itself to be parallel to the axis."""
        return jnp.ones_like(memory[0])

    def steer(self, memory: Float[Array, "2"], speed: Float[Array, ""], params: EnvParams) -> Float[Array, "2"]:
        """Back to the heading."""
        del params
        return jnp.stack([speed, -self.gain * wrap(memory[0] - memory[1])])

    def turned(self, memory: Float[Array, "2"]) -> Float[Array, "2"]:
        """The opposite one from now on."""
        return jnp.stack([memory[0], wrap(memory[1] + jnp.pi)])
