"""How well a scan fits a place: endpoints of the beams against the mapped walls, without casting a ray."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from subterra_jax.baselines.particle.scan import Place, ScanModel, endpoints
from subterra_jax.baselines.particle.wallmap import WallMap

_FIRST_LOOKS = (10.0, 6.0, 3.0, 1.5, 1.0)  # inflations


def fit(
    walls: WallMap,
    place: Place,
    ranges: Float[Array, "n_beams"],
    range_max: Float[Array, ""],
    model: ScanModel,
    inflation: float = 1.0,
) -> tuple[Float[Array, "*n"], Place]:
    """Log likelihood of a scan at several places, lateral offset and heading adjusted to it within their uncertainty.

    A beam's residual is normal, with the wall's own variance within the blur, or, with a small probability, anything.
    One weighted least-squares step in offset and heading, each drawn to its prediction, stands for integrating over
    both.

    Args:
        walls: The map of one tunnel.
        place: The places; every field `(*n,)`.
        ranges: The scan, m.
        range_max: The range of a beam without an echo, m.
        model: What is believed about the LiDAR.
        inflation: Factor on every standard deviation: above 1, a place further from the truth is drawn to it.

    Returns:
        Log likelihood, up to a constant, and the places adjusted.
    """
    ends = endpoints(walls, place, ranges, range_max, model)
    left = ends.lateral > 0.0
    wall, spread, inside = walls.offset(ends.station, left)
    residual = ends.lateral - jnp.where(left, wall, -wall)
    variance = inflation**2 * ends.sigma**2 + spread
    useful = ends.useful & inside
    square = residual * residual / variance
    # Cauchy's weight: a large residual pulls little, but enough for a place that was lost to come back.
    weight = jnp.where(useful, 1.0 / (variance * (1.0 + square / 6.0)), 0.0)
    shift, turn = adjusted(residual, ends.along, weight, model, inflation)
    residual = residual + shift + ends.along * turn
    each = _log_mixture(residual * residual / variance, variance, model)
    # An echo from outside of a mouth, and no echo from a wall, are a surprise.
    missed = jnp.where(ends.missed & inside, jnp.log(model.miss_share), 0.0)
    surprise = jnp.where(ends.useful, jnp.log(_stray(model)), missed)
    total = jnp.sum(jnp.where(useful, each, surprise), axis=0)
    drawn = (shift / model.lateral_sigma) ** 2 + (turn / model.heading_sigma) ** 2
    moved = Place(place.station, place.lateral + shift, place.heading + turn)
    return model.power * (total - 0.5 * drawn / inflation**2), moved


def first_look(
    walls: WallMap, place: Place, ranges: Float[Array, "n_beams"], range_max: Float[Array, ""], model: ScanModel
) -> Place:
    """Places with the offset and the heading that a scan shows, if theirs were up to a metre and 0.5 rad wrong."""
    wide = dataclasses.replace(model, lateral_sigma=0.1, heading_sigma=0.05)
    for inflation in _FIRST_LOOKS:
        _, place = fit(walls, place, ranges, range_max, wide, inflation)
    return place


def adjusted(
    residual: Float[Array, "n_beams *n"],
    along: Float[Array, "n_beams *n"],
    weight: Float[Array, "n_beams *n"],
    model: ScanModel,
    inflation: float = 1.0,
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Shift (m) and turn (rad) that lessen the weighted squares of `residual + shift + along * turn` most."""
    a = jnp.sum(weight, axis=0) + (inflation * model.lateral_sigma) ** -2
    b = jnp.sum(weight * along, axis=0)
    c = jnp.sum(weight * along * along, axis=0) + (inflation * model.heading_sigma) ** -2
    p, q = jnp.sum(weight * residual, axis=0), jnp.sum(weight * along * residual, axis=0)
    # Two positive definite parts, so that it cannot vanish.
    determinant = a * c - b * b
    return (b * q - c * p) / determinant, (b * p - a * q) / determinant


def _stray(model: ScanModel) -> float:
    return model.outlier_share * model.outlier_density


def _log_mixture(
    square: Float[Array, "n_beams *n"], variance: Float[Array, "n_beams *n"], model: ScanModel
) -> Float[Array, "n_beams *n"]:
    """Log density of a residual, of which `square` is the square over the variance."""
    normal = (1.0 - model.outlier_share) * jnp.exp(-0.5 * square) / jnp.sqrt(2.0 * jnp.pi * variance)
    return jnp.log(normal + _stray(model))
