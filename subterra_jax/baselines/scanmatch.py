"""LiDAR odometry without a map: dead reckoning whose scale is corrected by matched scans where the walls allow it.

The walls seen lately are kept as two profiles, distance from the axis over station, in a ring of bins. New scans are
matched with them at several shifts along the axis. A Kalman filter of station and scale uses informative matches. Of a
LiDAR in three dimensions it uses a whole level ring. Intensities make two further profiles, matched alike.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.baselines.agent import Known, Observed, level_intensity, level_ranges, range_sigma
from subterra_jax.baselines.cloud import CloudParams, cloud_params
from subterra_jax.baselines.navigator import Navigator
from subterra_jax.baselines.reckoning import Reckoning, begin_reckoning, odometer_fraction, reckon, unobserved_distance
from subterra_jax.baselines.scanmodel import TunnelPose, move_pose
from subterra_jax.baselines.stations import Driven, Localiser, Station, reported_start
from subterra_jax.baselines.steering import CentreLine, find_walls, steering_of
from subterra_jax.lidar import bearings
from subterra_jax.state import EnvParams

BIN = 0.08  # m
N_BINS = 256  # 20 m: from the furthest useful beam ahead to the furthest behind
_SHIFTS = np.round(np.arange(-0.4, 0.401, 0.02), 2)  # m
N_SHIFTS = len(_SHIFTS)
_BEND = 5  # shifts to either side over which the curvature of the cost is taken
_LEAST_SIGMA = 0.01  # m


@struct.dataclass
class MatchParams:
    """Settings of scan matching."""

    range_sigma: float | Float[Array, ""] = 0.05  # standard deviation of a range, m
    wall_sigma: float = 0.05  # standard deviation of one entry of the profile, m
    face_sigma: float = 0.12  # standard deviation of the logarithm of one brightness in a bin, 1
    reach: float = 9.0  # longest range used, m
    lateral_sigma: float = 0.01  # standard deviation of the offset after one step of dead reckoning, m
    heading_sigma: float = 0.003  # standard deviation of the heading, rad
    bend_sigma: float = 0.0002  # standard deviation of the curvature of the axis, 1/m
    width_gain: float = 0.05  # fraction of a change of width that one scan contributes, 1
    least_age: float = 1.0  # least distance to the station from which an entry was seen for it to be matched, m
    least_information: float = 5000.0  # curvature of the cost below which a match is not used, 1/m²


@struct.dataclass
class WallProfile:
    """Profiles of the two walls, in a ring of bins."""

    total: Float[Array, "2 n_bins"]  # sum of the distances seen in each bin, m; left wall, right wall
    count: Float[Array, "2 n_bins"]  # number of distances in each bin
    stamp: Int[Array, "2 n_bins"]  # index along the tunnel of each bin
    seen_from: Float[Array, "2 n_bins"]  # station from which it was last seen, m


@struct.dataclass
class AxisPose(TunnelPose):
    """Pose relative to an axis that is not known: what is known of it follows."""

    bend: Float[Array, ""]  # curvature of the axis, 1/m
    half_width: Float[Array, ""]  # usual distance of a wall, m


def empty_profile() -> WallProfile:
    """Return the profile before any scan."""
    zero = jnp.zeros((2, N_BINS))
    return WallProfile(zero, zero, jnp.full((2, N_BINS), -(2**30), jnp.int32), zero)


def scan_points(
    pose: AxisPose, ranges: Float[Array, "n_beams"], params: MatchParams
) -> tuple[Float[Array, "n_beams"], Float[Array, "n_beams"], Float[Array, "n_beams"], Bool[Array, "n_beams"]]:
    """Computes the ends of beams, m: along the axis, to its left, sigma of the latter; and which of them are used."""
    angle = jnp.asarray(bearings(ranges.shape[0]), jnp.float32) + pose.heading
    along, slant = ranges * jnp.cos(angle), jnp.sin(angle)
    lateral = pose.lateral + ranges * slant - 0.5 * pose.bend * along * along
    sigma = jnp.maximum(params.range_sigma * jnp.abs(slant), 0.4 * params.range_sigma)
    return along, lateral, sigma, ranges < params.reach


def add_scan(
    profile: WallProfile,
    pose: AxisPose,
    ranges: Float[Array, "n_beams"],
    params: MatchParams,
    face: Float[Array, "n_beams"] | None = None,
) -> WallProfile:
    """Adds a scan, or its `face`, to the profile; bins that held an earlier part of the tunnel begin anew."""
    along, lateral, _, useful = scan_points(pose, ranges, params)
    index = jnp.floor((pose.station + along) / BIN).astype(jnp.int32)
    side, column = jnp.where(lateral > 0.0, 0, 1), jnp.mod(index, N_BINS)
    # Unused beams go to a column that does not exist.
    column = jnp.where(useful, column, N_BINS)
    fresh = profile.stamp[side, jnp.minimum(column, N_BINS - 1)] != index
    keep = jnp.where(fresh, 0.0, 1.0)
    value = jnp.abs(lateral) if face is None else face
    total = profile.total.at[side, column].multiply(keep, mode="drop").at[side, column].add(value, mode="drop")
    count = profile.count.at[side, column].multiply(keep, mode="drop").at[side, column].add(1.0, mode="drop")
    stamp = profile.stamp.at[side, column].set(index, mode="drop")
    return WallProfile(total, count, stamp, profile.seen_from.at[side, column].set(pose.station, mode="drop"))


def centre(pose: AxisPose, ranges: Float[Array, "n_beams"], params: MatchParams) -> AxisPose:
    """Adjusts offset, heading and bend of a pose to walls of the usual distance."""
    along, lateral, sigma, useful = scan_points(pose, ranges, params)
    residual = lateral - jnp.where(lateral > 0.0, pose.half_width, -pose.half_width)
    variance = sigma * sigma + params.wall_sigma**2
    weight = jnp.where(useful, 1.0 / (variance * (1.0 + residual * residual / (6.0 * variance))), 0.0)
    change = solve_adjustment(residual[None], along, weight[None], params)[:, 0]
    wider = jnp.sum(weight * (jnp.abs(lateral) - pose.half_width)) / jnp.maximum(jnp.sum(weight), 1.0)
    return dataclasses.replace(
        pose,
        lateral=pose.lateral + change[0],
        heading=pose.heading + change[1],
        bend=pose.bend + change[2],
        half_width=pose.half_width + params.width_gain * wider,
    )


def solve_adjustment(
    residual: Float[Array, "n_shifts n_beams"],
    along: Float[Array, "n_beams"],
    weight: Float[Array, "n_shifts n_beams"],
    params: MatchParams,
) -> Float[Array, "3 n_shifts"]:
    """Computes the offset (m), turn (rad) and bend (1/m) that minimise the weighted squares, by Cramer's rule."""
    rows = jnp.stack([jnp.ones_like(along), along, -0.5 * along * along])
    sigma = (params.lateral_sigma, params.heading_sigma, params.bend_sigma)
    # In units of their standard deviations: float32 would not hold the determinant otherwise.
    rows = rows * jnp.asarray(sigma)[:, None]
    product = lambda i, j: jnp.sum(weight * rows[i] * rows[j], axis=1) + (1.0 if i == j else 0.0)  # noqa: E731
    (a, b, c), (d, e), f = (product(0, 0), product(0, 1), product(0, 2)), (product(1, 1), product(1, 2)), product(2, 2)
    p, q, r = (-jnp.sum(weight * rows[i] * residual, axis=1) for i in range(3))
    x, y, z = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * x + b * y + c * z
    solved = jnp.stack(
        [
            x * p + y * q + z * r,
            y * p + (a * f - c * c) * q + (b * c - a * e) * r,
            z * p + (b * c - a * e) * q + (a * d - b * b) * r,
        ]
    )
    return solved / determinant * jnp.asarray(sigma)[:, None]


