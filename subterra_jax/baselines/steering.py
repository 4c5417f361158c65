"""Finds the walls in a scan and steers along the middle between them."""

from typing import Any, Protocol

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.baselines.agent import Observed
from subterra_jax.lidar import bearings
from subterra_jax.parts.unicycle import wrap
from subterra_jax.state import EnvParams

_SIDEWAYS = 0.65  # sine of a beam's bearing above which it meets a wall near by
_GATE = 0.5  # m; a hit further than this from where the wall is expected is not the wall
_TRUST, _TRUST_ANGLE = 0.5, 0.35  # weights of one scan
_ECHO = 1e-3  # m below `range_max`: no echo


@struct.dataclass
class Corridor:
    """Position between the walls. It is tracked from scan to scan, so that some beams may fail."""

    left: Float[Array, ""]  # distance to the wall on the robot's left, m
    right: Float[Array, ""]  # distance to the wall on its right, m
    angle: Float[Array, ""]  # heading less the direction of travel along the axis, rad

    @property
    def offset(self) -> Float[Array, ""]:
        """Distance to the left of the middle, m, as seen in the direction of travel."""
        return 0.5 * (self.right - self.left)


def find_walls(ranges: Float[Array, "n_beams"], params: EnvParams) -> Corridor:
    """Finds the walls in the first scan: assumes a heading along the axis, then corrects it."""
    bearing = bearings(ranges.shape[0])
    side = np.abs(np.sin(bearing))
    echo = (ranges < params.lidar.range_max - _ECHO) & (side > _SIDEWAYS)
    across = ranges * jnp.asarray(side, jnp.float32)

    def middle(is_left: Bool[np.ndarray, "n_beams"]) -> Float[Array, ""]:
        median = jnp.nanmedian(jnp.where(echo & is_left, across, jnp.nan))
        return jnp.where(jnp.isnan(median), 2.0, median)

    corridor = Corridor(middle(np.sin(bearing) > 0.0), middle(np.sin(bearing) < 0.0), jnp.zeros(()))
    for _ in range(3):
        corridor = track_walls(corridor, ranges, params)
    return corridor


def predict_walls(corridor: Corridor, command: Float[Array, "2"], params: EnvParams) -> Corridor:
    """Predicts the walls after a command, m/s and rad/s."""
    period = params.vehicle.period
    angle = corridor.angle + 0.5 * command[1] * period
    aside = command[0] * period * jnp.sin(angle)
    return Corridor(corridor.left - aside, corridor.right + aside, corridor.angle + command[1] * period)


def mirror_walls(corridor: Corridor) -> Corridor:
    """Returns the walls for the opposite direction of travel: left becomes right."""
    return Corridor(corridor.right, corridor.left, wrap(corridor.angle - jnp.pi))


def track_walls(corridor: Corridor, ranges: Float[Array, "n_beams"], params: EnvParams) -> Corridor:
    """Corrects the walls by a scan; robust to beams without echo, to dust and to boxes at the wall."""
    bearing = jnp.asarray(bearings(ranges.shape[0]), jnp.float32) + corridor.angle
    along, across = ranges * jnp.cos(bearing), ranges * jnp.sin(bearing)
    echo = (ranges < params.lidar.range_max - _ECHO) & (jnp.abs(jnp.sin(bearing)) > _SIDEWAYS)
    left, left_moment, left_size = _side(along, across, echo & (across > 0.0), corridor.left)
    right, right_moment, right_size = _side(along, -across, echo & (across < 0.0), corridor.right)
    size = left_size + right_size
    slope = jnp.where(size > 1.0, (left_moment - right_moment) / jnp.maximum(size, 1.0), 0.0)
    return Corridor(left, right, corridor.angle - _TRUST_ANGLE * jnp.clip(slope, -0.5, 0.5))


def _side(
    along: Float[Array, "n_beams"],
    across: Float[Array, "n_beams"],
    hit: Bool[Array, "n_beams"],
    expected: Float[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Measures one wall: its distance (m), and the two moments (m²) whose ratio is its slope."""
    near = hit & (jnp.abs(across - expected) < _GATE)
    lost = (jnp.sum(near) < 2) & (jnp.sum(hit) >= 4)
    used = jnp.where(lost, hit, near)
    n = jnp.sum(used)
    middle = jnp.nanmedian(jnp.where(used, across, jnp.nan))
    trust = jnp.where(lost, 1.0, _TRUST)
    distance = jnp.where(n > 0, expected + trust * (middle - expected), expected)
    mean = lambda values: jnp.sum(jnp.where(used, values, 0.0)) / jnp.maximum(n, 1)  # noqa: E731
    x, y = along - mean(along), across - mean(across)
    usable = used & ~lost
    return distance, jnp.sum(jnp.where(usable, x * y, 0.0)), jnp.sum(jnp.where(usable, x * x, 0.0))


class Steering(Protocol):
    """Turns a target speed into a command; a `flax.struct.dataclass` without state."""

    @property
    def uses_lidar(self) -> bool:
        """True where it reads the ranges."""
        return True

    def begin(self, obs: Observed, params: EnvParams) -> Any:
        """Returns the memory at the start."""

    def look(self, memory: Any, obs: Observed, command: Float[Array, "2"], params: EnvParams) -> Any:
        """Returns the memory after a command and the observation that followed."""

    def cosine(self, memory: Any) -> Float[Array, ""]:
        """Returns the cosine of the angle between heading and axis."""

    def steer(self, memory: Any, speed: Float[Array, ""], params: EnvParams) -> Float[Array, "2"]:
        """Returns speed (m/s), at most `speed`, and yaw rate (rad/s)."""

    def turn_round(self, memory: Any) -> Any:
        """Returns the memory after the robot has turned round."""


@struct.dataclass
class CentreLine(Steering):
    """PD controller of offset and angle between the walls."""

    offset_gain: float = 0.8  # yaw rate for an offset, rad/s for each metre
    angle_gain: float = 2.0  # yaw rate for an angle, 1/s

    def begin(self, obs: Observed, params: EnvParams) -> Corridor:
        return find_walls(obs.ranges, params)

    def look(self, memory: Corridor, obs: Observed, command: Float[Array, "2"], params: EnvParams) -> Corridor:
        return track_walls(predict_walls(memory, command, params), obs.ranges, params)

    def cosine(self, memory: Corridor) -> Float[Array, ""]:
        return jnp.cos(memory.angle)

    def steer(self, memory: Corridor, speed: Float[Array, ""], params: EnvParams) -> Float[Array, "2"]:
        return jnp.stack([speed, -self.offset_gain * memory.offset - self.angle_gain * memory.angle])

    def turn_round(self, memory: Corridor) -> Corridor:
        return mirror_walls(memory)
