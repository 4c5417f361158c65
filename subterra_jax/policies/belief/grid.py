"""A belief over where an episode began: one cell for each place and way to face, so that driving on moves nothing.

A robot that began at tape position u and has driven D is at u + D, whatever u is; on the tape of those who face falling
stations, positions count from the far mouth. What dead reckoning gets wrong is a slow spreading over neighbour cells.
"""

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

FORWARD = np.array([[1.0], [-1.0]], np.float32)


@struct.dataclass
class Summary:
    """What a belief says.

    Attributes:
        station: Mean station of the heaviest cluster, m.
        sigma: Standard deviation of everything about it, m; who faces the other way counts by station.
        mass: Share of the belief in that cluster.
        direction: 1 where it faces growing stations, else −1.
    """

    station: Float[Array, ""]
    sigma: Float[Array, ""]
    mass: Float[Array, ""]
    direction: Float[Array, ""]


def position(n_cells: int, cell: float) -> Float[np.ndarray, "n_cells"]:
    """Tape positions of the cells' middles, m."""
    return (cell * (np.arange(n_cells) + 0.5)).astype(np.float32)


def evenly(tape: Float[Array, "n_cells"], length: Float[Array, ""], margin: Float[Array, ""]) -> Float[Array, "2 n"]:
    """Log mass of a start anywhere but `margin` (m) from the ends, facing either way."""
    inside = (tape >= margin) & (tape <= length - margin)
    mass = inside / jnp.maximum(2.0 * jnp.sum(inside), 1.0)
    return jnp.log(jnp.broadcast_to(mass, (2, len(tape))) + 1e-12)


def stations(tape: Float[Array, "*n"], driven: Float[Array, ""], length: Float[Array, ""]) -> Float[Array, "2 *n"]:
    """Stations of both tapes' cells after a drive, m."""
    here = tape + driven
    return jnp.stack([here, length - here])


def spread(log_mass: Float[Array, "2 n"], variance: Float[Array, ""], leak: Float[Array, ""]) -> Float[Array, "2 n"]:
    """The belief after some driving.

    Args:
        log_mass: Before; sums to 1.
        variance: Of what dead reckoning has added, in squares of a cell, up to 0.5.
        leak: Share of the belief that is given to all cells alike, since anything may be wrong.
    """
    share, mass = 0.5 * jnp.minimum(variance, 0.5), jnp.exp(log_mass)
    wide = jnp.pad(mass, ((0, 0), (1, 1)), mode="edge")
    mass = mass + share * (wide[:, :-2] + wide[:, 2:] - 2.0 * mass)
    return jnp.log((1.0 - leak) * mass + leak / mass.size + 1e-30)


def weighed(log_mass: Float[Array, "2 n"], gain: Float[Array, "2 n"]) -> Float[Array, "2 n"]:
    """The belief after a scan of such log likelihoods; sums to 1."""
    raw = log_mass + gain
    raw = raw - jnp.max(raw)
    return raw - jnp.log(jnp.sum(jnp.exp(raw)))


def turned_round(
    log_mass: Float[Array, "2 n"], driven: Float[Array, ""], length: Float[Array, ""], cell: float
) -> Float[Array, "2 n"]:
    """The belief of a robot that has turned round where it stood: a new drive begins here, on the other tape."""
    n = log_mass.shape[1]
    # Who is now at p on one tape was at length - p on the other, having begun a drive earlier.
    before = (length - driven) / cell - jnp.arange(n) - 1.0
    low = jnp.floor(before)
    share, first = before - low, low.astype(jnp.int32)
    mass = jnp.exp(log_mass)
    take = lambda index: jnp.where((index >= 0) & (index < n), mass[:, jnp.clip(index, 0, n - 1)], 0.0)  # noqa: E731
    mass = ((1.0 - share) * take(first) + share * take(first + 1))[::-1]
    return jnp.log(mass / jnp.maximum(jnp.sum(mass), 1e-12) + 1e-12)


def summary(
    log_mass: Float[Array, "2 n"], station: Float[Array, "2 n"], reach: Float[Array, ""], cell: float
) -> Summary:
    """What the belief says.

    Args:
        log_mass: The belief; sums to 1.
        station: Of the cells, m.
        reach: Half the length of a cluster, m.
        cell: Length of a cell, m.
    """
    mass = jnp.exp(log_mass)
    near = _near(mass, jnp.maximum(jnp.round(reach / cell), 1.0).astype(jnp.int32))
    # Of the many cells about a narrow peak that have it all within reach, the peak itself.
    best = jnp.argmax(near + 0.01 * mass)
    way, at = best // mass.shape[1], best % mass.shape[1]
    inside: Bool[Array, "2 n"] = jnp.abs(station - station[way, at]) <= reach + 0.5 * cell
    chosen = mass * inside * (jnp.arange(2)[:, None] == way)
    share = jnp.maximum(jnp.sum(chosen), 1e-12)
    middle = jnp.sum(chosen * station) / share
    sigma = jnp.sqrt(jnp.sum(mass * (station - middle) ** 2))
    return Summary(middle, sigma, share, 1.0 - 2.0 * way)


def _near(mass: Float[Array, "2 n"], reach: Array) -> Float[Array, "2 n"]:
    """Mass within so many cells of each."""
    n = mass.shape[1]
    total = jnp.concatenate([jnp.zeros((2, 1)), jnp.cumsum(mass, axis=1)], axis=1)
    index = jnp.arange(n)
    return total[:, jnp.minimum(index + reach + 1, n)] - total[:, jnp.maximum(index - reach, 0)]
