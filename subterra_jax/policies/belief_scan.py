"""The learnt sensor of a belief: how well each sideways beam of a scan fits the map at a place.

Offset and angle of the robot are first adjusted to each place, as in `subterra_jax.baselines.scanmodel`. Then
a small network, the same for all beams and places, corrects the nominal likelihood of each beam.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from subterra_jax.baselines.scanmodel import Endpoints, ScanModel, TunnelPose, endpoints, least_squares_step
from subterra_jax.baselines.steering import Corridor
from subterra_jax.baselines.wallmap import WallMap
from subterra_jax.lidar import bearings
from subterra_jax.policies.networks import perceptron
from subterra_jax.policies.trained import Tensors

N_FEATURES = 11
MOST = 3.0  # largest learnt log likelihood of one beam, either way
_SIDEWAYS = 0.3  # sine of a beam that meets a wall near enough
_TAP = 0.1  # m: half a pocket before and after the end of a beam
_PRIOR = ScanModel(range_sigma=0.05, lateral_sigma=0.1, heading_sigma=0.03)  # offset and angle come from the corridor
_STRAY = 0.05 * 0.1  # 1/m: share of beams that meet what no map has, times the density of where they end


def pose_at(corridor: Corridor, station: Float[Array, "*n"], forward: Float[Array, "*n"]) -> TunnelPose:
    """Returns the pose of a robot between two tracked walls at a station.

    Args:
        corridor: The tracked walls.
        station: Stations to try, m.
        forward: 1 where it faces growing stations, −1 where it faces falling ones.
    """
    offset, backward = jnp.broadcast_to(corridor.offset, station.shape), 0.5 * (1.0 - forward)
    return TunnelPose(station, forward * offset, corridor.angle + jnp.pi * backward)


def score(
    tensors: Tensors, walls: WallMap, place: TunnelPose, ranges: Float[Array, "n_beams"], range_max: Float[Array, ""]
) -> Float[Array, "*n"]:
    """Computes the log likelihood of a scan at several places, up to a constant.

    Args:
        tensors: Layers `scan.hidden_<i>`, and the logarithms `temper` (factor on the whole) and `nominal` (factor on
            the nominal log likelihood).
        walls: The map of one tunnel.
        place: The places, with roughly known offset and angle; every field `(*n,)`.
        ranges: The scan, m; beam 0 straight ahead, the others counter-clockwise.
        range_max: Range of a beam without an echo, m.
    """
    ends = endpoints(walls, place, ranges, range_max, _PRIOR)
    sideways = np.flatnonzero(np.abs(np.sin(bearings(ranges.shape[0]))) > _SIDEWAYS)
    ends = jax.tree.map(lambda leaf: leaf[sideways], ends)
    features, nominal = _features(walls, ends, ranges[sideways], range_max)
    counts = (ends.useful | ends.missed).astype(jnp.float32)
    return jnp.sum(counts * beam_scores(tensors, features, nominal), axis=0)


def beam_scores(tensors: Tensors, features: Float[Array, "*n f"], nominal: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Computes the log likelihood of beams, up to a constant.

    Args:
        tensors: As for `score`.
        features: Inputs of the network.
        nominal: Nominal log likelihood.
    """
    learnt = MOST * jnp.tanh(perceptron(tensors, "scan", features, jax.nn.relu)[..., 0] / MOST)
    return jnp.exp(tensors["temper"]) * (jnp.exp(tensors["nominal"]) * nominal + learnt)


def _features(
    walls: WallMap, ends: Endpoints, ranges: Float[Array, "n_side"], range_max: Float[Array, ""]
) -> tuple[Float[Array, "n_side *n f"], Float[Array, "n_side *n"]]:
    """Returns the inputs of the network for each beam and place, and the nominal log likelihood."""
    left = ends.lateral > 0.0
    side = jnp.where(left, 1.0, -1.0)
    wall, spread, inside = walls.offset(ends.station, left)
    variance = ends.sigma * ends.sigma + spread
    residual = _fit_residuals(ends, side, wall, variance, inside)
    onward = _TAP * jnp.where(ends.along > 0.0, 1.0, -1.0)
    before, after = (walls.offset(ends.station + step, left)[0] for step in (-onward, onward))
    sigma = jnp.sqrt(variance)
    square = residual * residual / variance
    normal = jnp.exp(-0.5 * square) / (np.float32(np.sqrt(2.0 * np.pi)) * sigma)
    hit = ends.useful & inside
    # Unexpected are an echo from outside of a mouth, and no echo from a wall.
    surprise = jnp.where(ends.useful, np.float32(np.log(_STRAY)), jnp.where(inside, np.float32(np.log(0.02)), 0.0))
    nominal = jnp.where(hit, jnp.log(normal + _STRAY), surprise)
    number = lambda mask: jnp.broadcast_to(mask, square.shape).astype(jnp.float32)  # noqa: E731
    reach = jnp.minimum(ranges / range_max, 1.0).reshape(-1, *[1] * (square.ndim - 1))
    parts = [
        jnp.clip(residual / 0.1, -3.0, 3.0),
        jnp.clip(residual / sigma, -3.0, 3.0),
        jnp.minimum(square, 9.0) / 9.0,
        jnp.exp(-0.5 * square),
        jnp.sqrt(spread) / 0.05,
        ends.sigma / 0.05,
        jnp.clip((before - wall) / 0.1, -2.0, 2.0),
        jnp.clip((after - wall) / 0.1, -2.0, 2.0),
        number(ends.missed & inside),
        number(inside),
        jnp.broadcast_to(3.0 * reach, square.shape),
    ]
    return jnp.stack(parts, axis=-1), nominal


def _fit_residuals(
    ends: Endpoints,
    side: Float[Array, "n_side *n"],
    wall: Float[Array, "n_side *n"],
    variance: Float[Array, "n_side *n"],
    inside: Array,
) -> Float[Array, "n_side *n"]:
    """Returns how far outside the mapped wall each beam ends, m, after offset and angle are adjusted to the place."""
    residual, useful = ends.lateral - side * wall, ends.useful & inside
    shift, turn = jnp.zeros(residual.shape[1:]), jnp.zeros(residual.shape[1:])
    for _ in range(2):
        left_over = residual + shift + ends.along * turn
        # Cauchy's weight, as in the particle filter: a pocket that is missing has little influence.
        weight = jnp.where(useful, 1.0 / (variance * (1.0 + left_over * left_over / (6.0 * variance))), 0.0)
        shift, turn = least_squares_step(residual, ends.along, weight, (_PRIOR.lateral_sigma, _PRIOR.heading_sigma))
    return side * (residual + shift + ends.along * turn)
