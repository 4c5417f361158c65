"""Where the beams of a scan end, along a tunnel and across it, seen from many places at once."""

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.baselines.particle.wallmap import WallMap
from subterra_jax.lidar import bearings

_SIDEWAYS = 0.3  # sine from which on a beam looks at a wall, not along it


@struct.dataclass
class ScanModel:
    """What is believed about the LiDAR.

    Attributes:
        range_sigma: Standard deviation of a range, m.
        map_sigma: Standard deviation of the mapped walls, m, for a beam square to them; a slanting one sees more of
            what the map leaves out, such as the far end of a pocket in place of its back.
        outlier_share: Share of the beams that meet something that is not in the map: dust, a box.
        outlier_density: Density of the residuals of such beams, 1/m.
        miss_share: Share of the beams that get no echo from a near wall.
        reach: Longer beams are left alone, m: they graze the wall. It is the same beams for every place, or places
            would be compared by how many beams they leave out.
        lateral_sigma: Standard deviation of the lateral offset after one step of dead reckoning, m.
        heading_sigma: Standard deviation of the heading after one step, rad.
        power: Exponent of the likelihood; below 1 it allows for errors that beams and scans have in common.
    """

    range_sigma: float | Float[Array, ""] = 0.05
    map_sigma: float = 0.01
    outlier_share: float = 0.05
    outlier_density: float = 0.1
    miss_share: float = 0.02
    reach: float = 9.0
    lateral_sigma: float = 0.01
    heading_sigma: float = 0.003
    power: float = 0.5


@struct.dataclass
class Place:
    """A place in a tunnel.

    Attributes:
        station: Station, m.
        lateral: Distance to the left of the centreline, m.
        heading: Heading against the tangent of growing station, rad; any number of turns.
    """

    station: Float[Array, "*n"]
    lateral: Float[Array, "*n"]
    heading: Float[Array, "*n"]


@struct.dataclass
class Endpoints:
    """Where the beams of a scan end.

    Attributes:
        along: Distance ahead of the LiDAR along the tangent at its station, m.
        station: Station, m.
        lateral: Distance to the left of the centreline, m.
        sigma: Standard deviation of `lateral` against the map, m, but for the map's own spread.
        useful: Whether the beam met something near, and counts.
        missed: Whether a beam that should meet a near wall got no echo; it is taken to the usual distance of a wall.
    """

    along: Float[Array, "n_beams *n"]
    station: Float[Array, "n_beams *n"]
    lateral: Float[Array, "n_beams *n"]
    sigma: Float[Array, "n_beams *n"]
    useful: Bool[Array, "n_beams *n"]
    missed: Bool[Array, "n_beams *n"]


def endpoints(
    walls: WallMap, place: Place, ranges: Float[Array, "n_beams"], range_max: Float[Array, ""], model: ScanModel
) -> Endpoints:
    """Endpoints of a scan taken from each of several places, on the circle that the centreline is to either side.

    Args:
        walls: The map of one tunnel.
        place: The places; every field `(*n,)`.
        ranges: The scan, m; beam 0 straight ahead, the others counter-clockwise.
        range_max: The range of a beam without an echo, m.
        model: What is believed about the LiDAR.

    Returns:
        The endpoints. With the centreline's real shape in place of a circle they would move by less than 1 cm where
        the curvature changes by 1e-4 1/m².
    """
    bearing = bearings(ranges.shape[0])
    shape = (-1, *[1] * place.station.ndim)
    cos_beam, sin_beam = (jnp.asarray(np.float32(f(bearing))).reshape(shape) for f in (np.cos, np.sin))
    cos, sin = jnp.cos(place.heading), jnp.sin(place.heading)
    slant = sin * cos_beam + cos * sin_beam
    silent = (ranges >= range_max).reshape(shape)
    missed = silent & (jnp.abs(slant) > _SIDEWAYS)
    far = jnp.where(missed, walls.half_width / jnp.maximum(jnp.abs(slant), _SIDEWAYS), ranges.reshape(shape))
    x, y = far * (cos * cos_beam - sin * sin_beam), place.lateral + far * slant
    ahead, behind, _ = walls.curvature(place.station)
    bend = jnp.where(x > 0.0, ahead, behind)
    across, turned = 1.0 - bend * y, bend * x
    root = jnp.sqrt(across * across + turned * turned)
    lateral = (2.0 * y - bend * (y * y + x * x)) / (1.0 + root)
    ratio = turned / across
    square = ratio * ratio
    station = place.station + x / across * (1.0 - square * (1.0 / 3.0 - square / 5.0))
    useful = jnp.broadcast_to(~silent & (far < model.reach), x.shape)
    square_slant = jnp.maximum(slant * slant, _SIDEWAYS**2)
    sigma = jnp.sqrt(model.range_sigma**2 * square_slant + model.map_sigma**2 / square_slant)
    return Endpoints(x, station, lateral, sigma, useful, missed)
