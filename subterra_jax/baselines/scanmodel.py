"""Likelihood of a LiDAR scan at many poses in a mapped tunnel.

`fit` compares the end of each beam with the mapped wall at its station, and casts no ray; `exactscan` does.
"""

import dataclasses
from typing import TypeVar

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.baselines.wallmap import WallMap
from subterra_jax.lidar import bearings

_SIDEWAYS = 0.3  # sine from which on a beam looks at a wall, not along it
_ROUGH_INFLATIONS = (10.0, 6.0, 3.0, 1.5, 1.0)


@struct.dataclass
class ScanModel:
    """Assumed errors of the LiDAR and of its map."""

    range_sigma: float | Float[Array, ""] = 0.05  # standard deviation of a range, m
    # standard deviation of the mapped walls, m, for a beam square to them; a slanting beam meets more of what the map
    # leaves out, such as the far end of a pocket instead of its back
    map_sigma: float = 0.01
    outlier_fraction: float = 0.05  # fraction of the beams that meet something outside the map: dust, a box
    outlier_density: float = 0.1  # density of the residuals of such beams, 1/m
    miss_fraction: float = 0.02  # fraction of the beams that get no echo from a near wall
    # Longest range used, m: longer beams graze the wall. The same beams are used for every pose, or poses would be
    # compared by how many beams they leave out.
    reach: float = 9.0
    lateral_sigma: float = 0.01  # standard deviation of the lateral offset after one step of dead reckoning, m
    heading_sigma: float = 0.003  # standard deviation of the heading after one step, rad
    power: float = 0.5  # exponent of the likelihood; below 1 it allows for errors that beams and scans have in common


@struct.dataclass
class TunnelPose:
    """Poses in a tunnel."""

    station: Float[Array, "*n"]  # station, m
    lateral: Float[Array, "*n"]  # distance to the left of the centreline, m
    heading: Float[Array, "*n"]  # heading against the tangent of growing station, rad; any number of turns


_Pose = TypeVar("_Pose", bound=TunnelPose)


def move_pose(
    pose: _Pose, distance: Float[Array, "*n"], turned: Float[Array, ""], curvature: Float[Array, "*n"]
) -> _Pose:
    """Move poses along an axis.

    Args:
        distance: Distance of each, m.
        turned: Turn of all, rad; NaN is unknown, and replaced by that of the axis.
        curvature: Curvature of the axis at each, 1/m.
    """
    turned = jnp.where(jnp.isnan(turned), curvature * distance, turned)
    middle = pose.heading + 0.5 * turned
    along = distance * jnp.cos(middle) / (1.0 - curvature * pose.lateral)
    return dataclasses.replace(
        pose,
        station=pose.station + along,
        lateral=pose.lateral + distance * jnp.sin(middle),
        heading=pose.heading + turned - curvature * along,
    )


@struct.dataclass
class Endpoints:
    """Ends of the beams of a scan."""

    along: Float[Array, "n_beams *n"]  # distance ahead of the LiDAR along the tangent at its station, m
    station: Float[Array, "n_beams *n"]  # station, m
    lateral: Float[Array, "n_beams *n"]  # distance to the left of the centreline, m
    # standard deviation of `lateral` against the map, m, without the spread of the map itself
    sigma: Float[Array, "n_beams *n"]
    useful: Bool[Array, "n_beams *n"]  # whether the beam met something near and is used
    # whether a beam that should meet a near wall got no echo; it ends at the usual distance of a wall
    missed: Bool[Array, "n_beams *n"]


def endpoints(
    walls: WallMap, pose: TunnelPose, ranges: Float[Array, "n_beams"], range_max: Float[Array, ""], model: ScanModel
) -> Endpoints:
    """Computes the ends of a scan's beams (m; `range_max` without an echo) for several poses.

    The centreline is a circle to either side. With its true shape they would move by less than 1 cm where the curvature
    changes by 1e-4 1/m².
    """
    bearing = bearings(ranges.shape[0])
    shape = (-1, *[1] * pose.station.ndim)
    cos_beam, sin_beam = (jnp.asarray(np.float32(f(bearing))).reshape(shape) for f in (np.cos, np.sin))
    cos, sin = jnp.cos(pose.heading), jnp.sin(pose.heading)
    slant = sin * cos_beam + cos * sin_beam
    silent = (ranges >= range_max).reshape(shape)
    missed = silent & (jnp.abs(slant) > _SIDEWAYS)
    far = jnp.where(missed, walls.half_width / jnp.maximum(jnp.abs(slant), _SIDEWAYS), ranges.reshape(shape))
    x, y = far * (cos * cos_beam - sin * sin_beam), pose.lateral + far * slant
    ahead, behind, _ = walls.curvature(pose.station)
    bend = jnp.where(x > 0.0, ahead, behind)
    across, turned = 1.0 - bend * y, bend * x
    root = jnp.sqrt(across * across + turned * turned)
    lateral = (2.0 * y - bend * (y * y + x * x)) / (1.0 + root)
    ratio = turned / across
    square = ratio * ratio
    station = pose.station + x / across * (1.0 - square * (1.0 / 3.0 - square / 5.0))
    useful = jnp.broadcast_to(~silent & (far < model.reach), x.shape)
    square_slant = jnp.maximum(slant * slant, _SIDEWAYS**2)
    sigma = jnp.sqrt(model.range_sigma**2 * square_slant + model.map_sigma**2 / square_slant)
    return Endpoints(x, station, lateral, sigma, useful, missed)


