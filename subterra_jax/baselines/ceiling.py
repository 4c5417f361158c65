"""The ceiling: a Bayes filter that has the exact map, the sizes of all noise, and those of the episode's faults.

A particle filter whose every particle casts the whole scan in the true walls; where the start may be anywhere, a
histogram filter that does so in every cell. It is no agent that anybody could send in: nobody knows how late the data
or how slippery the rail of an episode is. Nothing else of the truth is read.
"""

import dataclasses

import numpy as np

from subterra_jax.baselines.agent import range_sigma
from subterra_jax.baselines.cloud import commanded_cloud
from subterra_jax.baselines.exactscan import ExactParams
from subterra_jax.baselines.histogram import HistogramLocaliser
from subterra_jax.baselines.navigator import Navigator
from subterra_jax.baselines.particle import ParticleLocaliser
from subterra_jax.baselines.scanmodel import ScanModel
from subterra_jax.baselines.stations import Localiser
from subterra_jax.baselines.steering import CentreLine, steering_of
from subterra_jax.state import EnvParams

NAME = "ceiling"
# Of a dense cloud: the least fraction that a scan may leave, and below which it is resampled.
_DENSE_LEAST, _DENSE_DUE = 0.02, 0.3


def ceiling(params: EnvParams, n_particles: int | None = None) -> Navigator:
    """Makes the ceiling of a task: particles about a start, and a histogram over all places where there is none.

    Args:
        n_particles: Number of particles; None is 512, twice that on wet rail, and twice that with a hidden start.
    """
    if params.goal_kind == "report":
        # It drives as far as it may: a place that seems sure early may be one of many that look alike.
        everywhere: Localiser = HistogramLocaliser.of(params)
        return Navigator(everywhere, CentreLine(), name=NAME, uses_map=True, sure_for=float("inf"))
    hidden, faulted = is_hidden(params), "faults" in params.parts
    made = ParticleLocaliser.of(params, n_particles or 512 * (2 if faulted else 1) * (2 if hidden else 1))
    motion = commanded_cloud(params)
    if not hidden or faulted:
        motion = dataclasses.replace(motion, least_fraction=_DENSE_LEAST, ess_fraction=_DENSE_DUE)
    scan = ScanModel(range_sigma=range_sigma(params))
    localiser = dataclasses.replace(made, scan=scan, motion=motion, exact=ExactParams(), privileged=True)
    return Navigator(localiser, steering_of(params, CentreLine()), name=NAME, uses_map=True)


def is_hidden(params: EnvParams) -> bool:
    """Tells whether the start that a robot is given is off: then its rings may fit those of other places as well.

    There a likelihood taken whole settles on one ring by chance: with universal rings it was lost in a quarter of the
    episodes, where one that spares its particles is lost in one of sixteen. With a start reported exactly, one that is
    flattened to spare them would throw away what the walls tell.
    """
    return float(np.max(np.asarray(params.start.station_sigma))) > 0.0
