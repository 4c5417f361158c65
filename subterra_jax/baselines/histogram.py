"""A histogram filter on the map of a tunnel: every place is a cell, and each cell casts the whole scan in the walls.

Cells lie on a tape of starts. A robot that began at position u of the tape and has driven a way of W is at u + W, or at
u - W where it faces falling stations, so that driving moves no mass. A second axis holds the relative error of dead
reckoning, which lasts: mass of a row slides by that fraction of a step. So sixty metres of faint relief count together,
where a filter that forgets its scale must find it anew.

Source: Burgard et al. 1996, Estimating the absolute position of a mobile robot using position probability grids.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.baselines.agent import Known, Observed, range_sigma
from subterra_jax.baselines.cloud import CloudParams, cloud_params
from subterra_jax.baselines.exactscan import ExactParams, exact_likelihood
from subterra_jax.baselines.navigator import Navigator
from subterra_jax.baselines.reckoning import Reckoning, begin_reckoning, odometer_fraction, reckon, unobserved_distance
from subterra_jax.baselines.scanmodel import ScanModel, TunnelPose, fit, fit_roughly, move_pose
from subterra_jax.baselines.stations import Driven, Localiser, Station, reported_start
from subterra_jax.baselines.steering import CentreLine, steering_of
from subterra_jax.baselines.wallmap import WallMap, wall_map
from subterra_jax.state import EnvParams

NAME = "histogram-filter"
CELL = 0.05  # m
WINDOW = 25.0  # m to either side of a reported start: three standard deviations of dead reckoning over 320 m
N_SCALES, MOST_SCALE = 17, 0.04  # rows of the error of dead reckoning, from minus to plus the second
CLUSTER = 0.8  # of the tolerance: half the length of what counts as one place
_FLOOR = -80.0  # log of the least mass of a cell: what was ruled out once may come back
_OUTSIDE = -30.0  # log likelihood of a scan beyond a mouth
_LEAST_SIGMA = 0.01  # m


def summarise(
    mass: Float[Array, "ways n"], station: Float[Array, "ways n"], reach: Float[Array, ""], cell: float
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Finds the heaviest cluster of a belief.

    Args:
        mass: The belief, which sums to 1; the first row faces growing stations, a second one falling stations.
        station: Stations of the cells, of a length `cell`, m.
        reach: Half the length of a cluster, m.

    Returns:
        Its mean station (m), the standard deviation of the whole belief about it (m), whatever the direction, and 1
        where it faces growing stations, else -1.
    """
    near = _mass_within(mass, jnp.maximum(jnp.round(reach / cell), 1.0).astype(jnp.int32))
    # All cells about a narrow peak have it within reach; the small term picks the peak itself.
    best = jnp.argmax(near + 0.01 * mass)
    way, at = best // mass.shape[1], best % mass.shape[1]
    inside = jnp.abs(station - station[way, at]) <= reach + 0.5 * cell
    cluster = mass * inside * (jnp.arange(mass.shape[0])[:, None] == way)
    fraction = jnp.maximum(jnp.sum(cluster), 1e-12)
    middle = jnp.sum(cluster * station) / fraction
    sigma = jnp.sqrt(jnp.sum(mass * (station - middle) ** 2))
    return middle, sigma, 1.0 - 2.0 * way


def _mass_within(mass: Float[Array, "ways n"], reach: Array) -> Float[Array, "ways n"]:
    n = mass.shape[1]
    total = jnp.concatenate([jnp.zeros((mass.shape[0], 1)), jnp.cumsum(mass, axis=1)], axis=1)
    index = jnp.arange(n)
    return total[:, jnp.minimum(index + reach + 1, n)] - total[:, jnp.maximum(index - reach, 0)]


@struct.dataclass
class HistogramMemory:
    """Memory of the filter."""

    # log of the belief; by direction, error of dead reckoning and cell of the tape
    log_mass: Float[Array, "ways n_scales n"]
    lateral: Float[Array, "ways n"]  # offset to the left of the centreline at each cell, m
    heading: Float[Array, "ways n"]  # heading against the tangent of growing station at each cell, rad
    origin: Float[Array, ""]  # station of the tape's beginning, m
    way: Float[Array, ""]  # dead-reckoned way along the axis, m; less where the robot has turned back
    reckoning: Reckoning  # dead reckoning


