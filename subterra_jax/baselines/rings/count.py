"""Where one is by counting rings, without a map: `rings` as a localiser."""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.baselines import drift
from subterra_jax.baselines.agent import Known, Observed
from subterra_jax.baselines.fused import Belief, FusedCount
from subterra_jax.baselines.rings import loop as rings
from subterra_jax.baselines.stations import Driven, Station
from subterra_jax.state import EnvParams

_LOCKED = 0.15  # m, standard deviation while a pattern is heard; median error 0.1 m on the family's test split


@struct.dataclass
class Count:
    """Memory of one who counts rings.

    Attributes:
        start: Believed station of the start, m, and its standard deviation.
        track: The rings.
        reckoning: Commands and odometry fused.
    """

    start: Float[Array, "2"]
    track: rings.RingTrack
    reckoning: Belief


@struct.dataclass
class RingCount:
    """Counts rings where the walls have any, and falls back on commands and odometry where not."""

    privileged: bool = struct.field(pytree_node=False, default=False)

    def begin(self, obs: Observed, params: EnvParams) -> Count:
        """At the believed start."""
        start = jnp.stack([jnp.asarray(value, jnp.float32) for value in drift.believed_start(params)])
        return Count(start, rings.start((), obs.ranges.shape[-1]), FusedCount().begin(obs, params))

    def update(
        self, memory: Count, obs: Observed, driven: Driven, params: EnvParams, known: Known
    ) -> tuple[Station, Count]:
        """Dead reckoning, then the scan."""
        fused, reckoning = FusedCount().update(memory.reckoning, obs, driven, params, known)
        # Not the filter's own step, in which the flag is a fix of the filter's own error.
        commanded = driven.speed * params.vehicle.period
        moved = driven.cosine * rings.moved(commanded, obs.distance - memory.reckoning.reading)
        track = rings.advance(
            memory.track, obs.ranges, moved, driven.direction, jnp.asarray(obs.ring_pitch), careful=True
        )
        lost = jnp.exp(fused.log_sigma)
        sigma = jnp.hypot(track.strength * _LOCKED + (1.0 - track.strength) * lost, memory.start[1])
        estimate = Station(memory.start[0] + track.station, jnp.log(sigma), driven.direction)
        return estimate, dataclasses.replace(memory, track=track, reckoning=reckoning)
