"""A particle filter on the map of a tunnel: as a localiser, and to find an unknown start.

The filter finds the station by the pockets, width and curvature of the mapped walls.
"""

from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from subterra_jax.baselines.agent import Action, Agent, Known, Observed, range_sigma
from subterra_jax.baselines.avoidance import steering_of
from subterra_jax.baselines.cloud import Cloud, CloudParams, cloud_params, move, new_cloud, resample, summarise, weigh
from subterra_jax.baselines.navigator import Navigator
from subterra_jax.baselines.reckoning import Reckoning, begin_reckoning, odometer_share, reckon, unobserved_distance
from subterra_jax.baselines.scanmodel import ScanModel, TunnelPose, fit_roughly
from subterra_jax.baselines.stations import Driven, Localiser, Station, told_start
from subterra_jax.baselines.steering import CentreLine
from subterra_jax.baselines.wallmap import WallMap, wall_map
from subterra_jax.state import EnvParams

_LEAST_SIGMA = 0.01  # m
_MOUTH_BEAMS = (1, -1)  # the slanting beams ahead: without an echo on either side a mouth is some metres away


@struct.dataclass
class FilterMemory:
    """Memory of the filter.

    Attributes:
        cloud: The particles.
        reckoning: Dead reckoning.
        step: Cycles so far.
    """

    cloud: Cloud
    reckoning: Reckoning
    step: Int[Array, ""]


@struct.dataclass
class ParticleLocaliser(Localiser):
    """Estimates the station from dead reckoning and scans, by particles.

    Its random numbers depend on `seed` and the step alone, so equal observations give equal estimates.

    Attributes:
        walls: The map.
        motion: Motion of the cloud.
        scan: Assumed errors of the LiDAR.
        odometer_share: Weight of the odometer against the command.
        seed: Seed of its random numbers.
        n_particles: Number of particles.
    """

    walls: WallMap
    motion: CloudParams
    scan: ScanModel
    odometer_share: float | Float[Array, ""]
    seed: int = 0
    n_particles: int = struct.field(pytree_node=False, default=256)

    @classmethod
    def of(cls, params: EnvParams, n_particles: int = 256) -> "ParticleLocaliser":
        """Makes a localiser for the map of a task, whose tunnel may be a stack, and for its nominal errors."""
        return cls(
            walls=wall_map(params.tunnel),
            motion=cloud_params(params),
            scan=ScanModel(range_sigma=range_sigma(params)),
            odometer_share=odometer_share(params),
            n_particles=n_particles,
        )

    def begin(self, obs: Observed, params: EnvParams) -> FilterMemory:
        """Spreads particles about the believed start as far as it is uncertain."""
        station_key, cloud_key = jax.random.split(jax.random.key(self.seed))
        walls = self.walls.pick(params.tunnel)
        spread = jnp.clip(jax.random.normal(station_key, (self.n_particles,)), -3.0, 3.0)
        station = jnp.maximum(told_start(obs, params) + params.start.station_sigma * spread, 0.0)
        pose = TunnelPose(station, jnp.zeros_like(station), jnp.zeros_like(station))
        pose = fit_roughly(walls, pose, obs.ranges, jnp.asarray(params.lidar.range_max), self.scan)
        return FilterMemory(new_cloud(cloud_key, pose, self.motion), begin_reckoning(obs), jnp.zeros((), jnp.int32))

    def begin_anywhere(self, obs: Observed, params: EnvParams) -> FilterMemory:
        """Spreads particles evenly along the tunnel, facing either way by turns."""
        n, margin = self.n_particles, params.goal.margin
        share = (jnp.arange(n) + 0.5) / n
        heading = jnp.where(jnp.arange(n) % 2 == 0, 0.0, jnp.pi)
        pose = TunnelPose(margin + (params.tunnel.length - 2.0 * margin) * share, jnp.zeros(n), heading)
        walls = self.walls.pick(params.tunnel)
        pose = fit_roughly(walls, pose, obs.ranges, jnp.asarray(params.lidar.range_max), self.scan)
        cloud = new_cloud(jax.random.key(self.seed), pose, self.motion)
        return FilterMemory(cloud, begin_reckoning(obs), jnp.zeros((), jnp.int32))

    def update(
        self, memory: FilterMemory, obs: Observed, driven: Driven, params: EnvParams, known: Known
    ) -> tuple[Station, FilterMemory]:
        """Advances by dead reckoning and a scan, and resamples where few particles are left."""
        move_key, draw_key = jax.random.split(jax.random.fold_in(jax.random.key(self.seed), 1 + memory.step))
        cloud, reckoning = self.advance(move_key, memory, obs, driven, params, known)
        summary = summarise(cloud, self.motion)
        unobserved = unobserved_distance(reckoning, jnp.asarray(params.vehicle.period))
        station = summary.station + unobserved * jnp.cos(summary.heading)
        direction = jnp.where(jnp.cos(summary.heading) > 0.0, 1.0, -1.0)
        estimate = Station(station, jnp.log(jnp.maximum(summary.sigma, _LEAST_SIGMA)), direction)
        return estimate, FilterMemory(resample(draw_key, cloud, self.motion), reckoning, memory.step + 1)

    def advance(
        self, key: PRNGKeyArray, memory: FilterMemory, obs: Observed, driven: Driven, params: EnvParams, known: Known
    ) -> tuple[Cloud, Reckoning]:
        """Moves the particles by dead reckoning and weighs them by a scan; returns them and the dead reckoning."""
        del known
        walls, period = self.walls.pick(params.tunnel), jnp.asarray(params.vehicle.period)
        distance, turn, reckoning = reckon(memory.reckoning, obs, driven.speed, self.odometer_share, period)
        cloud = move(key, memory.cloud, walls, distance, turn, self.motion)
        range_max = jnp.asarray(params.lidar.range_max)
        return weigh(cloud, walls, obs.ranges, range_max, self.scan, self.motion), reckoning