@struct.dataclass
class Match:
    """Best fit of scans to the profile."""

    shift: Float[Array, ""]  # correction of the station, m
    information: Float[Array, ""]  # curvature of the cost along the axis, 1/m²: the inverse variance of `shift`
    informative: Bool[Array, ""]  # whether the match may be used


def mismatch(
    profile: WallProfile,
    pose: AxisPose,
    ranges: Float[Array, "n_beams"],
    params: MatchParams,
    face: Float[Array, "n_beams"] | None = None,
) -> Float[Array, "n_shifts"]:
    """Computes the cost of a scan at each shift along the axis: half a robust square of the residuals.

    At each shift offset, heading and bend are adjusted by weighted least squares, with their predictions as priors.
    Costs of successive scans are summed, because one scan of a few beams contains little information. With a `face` the
    profile is one of brightness, which no adjustment changes.
    """
    along, lateral, sigma, useful = scan_points(pose, ranges, params)
    shift = jnp.asarray(_SHIFTS, jnp.float32)[:, None]
    index = jnp.floor((pose.station + shift + along) / BIN).astype(jnp.int32)
    side, column = jnp.broadcast_to(jnp.where(lateral > 0.0, 0, 1), index.shape), jnp.mod(index, N_BINS)
    count = profile.count[side, column]
    # An entry from a step ago shares the errors of this scan: it would fit best without any motion.
    old = jnp.abs(pose.station - profile.seen_from[side, column]) > params.least_age
    known = useful & (profile.stamp[side, column] == index) & old
    wall = profile.total[side, column] / jnp.maximum(count, 1.0)
    if face is None:
        residual = jnp.where(known, lateral - jnp.where(side == 0, wall, -wall), 0.0)
        variance = sigma * sigma + params.wall_sigma**2 / jnp.maximum(count, 1.0)
    else:
        residual = jnp.where(known, face - wall, 0.0)
        variance = jnp.broadcast_to(params.face_sigma**2 * (1.0 + 1.0 / jnp.maximum(count, 1.0)), residual.shape)
    weight = jnp.where(known, 1.0 / (variance * (1.0 + residual * residual / (6.0 * variance))), 0.0)
    if face is None:
        change = solve_adjustment(residual, along, weight, params)
        residual = residual + change[0][:, None] + along * (change[1][:, None] - 0.5 * along * change[2][:, None])
    each = jnp.where(known, 3.0 * jnp.log1p(residual * residual / (6.0 * variance)), 0.0)
    # A beam at an unknown bin costs the average of the others, so that it favours no shift.
    usual = jnp.sum(each) / jnp.maximum(jnp.sum(known), 1)
    return jnp.sum(each, axis=1) + usual * jnp.sum(useful & ~known, axis=1)


