"""Matching scans with the walls seen before: at which shift along the axis they fit, and whether that says anything."""

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.baselines.scanmatch.profile import BIN, N_BINS, MatchParams, Pose, Profile, adjusted, points

_SHIFTS = np.round(np.arange(-0.4, 0.401, 0.02), 2)  # m
N_SHIFTS = len(_SHIFTS)
_BEND = 5  # shifts to either side over which the curvature of the cost is taken


@struct.dataclass
class Match:
    """The best fit.

    Attributes:
        shift: By how much the station is too small, m.
        information: Curvature of the cost along the axis, 1/m²: the inverse variance of `shift`.
        informative: Whether it says anything.
    """

    shift: Float[Array, ""]
    information: Float[Array, ""]
    informative: Bool[Array, ""]


def mismatch(
    profile: Profile, pose: Pose, ranges: Float[Array, "n_beams"], params: MatchParams
) -> Float[Array, "n_shifts"]:
    """How badly a scan fits the profile at each shift along the axis: half a robust square of the residuals.

    At each shift offset, heading and bend are adjusted by weighted least squares, drawn to their predictions. Costs of
    scans that follow one another add up: one scan of a few beams says little.
    """
    along, lateral, sigma, useful = points(pose, ranges, params)
    shift = jnp.asarray(_SHIFTS, jnp.float32)[:, None]
    place = jnp.floor((pose.station + shift + along) / BIN).astype(jnp.int32)
    side, column = jnp.broadcast_to(jnp.where(lateral > 0.0, 0, 1), place.shape), jnp.mod(place, N_BINS)
    count = profile.count[side, column]
    # What a beam itself saw a step ago has its own errors in it: it would fit best where nothing had moved.
    old = jnp.abs(pose.station - profile.seen_from[side, column]) > params.least_age
    known = useful & (profile.stamp[side, column] == place) & old
    wall = profile.total[side, column] / jnp.maximum(count, 1.0)
    residual = jnp.where(known, lateral - jnp.where(side == 0, wall, -wall), 0.0)
    variance = sigma * sigma + params.wall_sigma**2 / jnp.maximum(count, 1.0)
    weight = jnp.where(known, 1.0 / (variance * (1.0 + residual * residual / (6.0 * variance))), 0.0)
    change = adjusted(residual, along, weight, params)
    residual = residual + change[0][:, None] + along * (change[1][:, None] - 0.5 * along * change[2][:, None])
    each = jnp.where(known, 3.0 * jnp.log1p(residual * residual / (6.0 * variance)), 0.0)
    # Where a bin is not known a beam costs what the others do on average: nothing is won or lost by it.
    usual = jnp.sum(each) / jnp.maximum(jnp.sum(known), 1)
    return jnp.sum(each, axis=1) + usual * jnp.sum(useful & ~known, axis=1)


def best(cost: Float[Array, "n_shifts"], params: MatchParams) -> Match:
    """The shift of least cost, between the shifts by a parabola, and whether it means anything.

    The curvature of the cost is the information that there is along the axis. Between smooth walls there is none but
    chance's, and the match is to be ignored.

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
