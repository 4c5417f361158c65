"""Errors of a LiDAR's ranges: noise by range and incidence, lost returns, mixed pixels; reflectivity by material."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax import constants as c

STEEPEST = 10.0  # tangent of the incidence angle beyond which the noise grows no more
FADING = 0.5  # standard deviation of the logarithm of an echo (speckle)
EDGE_STEP = 0.03  # m between two surfaces from which on they make an edge
PULSE = 0.75  # m: echoes further apart in range are distinguished by the receiver; half a pulse of 5 ns
LEVEL = 0.8  # least upward part of a floor's normal
# Diffuse reflectivity near 905 nm: concrete lining, floor, things of the track and furniture. Engineering judgement.
ALBEDO_LINING, ALBEDO_FLOOR, ALBEDO_THING = 0.30, 0.20, 0.36


@struct.dataclass
class EchoParams:
    """Errors of one model of LiDAR. Source of the noise: facts/geode.md has 2 cm for the Avia; the fractions are ours.

    Attributes:
        sigma: Standard deviation of a range met squarely and near, m.
        sigma_per_metre: Standard deviation that each metre of range adds in quadrature, m/m.
        sigma_slant: Standard deviation added in quadrature for each unit of the tangent of incidence, up to 10, m.
        lost: Fraction of returns that are lost for no other reason.
        weakest: Weakest echo that is detected: reflectivity · cosine of incidence / distance², 1/m².
        mixed: Fraction of the beams across a depth edge whose return falls between its two surfaces.
        divergence: Half the opening angle of a beam, rad.
        losing: Lose returns, by `lost` and `weakest`.
        mixing: Mix pixels, at the price of a second ray for each beam.
    """

    sigma: Float[Array, ""] | float = c.SPATIAL_SIGMA
    sigma_per_metre: Float[Array, ""] | float = c.SPATIAL_SIGMA_PER_METRE
    sigma_slant: Float[Array, ""] | float = c.SPATIAL_SIGMA_SLANT
    lost: Float[Array, ""] | float = c.SPATIAL_LOST
    weakest: Float[Array, ""] | float = 0.0
    mixed: Float[Array, ""] | float = c.SPATIAL_MIXED
    divergence: Float[Array, ""] | float = 1.5e-3
    losing: bool = struct.field(pytree_node=False, default=True)
    mixing: bool = struct.field(pytree_node=False, default=False)

    @property
    def n_uniform(self) -> int:
        """Uniform numbers of a beam."""
        return self.losing + 3 * self.mixing


def add_noise(
    ranges: Float[Array, "n"], cosine: Float[Array, "n"], normal: Float[Array, "n"], params: EchoParams
) -> Float[Array, "n"]:
    """Return ranges with noise, m, of true ranges and cosines of incidence, 0 to 1."""
    slant = jnp.clip(cosine, 1e-3, 1.0)
    tangent = jnp.minimum(jnp.sqrt(1.0 - slant * slant) / slant, STEEPEST)
    variance = params.sigma**2 + (params.sigma_per_metre * ranges) ** 2 + (params.sigma_slant * tangent) ** 2
    return ranges + jnp.sqrt(variance) * normal


def albedo(normal_z: Float[Array, "n"], thing: Bool[Array, "n"], below: Bool[Array, "n"]) -> Float[Array, "n"]:
    """Return the reflectivity of what is met: a thing, the floor (level and below the sensor), else the lining."""
    floor = (jnp.abs(normal_z) > LEVEL) & below
    return jnp.where(thing, ALBEDO_THING, jnp.where(floor, ALBEDO_FLOOR, ALBEDO_LINING))


def returns(
    ranges: Float[Array, "n"],
    cosine: Float[Array, "n"],
    reflectivity: Float[Array, "n"],
    uniform: Float[Array, "n"],
    params: EchoParams,
) -> Bool[Array, "n"]:
    """Draw which pulses come back: echoes above the weakest one, faded by a log-normal factor, less those lost."""
    echo = reflectivity * jnp.maximum(cosine, 1e-6) / jnp.maximum(ranges * ranges, 1e-6)
    weakest = jnp.maximum(params.weakest, 1e-12)
    fraction = jax.scipy.special.ndtr(jnp.log(echo / weakest) / FADING)
    return uniform < fraction * (1.0 - params.lost)


def rim_of(directions: Float[Array, "n 3"], uniform: Float[Array, "n"], params: EchoParams) -> Float[Array, "n 3"]:
    """Return rays on the rims of beams, to drawn sides; unit vectors."""
    # Two vectors across a beam; the lesser of its parts along x and z is far from 1.
    x, y, z = directions[:, 0], directions[:, 1], directions[:, 2]
    steep = jnp.abs(z) > 0.7
    a = jnp.where(steep, jnp.stack([jnp.zeros_like(x), z, -y]), jnp.stack([-y, x, jnp.zeros_like(x)]))
    a = a / jnp.sqrt(jnp.sum(a * a, axis=0))
    b = jnp.stack([y * a[2] - z * a[1], z * a[0] - x * a[2], x * a[1] - y * a[0]])
    angle = 2.0 * jnp.pi * uniform
    side = (jnp.cos(angle) * a + jnp.sin(angle) * b).T
    return jnp.cos(params.divergence) * directions + jnp.sin(params.divergence) * side


def mix(
    ranges: Float[Array, "n"],
    other: Float[Array, "n"],
    off_plane: Float[Array, "n"],
    uniform: Float[Array, "n 2"],
    params: EchoParams,
) -> Float[Array, "n"]:
    """Return ranges in which some beams across a depth edge fall between its two surfaces, m.

    Args:
        ranges: Ranges of the middles of the beams, m.
        other: Ranges of rays on their rims, m.
        off_plane: Distance of the rim's end from the plane that the middle meets, m.
        uniform: Uniform numbers: which beams, and where between.
    """
    step = other - ranges
    edge = (jnp.abs(step) < PULSE) & (jnp.abs(off_plane) > EDGE_STEP) & (uniform[:, 0] < params.mixed)
    return jnp.where(edge, ranges + step * uniform[:, 1], ranges)
