"""Finds the walls in a scan and steers along the middle between them, or round boxes."""

import dataclasses
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.baselines.agent import Observed
from subterra_jax.lidar import bearings
from subterra_jax.parts.unicycle import wrap
from subterra_jax.state import EnvParams

_SIDEWAYS = 0.65  # sine of a beam's bearing above which it meets a wall near by
_GATE = 0.5  # m; a hit further than this from where the wall is expected is not the wall
_TRUST, _TRUST_ANGLE = 0.5, 0.35  # weights of one scan
_ECHO = 1e-3  # m below `range_max`: no echo

# Round boxes.
N_SCANS = 32  # scans in memory
_SEEN = 6.0  # m; hits further away are not remembered
_AT_WALL = 0.3  # m; a hit this near a wall is the wall
N_LANES = 17
_N_STEEPER, _ACROSS = 5, 1.5  # number of angles to try, and the largest, rad
_SPARE = 0.2  # m; room that a way must have beyond `headway`
_IN_LANE = 0.1  # m; this near its lane it follows the axis


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


@struct.dataclass
class Surroundings:
    """The corridor, and hits on boxes along it."""

    corridor: Corridor  # the walls
    along: Float[Array, "n_scans n_beams"]  # distance ahead along the axis at which each hit lies, m
    across: Float[Array, "n_scans n_beams"]  # distance to the left of the middle between the walls, m
    newest: Int[Array, ""]  # row of the newest hits
    lane: Float[Array, ""]  # lane to take, m left of the middle


