"""Steering round boxes: remember where beams hit something short of the walls, and drive where nothing was hit."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.baselines import corridor
from subterra_jax.baselines.agent import Observed
from subterra_jax.baselines.corridor import Corridor, Robot
from subterra_jax.baselines.steering import CentreLine
from subterra_jax.lidar import bearings
from subterra_jax.state import EnvParams

N_SCANS = 32  # that are remembered
_SEEN = 6.0  # m; what lies further away is not remembered
_AT_WALL = 0.3  # m; a hit so near a wall is the wall
N_LANES = 17
_N_STEEPER, _ACROSS = 5, 1.5  # angles tried, rad at most
_SPARE = 0.2  # m of room, beyond that at which it stands, which a way must have
_IN_LANE = 0.1  # m; nearer than that to its lane it follows the axis


@struct.dataclass
class Surroundings:
    """The corridor, and hits on boxes along it.

    Attributes:
        corridor: The walls.
        along: How far ahead along the axis each hit lies, m.
        across: How far left of the middle between the walls, m.
        newest: Which row of them is the newest.
        lane: Where the robot wants to be, m left of the middle.
    """

    corridor: Corridor
    along: Float[Array, "n_scans n_beams"]
    across: Float[Array, "n_scans n_beams"]
    newest: Int[Array, ""]
    lane: Float[Array, ""]


@struct.dataclass
class Avoidance:
    """Keeps to the free lane nearest to where it is, and slows down where its own is blocked.

    Attributes:
        speed: Largest speed, m/s; hits on a box become denser with the time one has to look at it.
        margin: Free space wanted beside the robot, m.
        headway: Distance to a box ahead of which it stands, from its middle, m.
        look_ahead: How far ahead a lane must be free, m.
        offset_gain: Wanted angle for a distance from the lane, rad/m.
        angle_gain: Yaw rate for an angle, 1/s.
    """

    speed: float = 1.2
    margin: float = 0.15
    headway: float = 0.6
    look_ahead: float = 4.0
    offset_gain: float = 0.8
    angle_gain: float = 4.0
    uses_lidar: bool = struct.field(pytree_node=False, default=True)

    def begin(self, obs: Observed, params: Robot) -> Surroundings:
        """Nothing hit yet."""
        nowhere = jnp.full((N_SCANS, obs.ranges.shape[0]), -1e3)
        walls = corridor.first_look(obs.ranges, params)
        return Surroundings(walls, nowhere, nowhere, jnp.zeros((), jnp.int32), jnp.zeros(()))

    def look(self, memory: Surroundings, obs: Observed, command: Float[Array, "2"], params: Robot) -> Surroundings:
        """Track the walls, move the hits along, add those of this scan, choose a lane."""
        before = memory.corridor
        walls = corridor.look(corridor.moved(before, command, params), obs.ranges, params)
        ahead = command[0] * params.vehicle.period * jnp.cos(before.angle + 0.5 * command[1] * params.vehicle.period)
        newest = (memory.newest + 1) % N_SCANS
        along, across = _hits(walls, obs.ranges)
        along = (memory.along - ahead).at[newest].set(along)
        across = memory.across.at[newest].set(across)
        # Else XLA works all of this out again for every lane and way that is looked along.
        seen = jax.lax.optimization_barrier(Surroundings(walls, along, across, newest, memory.lane))
        return dataclasses.replace(seen, lane=self._lane(seen, params))

    def cosine(self, memory: Surroundings) -> Float[Array, ""]:
        """Of the tracked angle."""
        return jnp.cos(memory.corridor.angle)

    def steer(self, memory: Surroundings, speed: Float[Array, ""], params: Robot) -> Float[Array, "2"]:
        """Into the lane, and not into what stands in the way."""
        turn = self.heading(memory, params) - memory.corridor.angle
        room = self.room(memory, memory.corridor.angle, params)
        # Misaligned, it turns first; and it never stands, because standing for a second ends the episode.
        aligned = jnp.clip(1.0 - jnp.abs(turn), 0.1, 1.0)
        allowed = jnp.maximum(jnp.minimum(self.speed * aligned, 1.5 * (room - self.headway)), 0.1)
        return jnp.stack([jnp.minimum(speed, allowed), self.angle_gain * turn])

    def heading(self, memory: Surroundings, params: Robot) -> Float[Array, ""]:
        """Angle to the axis at which it goes to its lane, rad; up to across the tunnel where a box is near."""
        away = memory.lane - memory.corridor.offset
        plain = jnp.clip(self.offset_gain * away, -1.3, 1.3)
        # Where it creeps past a corner at the plain angle, its side meets the box before it is in the lane.
        steeper = plain + jnp.linspace(0.0, 1.0, _N_STEEPER) * (jnp.sign(away) * _ACROSS - plain)
        free = jax.vmap(lambda angle: self.room(memory, angle, params))(steeper) > self.headway + _SPARE
        chosen = jnp.where(jnp.any(free), jnp.argmax(free), _N_STEEPER - 1)
        return jnp.where(jnp.abs(away) > _IN_LANE, steeper[chosen], plain)

    def turned(self, memory: Surroundings) -> Surroundings:
        """What was ahead lies behind, left is right."""
        walls = memory.corridor
        turned = corridor.turned(walls)
        return dataclasses.replace(
            memory, corridor=turned, along=-memory.along, across=-memory.across, lane=-memory.lane
        )

    def lanes(self, memory: Surroundings, params: Robot) -> tuple[Float[Array, "lanes"], Float[Array, "lanes"]]:
        """Lanes from right to left, m left of the middle, and how far ahead each is free, m: at most `look_ahead`."""
        walls = memory.corridor
        wide = params.vehicle.radius + self.margin
        half = 0.5 * (walls.left + walls.right) - params.vehicle.radius - self.margin
        lane = jnp.linspace(-1.0, 1.0, N_LANES) * jnp.maximum(half, 0.1)
        ahead = (memory.along > -wide) & (memory.along < self.look_ahead)
        # A CPU would otherwise work out for each lane anew what is ahead, and take three times as long.
        along, across = jax.lax.optimization_barrier(
            (jnp.where(ahead, memory.along, self.look_ahead).ravel(), memory.across.ravel())
        )
        inside = jnp.abs(across - lane[:, None]) < wide
        return lane, jnp.min(jnp.where(inside, along, self.look_ahead), axis=1)

    def room(self, memory: Surroundings, angle: Float[Array, ""], params: Robot) -> Float[Array, ""]:
        """Distance to the first hit in the way of a robot that faces so (rad to the axis), m; 6 where there is none."""
        cos, sin = jnp.cos(angle), jnp.sin(angle)
        across = memory.across - memory.corridor.offset
        ahead = memory.along * cos + across * sin
        aside = across * cos - memory.along * sin
        in_way = (ahead > 0.0) & (jnp.abs(aside) < params.vehicle.radius + 0.05)
        return jnp.min(jnp.where(in_way, ahead, _SEEN))

    def _lane(self, memory: Surroundings, params: Robot) -> Float[Array, ""]:
        """The lane to take: free for long, near, in the middle."""
        lane, free = self.lanes(memory, params)
        away = jnp.abs(lane - memory.corridor.offset)
        cost = 2.0 * (self.look_ahead - free) + away + 0.3 * jnp.abs(lane) + 0.5 * jnp.abs(lane - memory.lane)
        return lane[jnp.argmin(cost)]


def _hits(walls: Corridor, ranges: Float[Array, "n_beams"]) -> tuple[Float[Array, "n_beams"], Float[Array, "n_beams"]]:
    """Hits short of the walls: along and across, m; far behind for every other beam."""
    bearing = jnp.asarray(bearings(ranges.shape[0]), jnp.float32) + walls.angle
    along, across = ranges * jnp.cos(bearing), ranges * jnp.sin(bearing)
    inside = (across < walls.left - _AT_WALL) & (across > _AT_WALL - walls.right)
    box: Bool[Array, n_beams] = inside & (ranges < _SEEN)
    return jnp.where(box, along, -1e3), jnp.where(box, across + walls.offset, -1e3)


def steering_of(params: EnvParams, plain: Any) -> Any:
    """Round boxes where the task has them, in place of the controller of the middle line; else as given."""
    return Avoidance() if "obstacles" in params.parts and isinstance(plain, CentreLine) else plain