@struct.dataclass
class HistogramLocaliser(Localiser):
    """Estimates the station from dead reckoning and scans, by a belief over cells."""

    walls: WallMap  # the map, for offset and heading of each cell
    noise: CloudParams  # errors of dead reckoning
    scan: ScanModel  # errors of the LiDAR, for offset and heading
    odometer_fraction: float  # weight of the odometer against the command
    exact: ExactParams  # settings of the likelihood
    n_cells: int = struct.field(pytree_node=False, default=0)  # cells of the tape
    cell: float = struct.field(pytree_node=False, default=CELL)  # length of a cell, m

    @classmethod
    def of(cls, params: EnvParams, exact: ExactParams | None = None, cell: float = CELL) -> "HistogramLocaliser":
        """Makes a localiser for the map of a task, which may be a stack, and for its nominal errors; on the host."""
        span = float(np.max(np.asarray(params.tunnel.length))) if params.goal_kind == "report" else 2.0 * WINDOW
        return cls(
            walls=wall_map(params.tunnel),
            noise=cloud_params(params),
            scan=ScanModel(range_sigma=range_sigma(params)),
            odometer_fraction=odometer_fraction(params),
            exact=exact or ExactParams(),
            n_cells=int(np.ceil(span / cell)),
            cell=cell,
        )

    def begin(self, obs: Observed, params: EnvParams) -> HistogramMemory:
        """Returns a belief about the start, as wide as it is uncertain; or an even one, facing either way."""
        if params.goal_kind == "report":
            origin, margin = jnp.zeros(()), jnp.asarray(params.goal.margin)
            tape = self._tape(origin)
            inside = (tape >= margin) & (tape <= params.tunnel.length - margin)
            log_mass = jnp.tile(jnp.where(inside, 0.0, _FLOOR), (2, 1))
        else:
            start = reported_start(obs, params)
            origin = start - 0.5 * self.n_cells * self.cell
            sigma = jnp.maximum(jnp.asarray(params.start.station_sigma, jnp.float32), 0.5 * self.cell)
            log_mass = -0.5 * ((self._tape(origin) - start) / sigma)[None] ** 2
        return self._memory(log_mass, origin, obs, params)

    def update(
        self, memory: HistogramMemory, obs: Observed, driven: Driven, params: EnvParams, known: Known
    ) -> tuple[Station, HistogramMemory]:
        walls, period = self.walls.pick(params.tunnel), jnp.asarray(params.vehicle.period)
        range_max = jnp.asarray(params.lidar.range_max)
        distance, turn, reckoning = reckon(memory.reckoning, obs, driven.speed, self.odometer_fraction, period)
        along = distance * self._cosine(memory)
        mass = self._slide(jnp.exp(memory.log_mass), along)
        way = memory.way + along
        now = dataclasses.replace(memory, way=way, reckoning=reckoning)
        before = self._poses(memory)
        pose = move_pose(before, distance, turn, walls.curvature(before.station)[2])
        _, pose = fit(walls, dataclasses.replace(pose, station=self._stations(now)), obs.ranges, range_max, self.scan)
        log_mass = jnp.log(mass) + self._score(walls, pose, obs, params)[:, None, :]
        log_mass = _normalised(log_mass)
        now = dataclasses.replace(now, log_mass=log_mass, lateral=pose.lateral, heading=pose.heading)
        return self._estimate(now, reckoning, params), now

    def _tape(self, origin: Float[Array, ""]) -> Float[Array, " n"]:
        """Stations of the cells before any driving, m."""
        return origin + self.cell * (jnp.arange(self.n_cells) + 0.5)

    def _stations(self, memory: HistogramMemory) -> Float[Array, "ways n"]:
        """Stations of the cells now, m."""
        sign = jnp.asarray((1.0, -1.0))[: memory.log_mass.shape[0], None]
        return self._tape(memory.origin) + sign * memory.way

    def _poses(self, memory: HistogramMemory) -> TunnelPose:
        return TunnelPose(self._stations(memory), memory.lateral, memory.heading)

    def _memory(
        self, log_mass: Float[Array, "ways n"], origin: Float[Array, ""], obs: Observed, params: EnvParams
    ) -> HistogramMemory:
        """Returns the memory of a belief over cells: each row of errors has its fraction of the mass."""
        sigma = jnp.hypot(self.noise.scale_sigma, self.noise.wander.sigma)
        rows = -0.5 * (jnp.asarray(_scales()) / jnp.maximum(sigma, 1e-6)) ** 2
        ways = log_mass.shape[0]
        heading = jnp.broadcast_to(jnp.asarray((0.0, np.pi), jnp.float32)[:ways, None], log_mass.shape)
        zero = jnp.zeros(())
        memory = HistogramMemory(
            log_mass=_normalised(log_mass[:, None, :] + rows[:, None]),
            lateral=jnp.zeros_like(heading),
            heading=heading,
            origin=origin,
            way=zero,
            reckoning=begin_reckoning(obs),
        )
        walls, range_max = self.walls.pick(params.tunnel), jnp.asarray(params.lidar.range_max)
        pose = fit_roughly(walls, self._poses(memory), obs.ranges, range_max, self.scan)
        return dataclasses.replace(memory, lateral=pose.lateral, heading=pose.heading)

    def _cosine(self, memory: HistogramMemory) -> Float[Array, ""]:
        """Cosine of the angle between the robot and its first direction, by the heaviest cell; -1 after a turn."""
        cell = jnp.sum(jnp.exp(memory.log_mass), axis=1)
        best = jnp.argmax(cell)
        turned = memory.heading.reshape(-1)[best] - jnp.pi * (best // cell.shape[1])
        return jnp.cos(turned)

    def _slide(self, mass: Float[Array, "ways n_scales n"], along: Float[Array, ""]) -> Float[Array, "ways n_scales n"]:
        """Slides each row of errors by its fraction of a step, and spreads what the step adds to errors and way."""
        noise, size = self.noise, jnp.abs(along)
        change = 2.0 * noise.wander.sigma**2 / noise.wander.length * size / (_scales()[1] - _scales()[0]) ** 2
        mass = _diffused(mass, jnp.minimum(change, 0.5), axis=1)
        sign = jnp.asarray((1.0, -1.0))[: mass.shape[0], None, None]
        shift = sign * jnp.asarray(_scales())[:, None] * along / self.cell
        before, after = jnp.maximum(shift, 0.0), jnp.maximum(-shift, 0.0)
        low, high = _neighbours(mass)
        mass = (1.0 - before - after) * mass + before * low + after * high
        fraction = jnp.where(size > 0.0, jnp.minimum((noise.step_sigma / self.cell) ** 2, 0.5), 0.0)
        return jnp.maximum(_diffused(mass, fraction), np.float32(np.exp(_FLOOR)))

    def _score(self, walls: WallMap, pose: TunnelPose, obs: Observed, params: EnvParams) -> Float[Array, "ways n"]:
        """Computes the log likelihood of a scan in every cell."""
        flat = jax.tree.map(jnp.ravel, pose)
        gain = exact_likelihood(walls, flat, obs.ranges, params, self.exact).reshape(pose.station.shape)
        return jnp.where((pose.station > 0.0) & (pose.station < params.tunnel.length), gain, gain.max() + _OUTSIDE)

    def _estimate(self, memory: HistogramMemory, reckoning: Reckoning, params: EnvParams) -> Station:
        """Returns the middle of the heaviest cluster, with what is driven and not yet observed."""
        mass = jnp.sum(jnp.exp(memory.log_mass), axis=1)
        reach = CLUSTER * jnp.asarray(params.goal.tolerance)
        station, sigma, facing = summarise(mass, self._stations(memory), reach, self.cell)
        direction = facing * jnp.where(self._cosine(memory) > 0.0, 1.0, -1.0)
        station = station + direction * unobserved_distance(reckoning, jnp.asarray(params.vehicle.period))
        return Station(station, jnp.log(jnp.maximum(sigma, _LEAST_SIGMA)), direction)


def _diffused(
    mass: Float[Array, "*cells"], variance: Float[Array, "*#cells"], axis: int = -1
) -> Float[Array, "*cells"]:
    """Spread mass over neighbouring cells by a variance, in squares of a cell, up to 1; none is lost at the ends."""
    low, high = _neighbours(mass, axis)
    return mass + 0.5 * variance * (low + high - 2.0 * mass)


def _neighbours(mass: Float[Array, "*cells"], axis: int = -1) -> tuple[Float[Array, "*cells"], Float[Array, "*cells"]]:
    """Return the mass of the cell before each cell, and of the one behind it; beyond the ends as much as in them."""
    axis %= mass.ndim
    wide = jnp.pad(mass, [(1, 1) if i == axis else (0, 0) for i in range(mass.ndim)], mode="edge")
    before, behind = (jax.lax.slice_in_dim(wide, first, first + mass.shape[axis], axis=axis) for first in (0, 2))
    return before, behind


def _normalised(log_mass: Float[Array, "*cells"]) -> Float[Array, "*cells"]:
    """Scale a belief to a sum of 1, given and returned as logs; no cell falls below `_FLOOR`."""
    return jnp.maximum(log_mass - jax.scipy.special.logsumexp(log_mass), _FLOOR)


def _scales() -> np.ndarray:
    """Relative errors of the rows, 1."""
    return np.linspace(-MOST_SCALE, MOST_SCALE, N_SCALES, dtype=np.float32)


def histogram_filter(params: EnvParams, exact: ExactParams | None = None) -> Navigator:
    """Makes the filter with the steering and the mission of the other baselines."""
    return Navigator(HistogramLocaliser.of(params, exact), steering_of(params, CentreLine()), name=NAME, uses_map=True)
