"""Relocalisation by a filter: particles everywhere facing both ways, a drive for evidence, then a stop and a report."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax.baselines.agent import Action, Known, Observed
from subterra_jax.baselines.particle.cloud import new_cloud
from subterra_jax.baselines.particle.likelihood import first_look
from subterra_jax.baselines.particle.localiser import Memory as Filtered
from subterra_jax.baselines.particle.localiser import ParticleLocaliser
from subterra_jax.baselines.particle.motion import first_reckoning
from subterra_jax.baselines.particle.scan import Place
from subterra_jax.baselines.stations import Driven
from subterra_jax.baselines.steering import CentreLine
from subterra_jax.state import EnvParams

_MOUTH_BEAMS = (1, -1)  # the slanting beams ahead: without an echo on either side a mouth is some metres away


@struct.dataclass
class Memory:
    """What it remembers.

    Attributes:
        filtered: Memory of the filter.
        steering: Memory of the steering.
        command: Last command, m/s and rad/s.
        travelled: Distance driven, dead-reckoned, m.
        sure: Distance over which it has been sure, m.
        stopped: It has stopped to report.
    """

    filtered: Filtered
    steering: Any
    command: Float[Array, "2"]
    travelled: Float[Array, ""]
    sure: Float[Array, ""]
    stopped: Bool[Array, ""]


@struct.dataclass
class Relocaliser:
    """Drives along the axis until it has been sure of one place for a while, or may go no further.

    Attributes:
        filter: The filter.
        steering: Keeps between the walls.
        sure_for: Distance over which to be sure, m.
        furthest: Share of the distance that the task allows after which to stop in any case; the rest is for the error
            of dead reckoning.
    """

    filter: ParticleLocaliser
    steering: CentreLine
    sure_for: float = 30.0
    furthest: float = 0.9
    name: str = struct.field(pytree_node=False, default="relocalisation-filter")
    uses_lidar: bool = struct.field(pytree_node=False, default=True)
    uses_map: bool = struct.field(pytree_node=False, default=True)
    privileged: bool = struct.field(pytree_node=False, default=False)

    @classmethod
    def of(cls, params: EnvParams, n_particles: int = 4096) -> "Relocaliser":
        """For a task: its map and its nominal errors."""
        return cls(ParticleLocaliser.of(params, n_particles), CentreLine())

    def begin(self, key: PRNGKeyArray, obs: Observed, params: EnvParams) -> Memory:
        """Particles evenly along the tunnel, alternately facing either way."""
        del key
        n, margin = self.filter.n_particles, params.goal.margin
        share = (jnp.arange(n) + 0.5) / n
        heading = jnp.where(jnp.arange(n) % 2 == 0, 0.0, jnp.pi)
        place = Place(margin + (params.tunnel.length - 2.0 * margin) * share, jnp.zeros(n), heading)
        walls, motion = self.filter.walls.pick(params.tunnel), self.filter.motion
        place = first_look(walls, place, obs.ranges, jnp.asarray(params.lidar.range_max), self.filter.scan)
        cloud = new_cloud(jax.random.key(self.filter.seed), place, motion)
        zero = jnp.zeros(())
        return Memory(
            filtered=Filtered(cloud, first_reckoning(obs), jnp.zeros((), jnp.int32)),
            steering=self.steering.begin(obs, params),
            command=jnp.zeros(2),
            travelled=zero,
            sure=zero,
            stopped=jnp.zeros((), bool),
        )

    def act(
        self, key: PRNGKeyArray, memory: Memory, obs: Observed, params: EnvParams, known: Known
    ) -> tuple[Action, Memory]:
        """One control period."""
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
        after = Memory(filtered, steering, command, travelled, sure, stopped)
        return jnp.concatenate([command, report]), after

    def sure_sigma(self, params: EnvParams) -> Float[Array, ""]:
        """Standard deviation up to which it calls itself sure, m: half the task's tolerance."""
        return jnp.asarray(0.5 * params.goal.tolerance)
