"""A cloud of particles along a tunnel: how it moves, how it is weighed and thinned."""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.baselines.particle.likelihood import fit
from subterra_jax.baselines.particle.scan import Place, ScanModel
from subterra_jax.baselines.particle.wallmap import WallMap
from subterra_jax.parts.wander import WanderParams, advance_wander

_POWERS = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03)  # of a likelihood that may be flattened


@struct.dataclass
class CloudParams:
    """How a cloud moves and is thinned.

    Attributes:
        scale_sigma: Standard deviation of the relative error of dead reckoning that lasts an episode, 1.
        wander: The relative error that changes along the way.
        step_sigma: Standard deviation of the noise of one step of dead reckoning, m.
        slip_rate: Rate at which a particle takes the rail for wet, or for dry again, 1/m; 0 is never.
        slip_loss: Share of the speed that wet rail costs, 1.
        ess_share: The cloud is resampled when its effective size falls below this share.
        least_share: A scan may bring the effective size down to this share and no further: a likelihood that would is
            flattened first, so that a sparse cloud is not thinned to a chance few.
        roughening: Standard deviation of the noise on the lasting scale error of a resampled particle, 1.
        jitter: Of the noise on its station, in lengths of the cloud over its particles.
        cluster: Half the length of what counts as one cluster, m: half the shortest distance at which a wall repeats.
    """

    scale_sigma: float | Float[Array, ""]
    wander: WanderParams
    step_sigma: float | Float[Array, ""] = 0.01
    slip_rate: float | Float[Array, ""] = 0.0
    slip_loss: float | Float[Array, ""] = 0.3
    ess_share: float = 0.5
    least_share: float = 0.5
    roughening: float = 0.0005
    jitter: float = 0.2
    cluster: float = 0.6


@struct.dataclass
class Cloud:
    """Particles.

    Attributes:
        place: Where each is.
        scale: Relative error of dead reckoning that lasts, 1.
        wander: Relative error that changes, 1.
        wet: 1 where the particle takes the rail for wet, else 0.
        log_weight: Log of the weight; sums to 1 after `weighed`.
    """

    place: Place
    scale: Float[Array, "n"]
    wander: Float[Array, "n"]
    wet: Float[Array, "n"]
    log_weight: Float[Array, "n"]


def new_cloud(key: PRNGKeyArray, place: Place, params: CloudParams) -> Cloud:
    """Particles at given places, `(n,)`, with scale errors drawn and equal weights."""
    n = place.station.shape[0]
    normal = jax.random.normal(key, (2, n))
    return Cloud(
        place=place,
        scale=params.scale_sigma * normal[0],
        wander=params.wander.sigma * normal[1],
        wet=jnp.zeros(n),
        log_weight=jnp.full(n, -jnp.log(float(n))),
    )


def moved(
    key: PRNGKeyArray,
    cloud: Cloud,
    walls: WallMap,
    travelled: Float[Array, ""],
    turned: Float[Array, ""],
    params: CloudParams,
) -> Cloud:
    """The cloud after a step.

    Args:
        key: Source of the noise.
        cloud: The cloud before.
        walls: The map, for the curvature.
        travelled: Dead-reckoned distance, m.
        turned: Dead-reckoned turn, rad; NaN is not known, and taken for that of the axis.
        params: How it moves.
    """
    n = cloud.scale.shape[0]
    normal = jax.random.normal(key, (2, n))
    flips = jax.random.uniform(jax.random.fold_in(key, 1), (n,)) < params.slip_rate * jnp.abs(travelled)
    wet = jnp.where(flips, 1.0 - cloud.wet, cloud.wet)
    grip = 1.0 - params.slip_loss * wet
    distance = travelled * (1.0 + cloud.scale + cloud.wander) * grip + params.step_sigma * normal[0]
    place = cloud.place
    curvature = walls.curvature(place.station)[2]
    turned = jnp.where(jnp.isnan(turned), curvature * distance, turned)
    middle = place.heading + 0.5 * turned
    along = distance * jnp.cos(middle) / (1.0 - curvature * place.lateral)
    after = Place(
        station=place.station + along,
        lateral=place.lateral + distance * jnp.sin(middle),
        heading=place.heading + turned - curvature * along,
    )
    wander = jax.vmap(advance_wander, (0, None, 0, None))(cloud.wander, travelled, normal[1], params.wander)
    return dataclasses.replace(cloud, place=after, wander=wander, wet=wet)


def weighed(
    cloud: Cloud,
    walls: WallMap,
    ranges: Float[Array, "n_beams"],
    range_max: Float[Array, ""],
    model: ScanModel,
    params: CloudParams,
) -> Cloud:
    """The cloud after a scan: weights multiplied by its likelihood, offsets and headings adjusted to it."""
    gain, place = fit(walls, cloud.place, ranges, range_max, model)
    options = _normalised(cloud.log_weight + jnp.asarray(_POWERS)[:, None] * gain)
    enough = _effective(options) >= params.least_share * gain.shape[0]
    # The largest power that leaves enough particles; the least one where none does.
    chosen = jnp.where(jnp.any(enough), jnp.argmax(enough), len(_POWERS) - 1)
    return dataclasses.replace(cloud, place=place, log_weight=options[chosen])


def _normalised(log_weight: Float[Array, "*m n"]) -> Float[Array, "*m n"]:
    return log_weight - jax.scipy.special.logsumexp(log_weight, axis=-1, keepdims=True)


def _effective(log_weight: Float[Array, "*m n"]) -> Float[Array, "*m"]:
    """Effective number of particles."""
    return 1.0 / jnp.sum(jnp.exp(2.0 * log_weight), axis=-1)


def resampled(key: PRNGKeyArray, cloud: Cloud, params: CloudParams) -> Cloud:
    """The cloud, drawn anew by its weights where too few particles carry them; systematic, in order.

    Source: Arulampalam et al. 2002, A tutorial on particle filters for online nonlinear/non-Gaussian Bayesian tracking;
    the jitter, Gordon et al. 1993, Novel approach to nonlinear/non-Gaussian Bayesian state estimation.
    """
    n = cloud.scale.shape[0]
    weight = jnp.exp(cloud.log_weight)
    due = _effective(cloud.log_weight) < params.ess_share * n
    offset_key, rough_key = jax.random.split(key)
    total = jnp.cumsum(weight)
    point = (jnp.arange(n) + jax.random.uniform(offset_key)) / n * total[-1]
    drawn = jnp.clip(jnp.searchsorted(total, point), 0, n - 1)
    parent = jnp.where(due, drawn, jnp.arange(n))
    heirs = jax.tree.map(lambda leaf: leaf[parent], cloud)
    normal = jnp.where(due, jax.random.normal(rough_key, (2, n)), 0.0)
    length = jnp.max(heirs.place.station) - jnp.min(heirs.place.station)
    place = dataclasses.replace(heirs.place, station=heirs.place.station + params.jitter * length / n * normal[0])
    log_weight = jnp.where(due, -jnp.log(float(n)), cloud.log_weight)
    return dataclasses.replace(
        heirs, place=place, scale=heirs.scale + params.roughening * normal[1], log_weight=log_weight
    )