@struct.dataclass
class Avoidance(Steering):
    """Takes the nearest free lane, and slows down where its own is blocked."""

    speed: float = 1.2  # largest speed, m/s; a slow robot gets more hits on a box
    margin: float = 0.15  # free space to keep beside the robot, m
    headway: float = 0.6  # distance from the robot's middle to a box ahead at which it stands, m
    look_ahead: float = 4.0  # length over which a lane must be free, m
    offset_gain: float = 0.8  # angle for a distance from the lane, rad/m
    angle_gain: float = 4.0  # yaw rate for an angle, 1/s

    def begin(self, obs: Observed, params: EnvParams) -> Surroundings:
        nowhere = jnp.full((N_SCANS, obs.ranges.shape[0]), -1e3)
        walls = find_walls(obs.ranges, params)
        return Surroundings(walls, nowhere, nowhere, jnp.zeros((), jnp.int32), jnp.zeros(()))

    def look(self, memory: Surroundings, obs: Observed, command: Float[Array, "2"], params: EnvParams) -> Surroundings:
        before = memory.corridor
        walls = track_walls(predict_walls(before, command, params), obs.ranges, params)
        ahead = command[0] * params.vehicle.period * jnp.cos(before.angle + 0.5 * command[1] * params.vehicle.period)
        newest = (memory.newest + 1) % N_SCANS
        along, across = _hits(walls, obs.ranges)
        along = (memory.along - ahead).at[newest].set(along)
        across = memory.across.at[newest].set(across)
        # Without the barrier XLA computes all of this again for every lane and angle.
        now = jax.lax.optimization_barrier(Surroundings(walls, along, across, newest, memory.lane))
        return dataclasses.replace(now, lane=self._lane(now, params))

    def cosine(self, memory: Surroundings) -> Float[Array, ""]:
        return jnp.cos(memory.corridor.angle)

    def steer(self, memory: Surroundings, speed: Float[Array, ""], params: EnvParams) -> Float[Array, "2"]:
        turn = self.heading(memory, params) - memory.corridor.angle
        room = self.room(memory, memory.corridor.angle, params)
        # Misaligned, it turns first; and it never stands, because standing for a second ends the episode.
        aligned = jnp.clip(1.0 - jnp.abs(turn), 0.1, 1.0)
        allowed = jnp.maximum(jnp.minimum(self.speed * aligned, 1.5 * (room - self.headway)), 0.1)
        return jnp.stack([jnp.minimum(speed, allowed), self.angle_gain * turn])

    def heading(self, memory: Surroundings, params: EnvParams) -> Float[Array, ""]:
        """Returns the angle to the axis that leads into the lane, rad; steep where a box is near."""
        away = memory.lane - memory.corridor.offset
        plain = jnp.clip(self.offset_gain * away, -1.3, 1.3)
        # At the plain angle its side would meet a near box before it is in the lane.
        steeper = plain + jnp.linspace(0.0, 1.0, _N_STEEPER) * (jnp.sign(away) * _ACROSS - plain)
        free = jax.vmap(lambda angle: self.room(memory, angle, params))(steeper) > self.headway + _SPARE
        chosen = jnp.where(jnp.any(free), jnp.argmax(free), _N_STEEPER - 1)
        return jnp.where(jnp.abs(away) > _IN_LANE, steeper[chosen], plain)

    def turn_round(self, memory: Surroundings) -> Surroundings:
        walls = memory.corridor
        mirrored = mirror_walls(walls)
        return dataclasses.replace(
            memory, corridor=mirrored, along=-memory.along, across=-memory.across, lane=-memory.lane
        )

    def lanes(self, memory: Surroundings, params: EnvParams) -> tuple[Float[Array, "lanes"], Float[Array, "lanes"]]:
        """Returns lanes from right to left, m left of the middle, and their free lengths, m, up to `look_ahead`."""
        walls = memory.corridor
        wide = params.vehicle.radius + self.margin
        half = 0.5 * (walls.left + walls.right) - params.vehicle.radius - self.margin
        lane = jnp.linspace(-1.0, 1.0, N_LANES) * jnp.maximum(half, 0.1)
        ahead = (memory.along > -wide) & (memory.along < self.look_ahead)
        # Without the barrier a CPU computes this anew for each lane, and takes three times as long.
        along, across = jax.lax.optimization_barrier(
            (jnp.where(ahead, memory.along, self.look_ahead).ravel(), memory.across.ravel())
        )
        inside = jnp.abs(across - lane[:, None]) < wide
        return lane, jnp.min(jnp.where(inside, along, self.look_ahead), axis=1)

    def room(self, memory: Surroundings, angle: Float[Array, ""], params: EnvParams) -> Float[Array, ""]:
        """Returns the distance to the first hit ahead at an angle to the axis (rad), m; 6 without hits."""
        cos, sin = jnp.cos(angle), jnp.sin(angle)
        across = memory.across - memory.corridor.offset
        ahead = memory.along * cos + across * sin
        aside = across * cos - memory.along * sin
        in_way = (ahead > 0.0) & (jnp.abs(aside) < params.vehicle.radius + 0.05)
        return jnp.min(jnp.where(in_way, ahead, _SEEN))

    def _lane(self, memory: Surroundings, params: EnvParams) -> Float[Array, ""]:
        lane, free = self.lanes(memory, params)
        away = jnp.abs(lane - memory.corridor.offset)
        cost = 2.0 * (self.look_ahead - free) + away + 0.3 * jnp.abs(lane) + 0.5 * jnp.abs(lane - memory.lane)
        return lane[jnp.argmin(cost)]


def _hits(walls: Corridor, ranges: Float[Array, "n_beams"]) -> tuple[Float[Array, "n_beams"], Float[Array, "n_beams"]]:
    """Returns the hits short of the walls, along and across, m; far behind for every other beam."""
    bearing = jnp.asarray(bearings(ranges.shape[0]), jnp.float32) + walls.angle
    along, across = ranges * jnp.cos(bearing), ranges * jnp.sin(bearing)
    inside = (across < walls.left - _AT_WALL) & (across > _AT_WALL - walls.right)
    box: Bool[Array, n_beams] = inside & (ranges < _SEEN)
    return jnp.where(box, along, -1e3), jnp.where(box, across + walls.offset, -1e3)


def steering_of(params: EnvParams, plain: Any) -> Any:
    """Returns `Avoidance` in place of the centre-line controller where the task has boxes, else `plain`."""
    return Avoidance() if "obstacles" in params.parts and isinstance(plain, CentreLine) else plain
