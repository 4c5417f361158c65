"""Likelihood of a LiDAR scan at many poses, each of which casts the whole scan in the true walls.

A pose along the tunnel is a guess of its station; offset and heading are fitted to the scan and still a little off. At
a slanting beam a little is much: 3 mrad move the end of a beam of 20 m, which meets its wall at 7 degrees, by half a
metre. So the likelihood is taken over what offset and heading may be off, as `scanmodel.fit` does on its map, with a
straight wall where a beam ends.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax import lidar
from subterra_jax.baselines.scanmodel import TunnelPose, least_squares_step
from subterra_jax.baselines.wallmap import WallMap
from subterra_jax.state import EnvParams
from subterra_jax.tunnel import beside

_ECHO = 1e-3  # m below `range_max`: no echo
_GRAZING = 0.02  # sine of the least angle between a beam and its wall
_DOUBT = (4.0, 1.0)  # factors on the variance, pass by pass


@struct.dataclass
class ExactParams:
    """Likelihood of a scan that was cast at a pose."""

    lateral_sigma: float = 0.01  # standard deviation of an offset that was fitted to the scan, m
    heading_sigma: float = 0.003  # standard deviation of such a heading, rad
    wall_sigma: float = 0.005  # distance of a wall from its tangent where a beam ends, m, as a standard deviation
    # what a metre of range adds to that, 1: the tangent follows from the curvature about the robot
    bend_sigma: float = 0.001
    power: float = 0.5  # exponent of the likelihood: scans have errors in common
    # fraction of the echoes that are lost or false, where there are faults or boxes; elsewhere a tenth of it
    lost: float = 0.2


@struct.dataclass
class Cast:
    """Beams that were cast in the walls."""

    expected: Float[Array, "n_beams n"]  # ranges, m
    # sine of the angle between a beam and its wall, positive to the left; never within `_GRAZING` of 0
    slant: Float[Array, "n_beams n"]
    along: Float[Array, "n_beams n"]  # distance at which a beam ends, along that wall, m; behind is negative
    variance: Float[Array, "n_beams n"]  # variance of the beam's end across that wall, m²


def exact_likelihood(
    walls: WallMap, pose: TunnelPose, ranges: Float[Array, "n_beams"], params: EnvParams, exact: ExactParams
) -> Float[Array, "n"]:
    """Compute the log likelihood of a scan at many poses, over what their offset and heading may be off.

    Args:
        walls: The map of the tunnel that the robot is in, for the curvature.
        pose: Poses, each field `(n,)`, fitted to the scan.
        ranges: The scan, m.
        params: The task in that tunnel.

    Returns:
        The largest over offset and heading, up to a constant, by weighted least squares.
    """
    rough = "faults" in params.parts or "obstacles" in params.parts
    lost, range_max = exact.lost * (1.0 if rough else 0.1), jnp.asarray(params.lidar.range_max)
    beams = cast_beams(walls, pose, params, exact)
    silent, empty = ranges[:, None] >= range_max - _ECHO, beams.expected >= range_max - _ECHO
    residual, false = (ranges[:, None] - beams.expected) * beams.slant, lost / range_max
    shift, turn = _correction(residual, beams, ~silent & ~empty, false, exact)
    seen = jnp.log(_true_echo(residual + shift + turn * beams.along, beams, 1.0) * (1.0 - lost) + false)
    nothing = jnp.where(empty, jnp.log1p(-0.5 * lost), jnp.log(0.5 * lost))
    prior = (shift / exact.lateral_sigma) ** 2 + (turn / exact.heading_sigma) ** 2
    return exact.power * (jnp.sum(jnp.where(silent, nothing, seen), axis=0) - 0.5 * prior)


def cast_beams(walls: WallMap, pose: TunnelPose, params: EnvParams, exact: ExactParams) -> Cast:
    """Casts a scan at each pose, and tells at which angle each beam meets its wall.

    Arguments are those of `exact_likelihood`. A wall is taken to run along the centreline, which bends as it does ahead
    and behind in the mean.
    """
    tunnel, sensor = params.tunnel, params.lidar

    def cast(station: Array, lateral: Array, heading: Array) -> Array:
        position, ahead = beside(tunnel, station, lateral)
        return lidar.scan(tunnel, position, heading + ahead, station, sensor)

    expected = jax.vmap(cast)(pose.station, pose.lateral, pose.heading).T
    bearing = pose.heading + jnp.asarray(np.float32(lidar.bearings(expected.shape[0])))[:, None]
    ahead, behind, _ = walls.curvature(pose.station)
    forward = expected * jnp.cos(bearing)
    angle = bearing - jnp.where(forward > 0.0, ahead, behind) * forward
    sine = jnp.sin(angle)
    slant = jnp.where(jnp.abs(sine) < _GRAZING, jnp.where(sine < 0.0, -_GRAZING, _GRAZING), sine)
    bent = exact.wall_sigma + exact.bend_sigma * expected
    variance = (jnp.asarray(sensor.range_sigma) * slant) ** 2 + bent**2
    return Cast(expected, slant, expected * jnp.cos(angle), variance)


def _true_echo(rest: Float[Array, "n_beams n"], beams: Cast, doubt: float) -> Float[Array, "n_beams n"]:
    """Return the density of an echo from the wall, per metre of range as that of a false one is."""
    variance = doubt * beams.variance
    return jnp.exp(-0.5 * rest * rest / variance) / jnp.sqrt(2.0 * jnp.pi * variance) * jnp.abs(beams.slant)


def _correction(
    residual: Float[Array, "n_beams n"],
    beams: Cast,
    useful: Bool[Array, "n_beams n"],
    false: Float[Array, ""],
    exact: ExactParams,
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """Return shift (m) and turn (rad) that bring the ends of the beams nearest to the walls.

    Each beam counts by how likely its echo is from the wall; `false` is the density of one that is not, 1/m.
    """
    rest, sigma = residual, (exact.lateral_sigma, exact.heading_sigma)
    for doubt in _DOUBT:
        true = _true_echo(rest, beams, doubt)
        weight = jnp.where(useful, true / (true + false) / (doubt * beams.variance), 0.0)
        shift, turn = least_squares_step(residual, beams.along, weight, sigma)
        rest = residual + shift + turn * beams.along
    return shift, turn
