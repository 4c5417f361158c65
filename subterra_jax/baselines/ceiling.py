"""The ceiling: a Bayes filter that has the exact map, the sizes of all noise, and those of the episode's faults.

A particle filter whose every particle casts the whole scan in the true walls; where the start may be anywhere, a
histogram filter that does so in every cell. It is no agent that anybody could send in: nobody is told how late the data
or how slippery the rail of an episode is. Nothing else of the truth is read.
"""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jaxtyping import PRNGKeyArray

from subterra_jax.baselines.agent import Known, Observed, range_sigma
from subterra_jax.baselines.avoidance import steering_of
from subterra_jax.baselines.cloud import Cloud, commanded_cloud, log_weights, move, weigh_odometer
from subterra_jax.baselines.exactscan import ExactParams, exact_likelihood
from subterra_jax.baselines.histogram import HistogramLocaliser
from subterra_jax.baselines.navigator import Navigator
from subterra_jax.baselines.particle import FilterMemory, ParticleLocaliser, Relocaliser
from subterra_jax.baselines.reckoning import Reckoning, reckon
from subterra_jax.baselines.scanmodel import ScanModel, fit
from subterra_jax.baselines.stations import Driven
from subterra_jax.baselines.steering import CentreLine
from subterra_jax.parts.faults import MAX_DELAY, N_SEVERITIES
from subterra_jax.state import EnvParams

NAME = "ceiling"
_DENSE_LEAST, _DENSE_DUE = (
    0.02,
    0.3,
)  # of a dense cloud: the least share that a scan may leave, and below which it is resampled


@struct.dataclass
class ExactLocaliser(ParticleLocaliser):
    """Estimates the station by particles that cast their scans in the exact map, and knows the faults' sizes.

    Attributes:
        exact: Settings of the likelihood.
    """

    privileged = True
    exact: ExactParams = struct.field(default_factory=ExactParams)

    def advance(
        self, key: PRNGKeyArray, memory: FilterMemory, obs: Observed, driven: Driven, params: EnvParams, known: Known
    ) -> tuple[Cloud, Reckoning]:
        """Moves the particles with the episode's own sizes of faults, and weighs them by odometer and scan."""
        walls, period = self.walls.pick(params.tunnel), jnp.asarray(params.vehicle.period)
        before = with_known_delay(memory.reckoning, params, known)
        # The odometer's noise of each step would otherwise be noise of the motion: it is weighed apart.
        motion, apart = self.motion, self.motion.odometer is not None
        distance, turn, reckoning = reckon(before, obs, driven.speed, 0.0 if apart else self.odometer_share, period)
        read = obs.distance - memory.reckoning.distance
        learnt, heard = weigh_odometer(memory.cloud, distance, read, turn, motion) if apart else (memory.cloud, 0.0)
        if known is not None and "fault_wet_loss" in known:
            motion = dataclasses.replace(motion, slip_loss=params.faults.wet_loss * known["fault_wet_loss"])
        cloud = move(key, learnt, walls, distance, turn, motion)
        _, pose = fit(walls, cloud.pose, obs.ranges, jnp.asarray(params.lidar.range_max), self.scan)
        cloud = dataclasses.replace(cloud, pose=pose)
        gain = heard + exact_likelihood(walls, pose, obs.ranges, params, self.exact)
        return log_weights(cloud, gain, motion), reckoning


def with_known_delay(before: Reckoning, params: EnvParams, known: Known) -> Reckoning:
    """Return the dead reckoning with the delay that the episode has, where faults are drawn."""
    if known is None or "fault_delay" not in known:
        return before
    share = known["severity"] / (N_SEVERITIES - 1)
    delay = jnp.clip(jnp.round(params.faults.delay * known["fault_delay"] * share), 0, MAX_DELAY).astype(jnp.int32)
    return dataclasses.replace(before, delay=delay, waiting=jnp.zeros_like(before.waiting))


def ceiling(params: EnvParams, n_particles: int | None = None) -> Navigator | Relocaliser:
    """Makes the ceiling of a task: particles about a start, and a histogram over all places where there is none.

    Args:
        params: The task.
        n_particles: Number of particles; None is `n_particles_of` the task.
    """
    if params.errand == "report":
        # It drives as far as it may: a place that seems sure early may be one of many that look alike.
        everywhere = HistogramLocaliser.of(params)
        return Relocaliser(everywhere, CentreLine(), sure_for=float("inf"), name=NAME, privileged=True)
    made = ParticleLocaliser.of(params, n_particles or n_particles_of(params))
    motion = commanded_cloud(params)
    if not is_hidden(params) or "faults" in params.parts:
        motion = dataclasses.replace(motion, least_share=_DENSE_LEAST, ess_share=_DENSE_DUE)
    fields = {field.name: getattr(made, field.name) for field in dataclasses.fields(made) if field.name != "privileged"}
    fields |= {"scan": ScanModel(range_sigma=range_sigma(params)), "motion": motion}
    return Navigator(ExactLocaliser(**fields), steering_of(params, CentreLine()), name=NAME, uses_map=True)


def is_hidden(params: EnvParams) -> bool:
    """Tells whether the start that a robot is told is off: then its rings may fit those of other places as well.

    There a likelihood taken whole settles on one ring by chance: with universal rings it was lost in a quarter of the
    episodes, where one that spares its particles is lost in one of sixteen. With a start told exactly, one that is
    flattened to spare them would throw away what the walls tell.
    """
    return float(params.start.station_sigma.max()) > 0.0


def n_particles_of(params: EnvParams) -> int:
    """Returns the particles of a task: 512, twice that on wet rail, and twice that with a hidden start."""
    return 512 * (2 if "faults" in params.parts else 1) * (2 if is_hidden(params) else 1)
