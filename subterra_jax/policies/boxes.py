"""The sense of boxes: what the baseline `Avoidance` remembers of them and which lane it would take, as network inputs.

The sense is written by hand, like the counting of rings; a policy learns what to do with it. It computes for a robot of
the usual size with the usual LiDAR, whatever the task's params are, because it is part of the policy.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from subterra_jax.baselines.agent import Observed
from subterra_jax.baselines.avoidance import N_LANES, N_SCANS, Avoidance, Surroundings
from subterra_jax.baselines.steering import Corridor
from subterra_jax.lidar import LidarParams
from subterra_jax.parts.unicycle import VehicleParams

N_FEATURES = N_LANES + 7


@dataclasses.dataclass(frozen=True)
class Nominal:
    """The robot that the sense computes for.

    Attributes:
        vehicle: Vehicle of default size.
        lidar: Default LiDAR.
    """

    vehicle: VehicleParams
    lidar: LidarParams


ROBOT = Nominal(VehicleParams(), LidarParams())
_AVOIDANCE = Avoidance()


def start(batch: tuple[int, ...], n_beams: int) -> Surroundings:
    """Returns a memory of the right shape; the first look replaces its values."""
    zero, hits = jnp.zeros(batch), jnp.zeros((*batch, N_SCANS, n_beams))
    return Surroundings(Corridor(zero, zero, zero), hits, hits, jnp.zeros(batch, jnp.int32), zero)


def look(
    memory: Surroundings,
    ranges: Float[Array, "*env n_beams"],
    action: Float[Array, "*env 2"],
    first: Bool[Array, "*env"],
    turned: Bool[Array, "*env"],
) -> Surroundings:
    """Updates the memory with a scan.

    Args:
        memory: Memory before the scan.
        ranges: The scan, m.
        action: Action since the last scan, m/s and rad/s.
        first: True where the scan begins an episode.
        turned: True where the robot has just turned round.
    """

    def look_once(memory: Surroundings, ranges: Array, action: Array, first: Array, turned: Array) -> Surroundings:
        zero = jnp.zeros(())
        obs = Observed(flat=ranges, ranges=ranges, distance=zero, heading=zero)
        # Without the barrier XLA computes the first look wherever it is used, and compiles for minutes on a CPU.
        memory = jax.lax.optimization_barrier(_where(first, _AVOIDANCE.begin(obs, ROBOT), memory))
        # The robot cannot reverse.
        command = jnp.stack([jnp.maximum(action[0], 0.0), action[1]])
        after = _AVOIDANCE.look(memory, obs, command, ROBOT)
        return _where(turned, _AVOIDANCE.turn_round(after), after)

    return _over_batch(look_once, ranges.ndim - 1)(memory, ranges, action, first, turned)


def features(memory: Surroundings) -> Float[Array, "*env n"]:
    """Returns the free length of each lane from right to left, the lane to take, the room ahead and the walls."""

    def features_of_one(memory: Surroundings) -> Array:
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

    return _over_batch(features_of_one, memory.lane.ndim)(memory)


def cosine(memory: Surroundings) -> Float[Array, "*env"]:
    """Returns the cosine of the angle between heading and axis."""
    return jnp.cos(memory.corridor.angle)


def _over_batch(function: Callable[..., Any], n_axes: int) -> Callable[..., Any]:
    """Maps a function of one robot over leading axes."""
    for _ in range(n_axes):
        function = jax.vmap(function)
    return function


def _where(condition: Bool[Array, ""], one: Surroundings, other: Surroundings) -> Surroundings:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b).astype(b.dtype), one, other)