def fit(
    walls: WallMap,
    pose: TunnelPose,
    ranges: Float[Array, "n_beams"],
    range_max: Float[Array, ""],
    model: ScanModel,
    inflation: float = 1.0,
) -> tuple[Float[Array, "*n"], TunnelPose]:
    """Computes the log likelihood of a scan at several poses, and adjusts their lateral offset and heading to it.

    A beam's residual is normal, with the variance of the wall within the blur, or an outlier with a small
    probability. One weighted least-squares step in offset and heading, with their predictions as priors, approximates
    the integral over both.

    `inflation` is a factor on every standard deviation: above 1, poses further from the truth converge to it. The other
    arguments are those of `endpoints`.

    Returns:
        Log likelihood, up to a constant, and the adjusted poses.
    """
    ends = endpoints(walls, pose, ranges, range_max, model)
    left = ends.lateral > 0.0
    wall, spread, inside = walls.offset(ends.station, left)
    residual = ends.lateral - jnp.where(left, wall, -wall)
    variance = inflation**2 * ends.sigma**2 + spread
    useful = ends.useful & inside
    square = residual * residual / variance
    # Cauchy's weight: a large residual pulls little, but enough for a lost pose to come back.
    weight = jnp.where(useful, 1.0 / (variance * (1.0 + square / 6.0)), 0.0)
    sigma = inflation * model.lateral_sigma, inflation * model.heading_sigma
    shift, turn = least_squares_step(residual, ends.along, weight, sigma)
    residual = residual + shift + ends.along * turn
    each = _log_mixture(residual * residual / variance, variance, model)
    # An echo from beyond a mouth, or no echo from a wall, is unlikely.
    missed = jnp.where(ends.missed & inside, jnp.log(model.miss_fraction), 0.0)
    unlikely = jnp.where(ends.useful, jnp.log(_outlier_density(model)), missed)
    total = jnp.sum(jnp.where(useful, each, unlikely), axis=0)
    prior = (shift / model.lateral_sigma) ** 2 + (turn / model.heading_sigma) ** 2
    adjusted = TunnelPose(pose.station, pose.lateral + shift, pose.heading + turn)
    return model.power * (total - 0.5 * prior / inflation**2), adjusted


def fit_roughly(
    walls: WallMap, pose: TunnelPose, ranges: Float[Array, "n_beams"], range_max: Float[Array, ""], model: ScanModel
) -> TunnelPose:
    """Adjusts offsets and headings that are up to a metre and 0.5 rad wrong to a scan."""
    wide = dataclasses.replace(model, lateral_sigma=0.1, heading_sigma=0.05)
    for inflation in _ROUGH_INFLATIONS:
        _, pose = fit(walls, pose, ranges, range_max, wide, inflation)
    return pose


def least_squares_step(
    residual: Float[Array, "n_beams *n"],
    along: Float[Array, "n_beams *n"],
    weight: Float[Array, "n_beams *n"],
    sigma: tuple[float, float],
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Computes the shift (m) and turn (rad) that minimise the weighted squares of `residual + shift + along * turn`.

    `sigma` are their standard deviations before: they are drawn towards 0 by them.
    """
    a = jnp.sum(weight, axis=0) + sigma[0] ** -2
    b = jnp.sum(weight * along, axis=0)
    c = jnp.sum(weight * along * along, axis=0) + sigma[1] ** -2
    p, q = jnp.sum(weight * residual, axis=0), jnp.sum(weight * along * residual, axis=0)
    # The sum of two positive definite parts cannot vanish.
    determinant = a * c - b * b
    return (b * q - c * p) / determinant, (b * p - a * q) / determinant


def _outlier_density(model: ScanModel) -> float:
    """Density of an outlier's residual times its probability, 1/m."""
    return model.outlier_fraction * model.outlier_density


def _log_mixture(
    square: Float[Array, "n_beams *n"], variance: Float[Array, "n_beams *n"], model: ScanModel
) -> Float[Array, "n_beams *n"]:
    """Log density of a residual, of which `square` is the square over the variance."""
    normal = (1.0 - model.outlier_fraction) * jnp.exp(-0.5 * square) / jnp.sqrt(2.0 * jnp.pi * variance)
    return jnp.log(normal + _outlier_density(model))
