"""Where one is by counting rings through faults, without a map: `ringgrid` as a localiser, and how fast it drives."""

import dataclasses
from typing import Any

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.baselines import drift
from subterra_jax.baselines.agent import Known, Observed
from subterra_jax.baselines.avoidance import steering_of
from subterra_jax.baselines.fused import Belief, FusedCount
from subterra_jax.baselines.navigator import Navigator
from subterra_jax.baselines.rings import grid as ringgrid
from subterra_jax.baselines.stations import Driven, Station
from subterra_jax.baselines.steering import CentreLine, Steering
from subterra_jax.state import EnvParams

_LEARNING, _SLOW = 15.0, 0.5  # m in which rings are learnt, and the speed there, m/s: four scans in place of one
_CRUISE = 1.2  # m/s: a patch of wet rail takes less from a step than what a scan can tell
_LOCKED = 0.1  # m, what the pattern itself is out by: it was learnt while the start was left behind


@struct.dataclass
class Counted:
    """Memory of one who counts rings.

    Attributes:
        start: Believed station of the start, m, and its standard deviation.
        track: The rings.
        reckoning: Commands and odometry fused.
    """

    start: Float[Array, "2"]
    track: ringgrid.GridTrack
    reckoning: Belief


@struct.dataclass
class RingFilter:
    """Counts rings where the walls have any, on wet rail too, and falls back on commands and odometry where not.

    Attributes:
        wet: Whether the task has wet rail: it says so of itself, as it says how large its other errors may be.
        privileged: It is told nothing.
    """

    wet: bool = struct.field(pytree_node=False, default=True)
    privileged: bool = struct.field(pytree_node=False, default=False)

    def begin(self, obs: Observed, params: EnvParams) -> Counted:
        """At the believed start."""
        start = jnp.stack([jnp.asarray(value, jnp.float32) for value in drift.believed_start(params)])
        track = ringgrid.start((), obs.ranges.shape[-1], self.wet)
        return Counted(start, track, FusedCount().begin(obs, params))

    def update(
        self, memory: Counted, obs: Observed, driven: Driven, params: EnvParams, known: Known
    ) -> tuple[Station, Counted]:
        """Dead reckoning, then the scan."""
        fused, reckoning = FusedCount().update(memory.reckoning, obs, driven, params, known)
        commanded = driven.speed * params.vehicle.period
        moved = ringgrid.moved(commanded, obs.distance - memory.reckoning.reading) * driven.cosine
        loss = drift.fault_sizes(params).wet_loss if self.wet else 0.0
        track = ringgrid.advance(memory.track, obs.ranges, moved, driven.direction, jnp.asarray(obs.ring_pitch), loss)
        heard, lost = jnp.hypot(track.spread, _LOCKED), jnp.exp(fused.log_sigma)
        sigma = jnp.hypot(track.strength * heard + (1.0 - track.strength) * lost, memory.start[1])
        estimate = Station(memory.start[0] + track.station, jnp.log(sigma), driven.direction)
        return estimate, dataclasses.replace(memory, track=track, reckoning=reckoning)


@struct.dataclass
class Driving:
    """Memory of `Unhurried`.

    Attributes:
        steering: That of the steering.
        driven: Distance commanded, m.
    """

    steering: Any
    driven: Float[Array, ""]


@struct.dataclass
class Unhurried:
    """A steering that looks at the first rings for long and at the others for long enough, where there is a goal.

    Attributes:
        steering: Which way.
        cruise: Largest speed, m/s.
        slow: The same at first, m/s,
        learning: for this distance, m.
        uses_lidar: As the steering.
    """

    steering: Steering
    cruise: float = _CRUISE
    slow: float = _SLOW
    learning: float = _LEARNING
    uses_lidar: bool = struct.field(pytree_node=False, default=True)

    def begin(self, obs: Observed, params: EnvParams) -> Driving:
        """At the start."""
        return Driving(self.steering.begin(obs, params), jnp.zeros(()))

    def look(self, memory: Driving, obs: Observed, command: Float[Array, "2"], params: EnvParams) -> Driving:
        """As the steering."""
        steering = self.steering.look(memory.steering, obs, command, params)
        return Driving(steering, memory.driven + command[0] * params.vehicle.period)

    def cosine(self, memory: Driving) -> Float[Array, ""]:
        """As the steering."""
        return self.steering.cosine(memory.steering)

    def steer(self, memory: Driving, speed: Float[Array, ""], params: EnvParams) -> Float[Array, "2"]:
        """As the steering, no faster."""
        if params.errand != "cover":
            speed = jnp.minimum(speed, jnp.where(memory.driven < self.learning, self.slow, self.cruise))
        return self.steering.steer(memory.steering, speed, params)

    def turned(self, memory: Driving) -> Driving:
        """As the steering."""
        return dataclasses.replace(memory, steering=self.steering.turned(memory.steering))


def ring_filter(params: EnvParams) -> Navigator:
    """The agent for a task."""
    steering = Unhurried(steering_of(params, CentreLine()))
    return Navigator(RingFilter(wet="faults" in params.parts), steering, name="ring-filter")
