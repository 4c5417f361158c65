"""Scores of an estimate of the station, as running sums: CRPS, NEES, time to lock, cycle slips."""

import jax.numpy as jnp
from flax import struct
from jax.scipy.stats import norm
from jaxtyping import Array, Bool, Float, Int

_SLIPPED = 0.75  # of a ring: the nearest ring must be left for good before that counts


@struct.dataclass
class EstimateTally:
    """Running sums over the steps of an episode.

    Attributes:
        error: Last error, estimate less truth, m.
        square: Sum of squared errors, m².
        crps: Sum of the continuous ranked probability scores, m.
        nees: Sum of squared errors over claimed variances, 1.
        unlocked: Last step after which the error was beyond the tolerance; 0 where it never was.
        ring: By how many rings the estimate is off.
        slips: Rings by which that has changed since the first estimate.
    """

    error: Float[Array, ""]
    square: Float[Array, ""]
    crps: Float[Array, ""]
    nees: Float[Array, ""]
    unlocked: Int[Array, ""]
    ring: Float[Array, ""]
    slips: Float[Array, ""]


def start_estimates() -> EstimateTally:
    """Nothing estimated yet."""
    zero = jnp.zeros(())
    return EstimateTally(zero, zero, zero, zero, jnp.zeros((), jnp.int32), zero, zero)


def add_estimate(
    tally: EstimateTally,
    error: Float[Array, ""],
    log_sigma: Float[Array, ""],
    step: Int[Array, ""],
    tolerance: Float[Array, ""],
    ring_pitch: Float[Array, ""],
) -> EstimateTally:
    """One step more.

    Args:
        tally: So far.
        error: Estimate less truth, m; NaN makes every sum NaN, which is what no estimate scores.
        log_sigma: Log of the claimed standard deviation in m.
        step: Number of the step, from 1.
        tolerance: Error up to which the estimate counts as locked, m.
        ring_pitch: Distance between rings, m; 0 where there are none: no slips then.
    """
    sigma = jnp.exp(log_sigma)
    off = jnp.where(ring_pitch > 0.0, error / jnp.maximum(ring_pitch, 1e-6), 0.0)
    off = jnp.where(jnp.isnan(off), 0.0, off)
    first: Bool[Array, ""] = step == 1
    ring = jnp.where(first | (jnp.abs(off - tally.ring) > _SLIPPED), jnp.round(off), tally.ring)
    return EstimateTally(
        error=error,
        square=tally.square + error * error,
        crps=tally.crps + crps(error, sigma),
        nees=tally.nees + (error / sigma) ** 2,
        unlocked=jnp.where(jnp.abs(error) <= tolerance, tally.unlocked, step),
        ring=ring,
        slips=tally.slips + jnp.where(first, 0.0, jnp.abs(ring - tally.ring)),
    )


def crps(error: Float[Array, ""], sigma: Float[Array, ""]) -> Float[Array, ""]:
    """Continuous ranked probability score of a normal distribution, m.

    Args:
        error: Its mean less the truth, m.
        sigma: Its standard deviation, m.

    Source: Gneiting and Raftery 2007, Strictly Proper Scoring Rules, eq. 21.
    """
    z = error / sigma
    return sigma * (z * (2.0 * norm.cdf(z) - 1.0) + 2.0 * norm.pdf(z) - 1.0 / jnp.sqrt(jnp.pi))
