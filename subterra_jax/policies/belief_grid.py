"""A belief over where a drive began: one cell for each station and direction, so that driving moves no mass.

A robot that began at tape position u and has driven D is at u + D, whatever u is. On the tape of robots that face
falling stations, positions count from the far mouth. Errors of dead reckoning slowly spread mass over neighbour cells.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from subterra_jax.baselines import histogram

FORWARD = np.array([[1.0], [-1.0]], np.float32)


def cell_positions(n_cells: int, cell: float) -> Float[np.ndarray, "n_cells"]:
    """Returns the tape positions of the cells' centres, m."""
    return (cell * (np.arange(n_cells) + 0.5)).astype(np.float32)


def uniform_log_mass(
    tape: Float[Array, "n_cells"], length: Float[Array, ""], margin: Float[Array, ""]
) -> Float[Array, "2 n"]:
    """Returns the log mass of a start anywhere but `margin` (m) from the ends, in either direction."""
    inside = (tape >= margin) & (tape <= length - margin)
    mass = inside / jnp.maximum(2.0 * jnp.sum(inside), 1.0)
    return jnp.log(jnp.broadcast_to(mass, (2, len(tape))) + 1e-12)


def stations(tape: Float[Array, "*n"], driven: Float[Array, ""], length: Float[Array, ""]) -> Float[Array, "2 *n"]:
    """Returns the stations of both tapes' cells after a drive, m."""
    here = tape + driven
    return jnp.stack([here, length - here])


def spread(log_mass: Float[Array, "2 n"], variance: Float[Array, ""], leak: Float[Array, ""]) -> Float[Array, "2 n"]:
    """Spreads a belief over neighbour cells after some driving.

    Args:
        log_mass: Belief before; its mass sums to 1.
        variance: Variance that dead reckoning has added, in squares of a cell, up to 0.5.
        leak: Share of the belief that is given to all cells alike, since anything may be wrong.
    """
    share, mass = 0.5 * jnp.minimum(variance, 0.5), jnp.exp(log_mass)
    wide = jnp.pad(mass, ((0, 0), (1, 1)), mode="edge")
    mass = mass + share * (wide[:, :-2] + wide[:, 2:] - 2.0 * mass)
    return jnp.log((1.0 - leak) * mass + leak / mass.size + 1e-30)


def add_evidence(log_mass: Float[Array, "2 n"], log_likelihood: Float[Array, "2 n"]) -> Float[Array, "2 n"]:
    """Returns the belief after a scan with these log likelihoods; its mass sums to 1."""
    raw = log_mass + log_likelihood
    raw = raw - jnp.max(raw)
    return raw - jnp.log(jnp.sum(jnp.exp(raw)))


def turn_round(
    log_mass: Float[Array, "2 n"], driven: Float[Array, ""], length: Float[Array, ""], cell: float
) -> Float[Array, "2 n"]:
    """Returns the belief of a robot that has turned round on the spot: a new drive begins here, on the other tape."""
    n = log_mass.shape[1]
    # Position p on one tape was length - p on the other, of a drive that began `driven` earlier.
    before = (length - driven) / cell - jnp.arange(n) - 1.0
    low = jnp.floor(before)
    share, first = before - low, low.astype(jnp.int32)
    mass = jnp.exp(log_mass)
    take = lambda index: jnp.where((index >= 0) & (index < n), mass[:, jnp.clip(index, 0, n - 1)], 0.0)  # noqa: E731
    mass = ((1.0 - share) * take(first) + share * take(first + 1))[::-1]
    return jnp.log(mass / jnp.maximum(jnp.sum(mass), 1e-12) + 1e-12)


def summarise(
    log_mass: Float[Array, "2 n"], station: Float[Array, "2 n"], reach: Float[Array, ""], cell: float
) -> histogram.Summary:
    """Finds the heaviest cluster of a belief.

    Args:
        log_mass: The belief; its mass sums to 1.
        station: Stations of the cells, m.
        reach: Half the length of a cluster, m.
        cell: Length of a cell, m.
    """
    return histogram.summarise(jnp.exp(log_mass), station, reach, cell)