def best_match(cost: Float[Array, "n_shifts"], params: MatchParams) -> Match:
    """Finds the shift of least cost, interpolated by a parabola, and whether it may be used.

    The curvature of the cost is the information along the axis. Between smooth walls it is due to chance alone, and
    the match must be ignored.

    Source: the test, Zhang et al. 2016, On Degeneracy of Optimization-based State Estimation Problems.
    """
    step, last = float(_SHIFTS[1] - _SHIFTS[0]), N_SHIFTS - 1
    least = jnp.argmin(cost)
    inner = jnp.clip(least, _BEND, last - _BEND)
    left, right = cost[inner - _BEND], cost[inner + _BEND]
    rise = left + right - 2.0 * cost[inner]
    shift = jnp.asarray(_SHIFTS, jnp.float32)[inner]
    shift = shift + 0.5 * _BEND * step * jnp.clip((left - right) / jnp.maximum(rise, 1e-6), -1.0, 1.0)
    information = rise / (_BEND * step) ** 2
    return Match(shift, information, (least == inner) & (information > params.least_information))


def log_face(pose: AxisPose, obs: Observed, params: EnvParams) -> Float[Array, "n_beams"] | None:
    """Returns the logarithm of the brightness of what each beam meets, freed of incidence; None without intensities."""
    seen = level_intensity(obs, params, whole=True)
    if seen is None:
        return None
    angle = jnp.asarray(bearings(seen.shape[0]), jnp.float32) + pose.heading
    return jnp.log(jnp.maximum(seen, 1.0) / jnp.maximum(jnp.abs(jnp.sin(angle)), 0.05))


@struct.dataclass
class MatchMemory:
    """Memory of the scan matcher."""

    profile: WallProfile  # the walls seen lately
    faces: WallProfile | None  # their brightness, with intensities
    pose: AxisPose  # estimated pose
    scale: Float[Array, ""]  # relative error of dead reckoning, 1
    # variance of the station against the profile (m²), covariance with the scale (m), variance of the scale (1)
    covariance: Float[Array, "3"]
    sigma: Float[Array, ""]  # standard deviation of the station against the start, m
    cost: Float[Array, "n_shifts"]  # mismatch of the scans since the last correction at each shift
    travelled: Float[Array, ""]  # distance since then, m
    reckoning: Reckoning  # dead reckoning


