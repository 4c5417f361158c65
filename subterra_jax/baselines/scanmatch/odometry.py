"""LiDAR odometry without a map: dead reckoning, its scale corrected by matched scans wherever the walls allow it."""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.baselines.agent import Known, Observed
from subterra_jax.baselines.avoidance import steering_of
from subterra_jax.baselines.corridor import first_look
from subterra_jax.baselines.navigator import Navigator
from subterra_jax.baselines.particle.cloud import CloudParams
from subterra_jax.baselines.particle.motion import (
    Reckoning,
    cloud_params,
    first_reckoning,
    odometer_share,
    reckoned,
    unseen,
)
from subterra_jax.baselines.scanmatch.localiser import N_SHIFTS, Match, best, mismatch
from subterra_jax.baselines.scanmatch.profile import MatchParams, Pose, Profile, centred, empty_profile, remembered
from subterra_jax.baselines.stations import Driven, Station
from subterra_jax.baselines.steering import CentreLine
from subterra_jax.state import EnvParams

_LEAST_SIGMA = 0.01  # m


@struct.dataclass
class Memory:
    """What it remembers.

    Attributes:
        profile: The walls seen lately.
        pose: Where it takes itself to be.
        scale: Relative error of dead reckoning, 1.
        covariance: Of the station against the profile (m²), of both (m), of the scale (1).
        sigma: Standard deviation of the station against the start, m.
        cost: Mismatch of the scans since the last correction at each shift.
        travelled: Distance since then, m.
        reckoning: Dead reckoning.
    """

    profile: Profile
    pose: Pose
    scale: Float[Array, ""]
    covariance: Float[Array, "3"]
    sigma: Float[Array, ""]
    cost: Float[Array, "n_shifts"]
    travelled: Float[Array, ""]
    reckoning: Reckoning


@struct.dataclass
class ScanMatcher:
    """Dead reckoning and scan matching in a Kalman filter of station and scale.

    Attributes:
        motion: Errors of dead reckoning.
        params: How scans are matched.
        odometer_share: Weight of the odometer against the command.
        window: Distance over which mismatch is gathered before a correction, m.
    """

    motion: CloudParams
    params: MatchParams
    odometer_share: float | Float[Array, ""]
    window: float = 5.0
    privileged: bool = struct.field(pytree_node=False, default=False)

    @classmethod
    def of(cls, params: EnvParams) -> "ScanMatcher":
        """For the nominal errors of a task."""
        return cls(cloud_params(params), MatchParams(float(params.lidar.range_sigma)), odometer_share(params))

    def begin(self, obs: Observed, params: EnvParams) -> Memory:
        """At the believed start, the axis taken to be straight as yet."""
        zero, corridor = jnp.zeros(()), first_look(obs.ranges, params)
        half_width = 0.5 * (corridor.left + corridor.right)
        pose = Pose(jnp.asarray(params.start.station, jnp.float32), corridor.offset, corridor.angle, zero, half_width)
        lasting = self.motion.scale_sigma**2 + self.motion.wander.sigma**2
        return Memory(
            profile=empty_profile(),
            pose=pose,
            scale=zero,
            covariance=jnp.stack([zero, zero, zero + lasting]),
            sigma=jnp.asarray(params.start.station_sigma, jnp.float32),
            cost=jnp.zeros(N_SHIFTS),
            travelled=zero,
            reckoning=first_reckoning(obs),
        )

    def update(
        self, memory: Memory, obs: Observed, driven: Driven, params: EnvParams, known: Known
    ) -> tuple[Station, Memory]:
        """Dead reckoning, a match if it says anything, and the scan remembered."""
        del known
        period = jnp.asarray(params.vehicle.period)
        distance, turn, reckoning = reckoned(memory.reckoning, obs, driven.speed, self.odometer_share, period)
        pose = _moved(memory.pose, distance * (1.0 + memory.scale), turn)
        covariance = _spread(memory.covariance, distance, self.motion)
        pose = centred(pose, obs.ranges, self.params)
        cost = memory.cost + mismatch(memory.profile, pose, obs.ranges, self.params)
        travelled = memory.travelled + jnp.abs(distance)
        due = travelled >= self.window
        found = best(cost, self.params)
        found = dataclasses.replace(found, informative=found.informative & due)
        pose, scale, covariance = _fused(pose, found, memory.scale, covariance)
        cost, travelled = jnp.where(due, 0.0, cost), jnp.where(due, 0.0, travelled)
        profile = remembered(memory.profile, pose, obs.ranges, self.params)
        # Against the start nothing is ever corrected: what the scale is wrong by adds up.
        sigma = memory.sigma + jnp.abs(distance) * jnp.sqrt(covariance[2])
        forward = jnp.cos(pose.heading)
        estimate = Station(
            pose.station + unseen(reckoning, period) * forward,
            jnp.log(jnp.maximum(sigma, _LEAST_SIGMA)),
            jnp.where(forward > 0.0, 1.0, -1.0),
        )
        return estimate, Memory(profile, pose, scale, covariance, sigma, cost, travelled, reckoning)


def scan_matching(params: EnvParams) -> Navigator:
    """The matcher with the steering and the mission of the other baselines."""
    return Navigator(ScanMatcher.of(params), steering_of(params, CentreLine()), name="scan-matching")


def _moved(pose: Pose, distance: Float[Array, ""], turn: Float[Array, ""]) -> Pose:
    """After a distance (m) and a turn (rad; NaN is that of the axis)."""
    turn = jnp.where(jnp.isnan(turn), pose.bend * distance, turn)
    middle = pose.heading + 0.5 * turn
    along = distance * jnp.cos(middle)
    return dataclasses.replace(
        pose,
        station=pose.station + along,
        lateral=pose.lateral + distance * jnp.sin(middle),
        heading=pose.heading + turn - pose.bend * along,
    )


def _spread(covariance: Float[Array, "3"], distance: Float[Array, ""], motion: CloudParams) -> Float[Array, "3"]:
    """The covariance after a distance, m."""
    station, both, scale = covariance
    station = station + distance * (2.0 * both + distance * scale) + motion.step_sigma**2
    wandered = 2.0 * motion.wander.sigma**2 * jnp.abs(distance) / motion.wander.length
    return jnp.stack([station, both + distance * scale, jnp.minimum(scale + wandered, _prior(motion))])


def _prior(motion: CloudParams) -> Float[Array, ""]:
    return jnp.asarray(motion.scale_sigma**2 + motion.wander.sigma**2)


def _fused(
    pose: Pose, found: Match, scale: Float[Array, ""], covariance: Float[Array, "3"]
) -> tuple[Pose, Float[Array, ""], Float[Array, "3"]]:
    """Pose, scale and covariance after a match; unchanged in station and scale where it says nothing."""
    station, both, of_scale = covariance
    total = station + 1.0 / jnp.maximum(found.information, 1.0)
    use = jnp.where(found.informative, 1.0 / total, 0.0)
    forward = jnp.cos(pose.heading)
    pose = dataclasses.replace(pose, station=pose.station + use * station * found.shift)
    after = jnp.stack([station - use * station * station, both - use * station * both, of_scale - use * both * both])
    # Driving back, too small a scale leaves the station too large.
    return pose, scale + use * both * found.shift * jnp.sign(forward), after
