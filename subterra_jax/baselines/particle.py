"""A particle filter on the map of a tunnel: pockets, width and curvature of the walls tell the station."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

from subterra_jax.baselines.agent import Known, Observed, range_sigma
from subterra_jax.baselines.cloud import (
    Cloud,
    CloudParams,
    cloud_params,
    move,
    new_cloud,
    resample,
    reweight,
    summarise,
    weigh_odometer,
)
from subterra_jax.baselines.exactscan import ExactParams, exact_likelihood
from subterra_jax.baselines.navigator import Navigator
from subterra_jax.baselines.reckoning import (
    Reckoning,
    begin_reckoning,
    known_delay,
    odometer_fraction,
    reckon,
    unobserved_distance,
)
from subterra_jax.baselines.scanmodel import ScanModel, TunnelPose, fit, fit_roughly
from subterra_jax.baselines.stations import Driven, Localiser, Station, reported_start
from subterra_jax.baselines.steering import CentreLine, steering_of
from subterra_jax.baselines.wallmap import WallMap, wall_map
from subterra_jax.state import EnvParams

_LEAST_SIGMA = 0.01  # m


@struct.dataclass
class FilterMemory:
    """Memory of the filter."""

    cloud: Cloud  # the particles
    reckoning: Reckoning  # dead reckoning
    step: Int[Array, ""]  # cycles so far


@struct.dataclass
class ParticleLocaliser(Localiser):
    """Estimates the station from dead reckoning and scans, by particles.

    Its random numbers depend on `seed` and the step alone, so equal observations give equal estimates.
    """

    walls: WallMap  # the map
    motion: CloudParams  # motion of the cloud
    scan: ScanModel  # assumed errors of the LiDAR
    odometer_fraction: float | Float[Array, ""]  # weight of the odometer against the command
    # settings of the likelihood of scans that every particle casts in the true walls; None compares the ends of beams
    # with the map
    exact: ExactParams | None = None
    seed: int = 0  # seed of its random numbers
    n_particles: int = struct.field(pytree_node=False, default=256)  # number of particles
    # it gets the truth, of which it reads the sizes of the episode's faults alone
    privileged: bool = struct.field(pytree_node=False, default=False)

    @classmethod
    def of(cls, params: EnvParams, n_particles: int = 256) -> "ParticleLocaliser":
        """Makes a localiser for the map of a task, whose tunnel may be a stack, and for its nominal errors."""
        return cls(
            walls=wall_map(params.tunnel),
            motion=cloud_params(params),
            scan=ScanModel(range_sigma=range_sigma(params)),
            odometer_fraction=odometer_fraction(params),
            n_particles=n_particles,
        )

    def begin(self, obs: Observed, params: EnvParams) -> FilterMemory:
        """Spreads particles about the start as far as it is uncertain; without one evenly, facing either way."""
        n, cloud_key = self.n_particles, jax.random.key(self.seed)
        if params.goal_kind == "report":
            room, fraction = params.tunnel.length - 2.0 * params.goal.margin, (jnp.arange(n) + 0.5) / n
            station, heading = params.goal.margin + room * fraction, jnp.where(jnp.arange(n) % 2 == 0, 0.0, jnp.pi)
        else:
            station_key, cloud_key = jax.random.split(cloud_key)
            spread = jnp.clip(jax.random.normal(station_key, (n,)), -3.0, 3.0)
            station = jnp.maximum(reported_start(obs, params) + params.start.station_sigma * spread, 0.0)
            heading = jnp.zeros_like(station)
        walls, range_max = self.walls.pick(params.tunnel), jnp.asarray(params.lidar.range_max)
        pose = fit_roughly(walls, TunnelPose(station, jnp.zeros(n), heading), obs.ranges, range_max, self.scan)
        return FilterMemory(new_cloud(cloud_key, pose, self.motion), begin_reckoning(obs), jnp.zeros((), jnp.int32))

    def update(
        self, memory: FilterMemory, obs: Observed, driven: Driven, params: EnvParams, known: Known
    ) -> tuple[Station, FilterMemory]:
        move_key, draw_key = jax.random.split(jax.random.fold_in(jax.random.key(self.seed), 1 + memory.step))
        cloud, reckoning = self._advance(move_key, memory, obs, driven, params, known)
        station, sigma, heading = summarise(cloud, self.motion)
        station = station + unobserved_distance(reckoning, jnp.asarray(params.vehicle.period)) * jnp.cos(heading)
        direction = jnp.where(jnp.cos(heading) > 0.0, 1.0, -1.0)
        estimate = Station(station, jnp.log(jnp.maximum(sigma, _LEAST_SIGMA)), direction)
        return estimate, FilterMemory(resample(draw_key, cloud, self.motion), reckoning, memory.step + 1)

    def _advance(
        self, key: PRNGKeyArray, memory: FilterMemory, obs: Observed, driven: Driven, params: EnvParams, known: Known
    ) -> tuple[Cloud, Reckoning]:
        walls, motion, cloud = self.walls.pick(params.tunnel), self.motion, memory.cloud
        period, range_max = jnp.asarray(params.vehicle.period), jnp.asarray(params.lidar.range_max)
        apart = motion.odometer is not None
        before = known_delay(memory.reckoning, params, known)
        # The odometer's noise of each step would otherwise be noise of the motion: it is weighed apart.
        distance, turn, reckoning = reckon(before, obs, driven.speed, 0.0 if apart else self.odometer_fraction, period)
        heard: Array | float = 0.0
        if apart:
            read = obs.distance - memory.reckoning.distance
            cloud, heard = weigh_odometer(cloud, distance, read, turn, motion)
        if known is not None and "fault_wet_loss" in known:
            motion = dataclasses.replace(motion, slip_loss=params.faults.wet_loss * known["fault_wet_loss"])
        cloud = move(key, cloud, walls, distance, turn, motion)
        likely, pose = fit(walls, cloud.pose, obs.ranges, range_max, self.scan)
        if self.exact is not None:
            likely = exact_likelihood(walls, pose, obs.ranges, params, self.exact)
        return reweight(dataclasses.replace(cloud, pose=pose), heard + likely, motion), reckoning


def particle_filter(params: EnvParams, n_particles: int | None = None) -> Navigator:
    """Makes the filter with the steering and the mission of the other baselines.

    Args:
        n_particles: Number of particles. `None` is 256; 4,096 where the start may be anywhere, 1,024 where it is
            uncertain, and 512 where rails may be wet.
    """
    if n_particles is None:
        uncertain = float(np.max(np.asarray(params.start.station_sigma))) > 0.0
        n_particles = 1024 if uncertain else 512 if "faults" in params.parts else 256
        if params.goal_kind == "report":
            n_particles = 4096
    localiser = ParticleLocaliser.of(params, n_particles)
    return Navigator(localiser, steering_of(params, CentreLine()), name="particle-filter", uses_map=True)