def particle_filter(params: EnvParams, n_particles: int | None = None) -> Navigator:
    """Makes the filter with the steering and the mission of the other baselines.

    Args:
        params: The task.
        n_particles: Number of particles. `None` is 256, four times as many where the start is uncertain, or twice as
            many where rails may be wet.
    """
    if n_particles is None:
        uncertain = float(np.max(np.asarray(params.start.station_sigma))) > 0.0
        n_particles = 1024 if uncertain else 512 if "faults" in params.parts else 256
    localiser = ParticleLocaliser.of(params, n_particles)
    return Navigator(localiser, steering_of(params, CentreLine()), name="particle-filter", uses_map=True)


class AnywhereLocaliser(Localiser, Protocol):
    """A localiser that can begin without a start."""

    def begin_anywhere(self, obs: Observed, params: EnvParams) -> Any:
        """Returns the memory of a start that may be any place, in either direction."""


@struct.dataclass
class RelocaliserMemory:
    """Memory of the relocaliser.

    Attributes:
        filtered: Memory of the filter.
        steering: Memory of the steering.
        command: Last command, m/s and rad/s.
        travelled: Distance driven, dead-reckoned, m.
        sure: Distance over which the estimate has been sure, m.
        stopped: Whether the robot has stopped to report.
    """

    filtered: Any
    steering: Any
    command: Float[Array, "2"]
    travelled: Float[Array, ""]
    sure: Float[Array, ""]
    stopped: Bool[Array, ""]


@struct.dataclass
class Relocaliser(Agent):
    """Finds an unknown start: drives along the axis until the estimate has been sure for a while, then reports.

    Attributes:
        filter: The filter.
        steering: The steering between the walls.
        sure_for: Distance over which the estimate must be sure, m.
        furthest: Share of the allowed distance after which to stop in any case; the rest covers the error of dead
            reckoning.
    """

    uses_lidar = uses_map = True
    filter: AnywhereLocaliser
    steering: CentreLine
    sure_for: float = 30.0
    furthest: float = 0.9
    name: str = struct.field(pytree_node=False, default="particle-filter")
    privileged: bool = struct.field(pytree_node=False, default=False)

    @classmethod
    def of(cls, params: EnvParams, n_particles: int = 4096) -> "Relocaliser":
        """Makes a relocaliser for the map and the nominal errors of a task."""
        return cls(ParticleLocaliser.of(params, n_particles), CentreLine())

    def begin(self, key: PRNGKeyArray, obs: Observed, params: EnvParams) -> RelocaliserMemory:
        """Begins with a filter that believes in every place alike, facing either way."""
        del key
        zero = jnp.zeros(())
        return RelocaliserMemory(
            filtered=self.filter.begin_anywhere(obs, params),
            steering=self.steering.begin(obs, params),
            command=jnp.zeros(2),
            travelled=zero,
            sure=zero,
            stopped=jnp.zeros((), bool),
        )

    def act(
        self, key: PRNGKeyArray, memory: RelocaliserMemory, obs: Observed, params: EnvParams, known: Known
    ) -> tuple[Action, RelocaliserMemory]:
        """Acts for one control period."""
        del key
        steering = self.steering.look(memory.steering, obs, memory.command, params)
        one, no = jnp.ones(()), jnp.zeros((), bool)
        driven = Driven(memory.command[0], one, one, no)
        estimate, filtered = self.filter.update(memory.filtered, obs, driven, params, known)
        moved = memory.command[0] * params.vehicle.period
        travelled = memory.travelled + moved
        is_sure = jnp.exp(estimate.log_sigma) < self.sure_sigma(params)
        sure = jnp.where(is_sure, memory.sure + moved, 0.0)
        ahead = obs.ranges[jnp.asarray(_MOUTH_BEAMS)]
        mouth = jnp.all(ahead >= params.lidar.range_max)
        allowed = self.furthest * params.goal.travel_max
        stopped = memory.stopped | (sure >= self.sure_for) | (travelled >= allowed) | mouth
        speed = jnp.where(stopped, 0.0, params.vehicle.speed_max)
        command = jnp.where(stopped, 0.0, self.steering.steer(steering, speed, params))
        step = estimate.direction * command[0] * params.vehicle.period
        report = jnp.stack([estimate.station + step, estimate.log_sigma, estimate.direction])
        after = RelocaliserMemory(filtered, steering, command, travelled, sure, stopped)
        return jnp.concatenate([command, report]), after

    def sure_sigma(self, params: EnvParams) -> Float[Array, ""]:
        """Return the standard deviation up to which the estimate is sure, m: half the task's tolerance."""
        return jnp.asarray(0.5 * params.goal.tolerance)


def particle_agent(params: EnvParams) -> Navigator | Relocaliser:
    """Makes the agent of a task: a relocaliser where the start is unknown, else the filter with the usual mission."""
    return Relocaliser.of(params) if params.errand == "report" else particle_filter(params)
