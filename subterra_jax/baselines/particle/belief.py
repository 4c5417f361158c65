"""What a cloud of particles says: where its heaviest cluster is, and how far the others are from it."""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.baselines.particle.cloud import Cloud, CloudParams

_ASKED = 32  # particles asked whether they are the middle of the heaviest cluster


@struct.dataclass
class Belief:
    """What a cloud says.

    Attributes:
        station: Mean station of the heaviest cluster, m.
        sigma: Standard deviation of all particles about it, m.
        share: Weight of that cluster.
        lateral: Lateral offset of the cluster, m.
        heading: Its heading against the tangent of growing station, rad, in [-π, π].
    """

    station: Float[Array, ""]
    sigma: Float[Array, ""]
    share: Float[Array, ""]
    lateral: Float[Array, ""]
    heading: Float[Array, ""]


def believed(cloud: Cloud, params: CloudParams) -> Belief:
    """What the cloud says."""
    weight, station = jnp.exp(cloud.log_weight), cloud.place.station
    # Clusters that face opposite ways lie apart, however near their stations are.
    cos, sin = jnp.cos(cloud.place.heading), jnp.sin(cloud.place.heading)
    stride = max(1, station.shape[0] // _ASKED)
    first = slice(stride // 2, None, stride)
    near = jnp.abs(station - station[first, None]) < params.cluster
    near &= cos * cos[first, None] > 0.0
    mass = jnp.sum(jnp.where(near, weight, 0.0), axis=1)
    best = jnp.argmax(mass)
    inside = jnp.where(near[best], weight, 0.0)
    share = jnp.maximum(mass[best], 1e-12)
    of_cluster = lambda value: jnp.sum(inside * value) / share  # noqa: E731
    middle = of_cluster(station)
    return Belief(
        station=middle,
        sigma=jnp.sqrt(jnp.sum(weight * (station - middle) ** 2)),
        share=share,
        lateral=of_cluster(cloud.place.lateral),
        heading=jnp.arctan2(of_cluster(sin), of_cluster(cos)),
    )
