"""What a scan says about the walls: distance to both of them, and the angle to the axis between them."""

from typing import Protocol

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.lidar import LidarParams, bearings
from subterra_jax.parts.unicycle import VehicleParams, wrap

_SIDEWAYS = 0.65  # beams whose sine is larger look at a wall, not along it
_GATE = 0.5  # m; a hit further than this from where the wall is expected is not the wall
_TRUST, _TRUST_ANGLE = 0.5, 0.35  # of one scan
_ECHO = 1e-3  # m below `range_max`: no echo


class Robot(Protocol):
    """What has to be known of a robot to see walls and boxes with its beams; the params of a task have it."""

    @property
    def vehicle(self) -> VehicleParams:
        """How it drives."""

    @property
    def lidar(self) -> LidarParams:
        """How it sees."""


@struct.dataclass
class Corridor:
    """Where the robot is between the walls, tracked from scan to scan, so that some beams may fail.

    Attributes:
        left: Distance to the wall on the robot's left, m.
        right: Distance to the wall on its right, m.
        angle: Heading less direction of the axis in which it travels, rad.
    """

    left: Float[Array, ""]
    right: Float[Array, ""]
    angle: Float[Array, ""]

    @property
    def offset(self) -> Float[Array, ""]:
        """Distance to the left of the middle, m, looking the way it travels."""
        return 0.5 * (self.right - self.left)


def first_look(ranges: Float[Array, "n_beams"], params: Robot) -> Corridor:
    """The walls in the first scan, with the heading taken for the axis' direction and then corrected."""
    bearing = bearings(ranges.shape[0])
    side = np.abs(np.sin(bearing))
    echo = (ranges < params.lidar.range_max - _ECHO) & (side > _SIDEWAYS)
    across = ranges * jnp.asarray(side, jnp.float32)

    def middle(is_left: Bool[np.ndarray, "n_beams"]) -> Float[Array, ""]:
        found = jnp.nanmedian(jnp.where(echo & is_left, across, jnp.nan))
        return jnp.where(jnp.isnan(found), 2.0, found)

    corridor = Corridor(middle(np.sin(bearing) > 0.0), middle(np.sin(bearing) < 0.0), jnp.zeros(()))
    for _ in range(3):
        corridor = look(corridor, ranges, params)
    return corridor


def moved(corridor: Corridor, command: Float[Array, "2"], params: Robot) -> Corridor:
    """Where the robot should be after a command."""
    period = params.vehicle.period
    angle = corridor.angle + 0.5 * command[1] * period
    aside = command[0] * period * jnp.sin(angle)
    return Corridor(corridor.left - aside, corridor.right + aside, corridor.angle + command[1] * period)


def turned(corridor: Corridor) -> Corridor:
    """As seen by a robot that was turned round and now travels the other way: left is right."""
    return Corridor(corridor.right, corridor.left, wrap(corridor.angle - jnp.pi))


def look(corridor: Corridor, ranges: Float[Array, "n_beams"], params: Robot) -> Corridor:
    """Corrected by a scan: robust to beams without echo, dust in front of the wall, and boxes at its foot."""
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
    """One wall: its distance (m), and the first and second moment (m²) whose ratio is its slope."""
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
