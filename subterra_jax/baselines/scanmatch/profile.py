"""The walls as one without a map remembers them: two profiles, distance from the axis over station.

They are kept in a ring of bins for as long as some beam may meet them again.
"""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.lidar import bearings

BIN = 0.08  # m
N_BINS = 256  # 20 m: from the furthest useful beam ahead to the furthest behind


@struct.dataclass
class MatchParams:
    """How scans are matched.

    Attributes:
        range_sigma: Standard deviation of a range, m.
        wall_sigma: Standard deviation of one entry of the profile, m.
        reach: Longer beams are left alone, m.
        lateral_sigma: Standard deviation of the offset after one step of dead reckoning, m.
        heading_sigma: Of the heading, rad.
        bend_sigma: Of the curvature of the axis, 1/m.
        width_gain: Share of a change of width that one scan is believed, 1.
        least_age: What was seen from less far away than this is not matched, m.
        least_information: Curvature of the cost, 1/m², below which a match says nothing about the station.
    """

    range_sigma: float | Float[Array, ""] = 0.05
    wall_sigma: float = 0.05
    reach: float = 9.0
    lateral_sigma: float = 0.01
    heading_sigma: float = 0.003
    bend_sigma: float = 0.0002
    width_gain: float = 0.05
    least_age: float = 1.0
    least_information: float = 5000.0


@struct.dataclass
class Profile:
    """What is remembered of the walls, in a ring of bins.

    Attributes:
        total: Sum of the distances seen in each bin, m; left wall, right wall.
        count: How many.
        stamp: Which bin of the tunnel each now stands for.
        seen_from: Station from which it was last seen, m.
    """

    total: Float[Array, "2 n_bins"]
    count: Float[Array, "2 n_bins"]
    stamp: Int[Array, "2 n_bins"]
    seen_from: Float[Array, "2 n_bins"]


@struct.dataclass
class Pose:
    """Where the robot is against the axis.

    Attributes:
        station: Station, m.
        lateral: Distance to the left of the axis, m.
        heading: Heading against growing station, rad.
        bend: Curvature of the axis, 1/m.
        half_width: Usual distance of a wall, m.
    """

    station: Float[Array, ""]
    lateral: Float[Array, ""]
    heading: Float[Array, ""]
    bend: Float[Array, ""]
    half_width: Float[Array, ""]


def empty_profile() -> Profile:
    """Nothing seen."""
    zero = jnp.zeros((2, N_BINS))
    return Profile(zero, zero, jnp.full((2, N_BINS), -(2**30), jnp.int32), zero)


def points(
    pose: Pose, ranges: Float[Array, "n_beams"], params: MatchParams
) -> tuple[Float[Array, "n_beams"], Float[Array, "n_beams"], Float[Array, "n_beams"], Bool[Array, "n_beams"]]:
    """Endpoints of a scan, m: ahead along the axis, left of it, sigma of the latter; and which of them count."""
    angle = jnp.asarray(bearings(ranges.shape[0]), jnp.float32) + pose.heading
    along, slant = ranges * jnp.cos(angle), jnp.sin(angle)
    lateral = pose.lateral + ranges * slant - 0.5 * pose.bend * along * along
    sigma = jnp.maximum(params.range_sigma * jnp.abs(slant), 0.4 * params.range_sigma)
    return along, lateral, sigma, ranges < params.reach


def remembered(profile: Profile, pose: Pose, ranges: Float[Array, "n_beams"], params: MatchParams) -> Profile:
    """The profile with a scan added; bins that stood for another place begin anew."""
    along, lateral, _, useful = points(pose, ranges, params)
    place = jnp.floor((pose.station + along) / BIN).astype(jnp.int32)
    side, column = jnp.where(lateral > 0.0, 0, 1), jnp.mod(place, N_BINS)
    # Beams that do not count go to a column that does not exist.
    column = jnp.where(useful, column, N_BINS)
    fresh = profile.stamp[side, jnp.minimum(column, N_BINS - 1)] != place
    keep = jnp.where(fresh, 0.0, 1.0)
    total = (
        profile.total.at[side, column].multiply(keep, mode="drop").at[side, column].add(jnp.abs(lateral), mode="drop")
    )
    count = profile.count.at[side, column].multiply(keep, mode="drop").at[side, column].add(1.0, mode="drop")
    stamp = profile.stamp.at[side, column].set(place, mode="drop")
    return Profile(total, count, stamp, profile.seen_from.at[side, column].set(pose.station, mode="drop"))


def centred(pose: Pose, ranges: Float[Array, "n_beams"], params: MatchParams) -> Pose:
    """The pose with offset, heading and bend adjusted to walls as far apart as they usually are."""
    along, lateral, sigma, useful = points(pose, ranges, params)
    residual = lateral - jnp.where(lateral > 0.0, pose.half_width, -pose.half_width)
    variance = sigma * sigma + params.wall_sigma**2
    weight = jnp.where(useful, 1.0 / (variance * (1.0 + residual * residual / (6.0 * variance))), 0.0)
    change = adjusted(residual[None], along, weight[None], params)[:, 0]
    wider = jnp.sum(weight * (jnp.abs(lateral) - pose.half_width)) / jnp.maximum(jnp.sum(weight), 1.0)
    return dataclasses.replace(
        pose,
        lateral=pose.lateral + change[0],
        heading=pose.heading + change[1],
        bend=pose.bend + change[2],
        half_width=pose.half_width + params.width_gain * wider,
    )


def adjusted(
    residual: Float[Array, "n_shifts n_beams"],
    along: Float[Array, "n_beams"],
    weight: Float[Array, "n_shifts n_beams"],
    params: MatchParams,
) -> Float[Array, "3 n_shifts"]:
    """Offset (m), turn (rad) and bend (1/m) that lessen the weighted squares most; by Cramer's rule."""
    rows = jnp.stack([jnp.ones_like(along), along, -0.5 * along * along])
    sigma = (params.lateral_sigma, params.heading_sigma, params.bend_sigma)
    # In units of their standard deviations, or float32 would not hold the determinant.
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
