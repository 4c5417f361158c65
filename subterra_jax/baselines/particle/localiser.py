"""A particle filter on the walls of a map: what its pockets, width and curvature say about the station."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from subterra_jax.baselines.agent import Known, Observed
from subterra_jax.baselines.avoidance import steering_of
from subterra_jax.baselines.navigator import Navigator
from subterra_jax.baselines.particle.belief import believed
from subterra_jax.baselines.particle.cloud import Cloud, CloudParams, moved, new_cloud, resampled, weighed
from subterra_jax.baselines.particle.likelihood import first_look
from subterra_jax.baselines.particle.motion import (
    Reckoning,
    cloud_params,
    first_reckoning,
    odometer_share,
    reckoned,
    unseen,
)
from subterra_jax.baselines.particle.scan import Place, ScanModel
from subterra_jax.baselines.particle.wallmap import WallMap, wall_map
from subterra_jax.baselines.stations import Driven, Station
from subterra_jax.baselines.steering import CentreLine
from subterra_jax.state import EnvParams

_LEAST_SIGMA = 0.01  # m


@struct.dataclass
class Memory:
    """What the filter remembers.

    Attributes:
        cloud: The particles.
        reckoning: Dead reckoning.
        step: Cycles so far.
    """

    cloud: Cloud
    reckoning: Reckoning
    step: Int[Array, ""]


@struct.dataclass
class ParticleLocaliser:
    """Station from dead reckoning and scans, by particles.

    Its random numbers are those of `seed` and the step, so that equal observations give equal estimates.

    Attributes:
        walls: The map.
        motion: How the cloud moves.
        scan: What is believed about the LiDAR.
        odometer_share: Weight of the odometer against the command.
        seed: Of its random numbers.
        n_particles: Particles.
    """

    walls: WallMap
    motion: CloudParams
    scan: ScanModel
    odometer_share: float | Float[Array, ""]
    seed: int = 0
    n_particles: int = struct.field(pytree_node=False, default=256)
    privileged: bool = struct.field(pytree_node=False, default=False)

    @classmethod
    def of(cls, params: EnvParams, n_particles: int = 256) -> "ParticleLocaliser":
        """For a task: its map, whose tunnel may be a stack, and its nominal errors."""
        return cls(
            walls=wall_map(params.tunnel),
            motion=cloud_params(params),
            scan=ScanModel(range_sigma=float(params.lidar.range_sigma)),
            odometer_share=odometer_share(params),
            n_particles=n_particles,
        )

    def begin(self, obs: Observed, params: EnvParams) -> Memory:
        """Particles about the believed start, spread as far as it is uncertain."""
        station_key, cloud_key = jax.random.split(jax.random.key(self.seed))
        walls = self.walls.pick(params.tunnel)
        spread = jnp.clip(jax.random.normal(station_key, (self.n_particles,)), -3.0, 3.0)
        station = jnp.maximum(params.start.station + params.start.station_sigma * spread, 0.0)
        place = Place(station, jnp.zeros_like(station), jnp.zeros_like(station))
        place = first_look(walls, place, obs.ranges, jnp.asarray(params.lidar.range_max), self.scan)
        return Memory(new_cloud(cloud_key, place, self.motion), first_reckoning(obs), jnp.zeros((), jnp.int32))

    def update(
        self, memory: Memory, obs: Observed, driven: Driven, params: EnvParams, known: Known
    ) -> tuple[Station, Memory]:
        """One cycle: dead reckoning, the scan, and new particles where few are left."""
        del known
        move_key, draw_key = jax.random.split(jax.random.fold_in(jax.random.key(self.seed), 1 + memory.step))
        walls, period = self.walls.pick(params.tunnel), jnp.asarray(params.vehicle.period)
        distance, turn, reckoning = reckoned(memory.reckoning, obs, driven.speed, self.odometer_share, period)
        cloud = moved(move_key, memory.cloud, walls, distance, turn, self.motion)
        cloud = weighed(cloud, walls, obs.ranges, jnp.asarray(params.lidar.range_max), self.scan, self.motion)
        belief = believed(cloud, self.motion)
        station = belief.station + unseen(reckoning, period) * jnp.cos(belief.heading)
        direction = jnp.where(jnp.cos(belief.heading) > 0.0, 1.0, -1.0)
        estimate = Station(station, jnp.log(jnp.maximum(belief.sigma, _LEAST_SIGMA)), direction)
        return estimate, Memory(resampled(draw_key, cloud, self.motion), reckoning, memory.step + 1)


def particle_filter(params: EnvParams, n_particles: int | None = None) -> Navigator:
    """The filter with the steering and the mission of the other baselines.

    Args:
        params: The task.
        n_particles: Particles. None is 256, four times as many where the start is uncertain, twice as many where rails
            may be wet.
    """
    if n_particles is None:
        uncertain = float(np.max(np.asarray(params.start.station_sigma))) > 0.0
        n_particles = 1024 if uncertain else 512 if "faults" in params.parts else 256
    localiser = ParticleLocaliser.of(params, n_particles)
    return Navigator(localiser, steering_of(params, CentreLine()), name="particle-filter", uses_map=True)
