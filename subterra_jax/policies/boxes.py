"""Boxes as a network is shown them: what the baseline `Avoidance` remembers of them, and the lane it would take.

This sense is made by hand, like the counting of rings; learnt is what a policy does with it. It is that of a robot of
the usual size with the usual LiDAR, whatever `params` say: what a sense computes is part of what a policy is.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from subterra_jax.baselines.agent import Observed
from subterra_jax.baselines.avoidance import N_LANES, N_SCANS, Avoidance, Surroundings
from subterra_jax.baselines.corridor import Corridor
from subterra_jax.lidar import LidarParams
from subterra_jax.parts.unicycle import VehicleParams

N_FEATURES = N_LANES + 7


@dataclasses.dataclass(frozen=True)
class Nominal:
    """The robot that the sense takes itself to be on."""

    vehicle: VehicleParams
    lidar: LidarParams


ROBOT = Nominal(VehicleParams(), LidarParams())
_AVOIDANCE = Avoidance()


def start(batch: tuple[int, ...], n_beams: int) -> Surroundings:
    """A memory of the right shape; the first look replaces it."""
    zero, hits = jnp.zeros(batch), jnp.zeros((*batch, N_SCANS, n_beams))
    return Surroundings(Corridor(zero, zero, zero), hits, hits, jnp.zeros(batch, jnp.int32), zero)


def look(
    memory: Surroundings,
    ranges: Float[Array, "*env n_beams"],
    action: Float[Array, "*env 2"],
    first: Bool[Array, "*env"],
    turned: Bool[Array, "*env"],
) -> Surroundings:
    """Takes a scan in.

    Args:
        memory: Before.
        ranges: The scan, m.
        action: What was done since the last one, m/s and rad/s.
        first: The scan begins an episode.
        turned: The robot has just turned round.
    """

    def one(memory: Surroundings, ranges: Array, action: Array, first: Array, turned: Array) -> Surroundings:
        zero = jnp.zeros(())
        seen = Observed(flat=ranges, ranges=ranges, distance=zero, heading=zero)
        # Else XLA works out the first look again wherever it is used, and compiles for minutes on a CPU.
        memory = jax.lax.optimization_barrier(_where(first, _AVOIDANCE.begin(seen, ROBOT), memory))
        # A robot does not back up.
        driven = jnp.stack([jnp.maximum(action[0], 0.0), action[1]])
        after = _AVOIDANCE.look(memory, seen, driven, ROBOT)
        return _where(turned, _AVOIDANCE.turned(after), after)

    return _over_batch(one, ranges.ndim - 1)(memory, ranges, action, first, turned)


def features(memory: Surroundings) -> Float[Array, "*env n"]:
    """How far each lane is free from right to left, the lane it would take and how to turn there, room ahead, walls."""

    def one(memory: Surroundings) -> Array:
        walls = memory.corridor
        _, free = _AVOIDANCE.lanes(memory, ROBOT)
        room = _AVOIDANCE.room(memory, walls.angle, ROBOT)
        single = [
            jnp.clip(memory.lane - walls.offset, -2.0, 2.0),
            memory.lane / 2.0,
            walls.offset / 2.0,
            jnp.clip(2.0 * walls.angle, -3.0, 3.0),
            jnp.minimum(room, 3.0) / 2.0,
            0.5 * (walls.left + walls.right) - 2.8,
            _AVOIDANCE.heading(memory, ROBOT) - walls.angle,
        ]
        return jnp.concatenate([free / _AVOIDANCE.look_ahead, jnp.stack(single)])

    return _over_batch(one, memory.lane.ndim)(memory)


def cosine(memory: Surroundings) -> Float[Array, "*env"]:
    """Of the angle between heading and axis."""
    return jnp.cos(memory.corridor.angle)


def _over_batch(function, n_axes: int):
    """A function of one robot over leading axes."""
    for _ in range(n_axes):
        function = jax.vmap(function)
    return function


def _where(condition: Bool[Array, ""], one: Surroundings, other: Surroundings) -> Surroundings:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b).astype(b.dtype), one, other)