@struct.dataclass
class ScanMatcher(Localiser):
    """Dead reckoning and scan matching in a Kalman filter of station and scale."""

    motion: CloudParams  # errors of dead reckoning
    params: MatchParams  # settings of scan matching
    odometer_fraction: float | Float[Array, ""]  # weight of the odometer against the command
    window: float = 5.0  # distance over which mismatch is summed before a correction, m

    @classmethod
    def of(cls, params: EnvParams) -> "ScanMatcher":
        return cls(cloud_params(params), MatchParams(range_sigma(params)), odometer_fraction(params))

    def begin(self, obs: Observed, params: EnvParams) -> MatchMemory:
        """Begins at the believed start, on an axis that is taken to be straight."""
        zero, corridor = jnp.zeros(()), find_walls(obs.ranges, params)
        half_width = 0.5 * (corridor.left + corridor.right)
        pose = AxisPose(reported_start(obs, params), corridor.offset, corridor.angle, zero, half_width)
        return MatchMemory(
            profile=empty_profile(),
            faces=empty_profile() if "intensity" in obs.entries else None,
            pose=pose,
            scale=zero,
            covariance=jnp.stack([zero, zero, _prior(self.motion)]),
            sigma=jnp.asarray(params.start.station_sigma, jnp.float32),
            cost=jnp.zeros(N_SHIFTS),
            travelled=zero,
            reckoning=begin_reckoning(obs),
        )

    def update(
        self, memory: MatchMemory, obs: Observed, driven: Driven, params: EnvParams, known: Known
    ) -> tuple[Station, MatchMemory]:
        period = jnp.asarray(params.vehicle.period)
        distance, turn, reckoning = reckon(memory.reckoning, obs, driven.speed, self.odometer_fraction, period)
        pose = move_pose(memory.pose, distance * (1.0 + memory.scale), turn, memory.pose.bend)
        covariance = _propagate(memory.covariance, distance, self.motion)
        ranges = level_ranges(obs, params)
        pose = centre(pose, ranges, self.params)
        cost = memory.cost + mismatch(memory.profile, pose, ranges, self.params)
        face = log_face(pose, obs, params)
        if memory.faces is not None:
            cost = cost + mismatch(memory.faces, pose, ranges, self.params, face)
        travelled = memory.travelled + jnp.abs(distance)
        due = travelled >= self.window
        match = best_match(cost, self.params)
        match = dataclasses.replace(match, informative=match.informative & due)
        pose, scale, covariance = _fuse(pose, match, memory.scale, covariance)
        cost, travelled = jnp.where(due, 0.0, cost), jnp.where(due, 0.0, travelled)
        profile = add_scan(memory.profile, pose, ranges, self.params)
        faces = None if memory.faces is None else add_scan(memory.faces, pose, ranges, self.params, face)
        # The station is never corrected against the start: errors of the scale add up.
        sigma = memory.sigma + jnp.abs(distance) * jnp.sqrt(covariance[2])
        forward = jnp.cos(pose.heading)
        estimate = Station(
            pose.station + unobserved_distance(reckoning, period) * forward,
            jnp.log(jnp.maximum(sigma, _LEAST_SIGMA)),
            jnp.where(forward > 0.0, 1.0, -1.0),
        )
        return estimate, MatchMemory(profile, faces, pose, scale, covariance, sigma, cost, travelled, reckoning)


def scan_matching(params: EnvParams) -> Navigator:
    """Makes the matcher with the steering and the mission of the other baselines."""
    return Navigator(ScanMatcher.of(params), steering_of(params, CentreLine()), name="scan-matching")


def _propagate(covariance: Float[Array, "3"], distance: Float[Array, ""], motion: CloudParams) -> Float[Array, "3"]:
    """Propagates the covariance over a distance, m."""
    station, both, scale = covariance
    station = station + distance * (2.0 * both + distance * scale) + motion.step_sigma**2
    wandered = 2.0 * motion.wander.sigma**2 * jnp.abs(distance) / motion.wander.length
    return jnp.stack([station, both + distance * scale, jnp.minimum(scale + wandered, _prior(motion))])


def _prior(motion: CloudParams) -> Float[Array, ""]:
    """Variance of the scale before any match."""
    return jnp.asarray(motion.scale_sigma**2 + motion.wander.sigma**2)


def _fuse(
    pose: AxisPose, match: Match, scale: Float[Array, ""], covariance: Float[Array, "3"]
) -> tuple[AxisPose, Float[Array, ""], Float[Array, "3"]]:
    """Corrects pose, scale and covariance by a match; station and scale stay where it is not informative."""
    station, both, of_scale = covariance
    total = station + 1.0 / jnp.maximum(match.information, 1.0)
    use = jnp.where(match.informative, 1.0 / total, 0.0)
    forward = jnp.cos(pose.heading)
    pose = dataclasses.replace(pose, station=pose.station + use * station * match.shift)
    after = jnp.stack([station - use * station * station, both - use * station * both, of_scale - use * both * both])
    # On the way back, too small a scale makes the station too large.
    return pose, scale + use * both * match.shift * jnp.sign(forward), after
