"""A differentiable Kalman filter over metres: true less commanded distance, slip, and the odometer's error.

The filter stands `DELAY` metres behind the robot, where the evidence is complete; from there each answer is predicted
by the odometer. Sizes of the errors are learnt. Evidence over a range of shares is taken in as the normal
distribution that has, with the filter's own, the right mean and variance. In its place a network may measure the error
of the command itself, with a variance of its own.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.policies.locate.blocks import DELAY, Block, Estimate
from subterra_jax.policies.locate.matching import SHARES

Weights = dict[str, Any]
Measure = Callable[[Array, Array], tuple[Array, Array]]  # mean and variance before to value and variance of what is new
_S, _GAIN, _SLIP, _BIAS, _SCALE = range(5)
_SLIPS = np.array([0.0, 1.0, 1.0, 0.0, 0.0], np.float32)
_READS = np.array([0.0, 1.0, 1.0, 1.0, 1.0], np.float32)
_LENGTH = 30.0  # m over which wandering errors are thought to change, before learning
_TO_MEAN_ABSOLUTE = float(np.sqrt(2.0 / np.pi))


@struct.dataclass
class Filter:
    """Memory of the filter.

    Attributes:
        mean: Correction (m), constant and wandering slip, constant and wandering error of the odometer.
        cov: Its covariance.
        reads: `Block.read` of the last metres, newest last, m.
        steps: `Block.steps` of them.
        age: Metres so far.
    """

    mean: Float[Array, "5"]
    cov: Float[Array, "5 5"]
    reads: Float[Array, "delay"]
    steps: Float[Array, "delay"]
    age: Float[Array, ""]


def init(key: PRNGKeyArray) -> Weights:
    """Returns the sizes before learning: 2 % each, 1 cm of noise a step."""
    del key
    return {
        "log_sizes": jnp.log(jnp.array([0.02, 0.02, 0.02, 0.01])),  # gain, slip, bias, scale
        "log_lengths": jnp.log(jnp.array([_LENGTH, _LENGTH])),
        "log_noise": jnp.log(jnp.array(0.01)),
        "log_scale": jnp.zeros(()),
    }


def start(weights: Weights) -> Filter:
    """Returns the filter at the start, where the correction is 0."""
    variance = jnp.concatenate([jnp.full(1, 1e-4), jnp.exp(2.0 * weights["log_sizes"])])
    return Filter(jnp.zeros(5), jnp.diag(variance), jnp.zeros(DELAY), jnp.zeros(DELAY), jnp.zeros(()))


def step(weights: Weights, now: Filter, block: Block, measured: Any = None) -> tuple[Filter, Estimate]:
    """Takes in one metre, and answers; `measured` as for `advance`."""
    after = advance(weights, now, block, measured)
    return after, answer(weights, after)


def advance(weights: Weights, now: Filter, block: Block, measured: Any = None) -> Filter:
    """Takes in one metre.

    Args:
        weights: Trained weights, as `init` makes them.
        now: The filter.
        block: The metre.
        measured: Error of the command `DELAY` metres ago, m per m, and its variance; None: by the block's evidence.
    """
    full = now.age >= DELAY

    def measure(mean: Array, variance: Array) -> tuple[Array, Array]:
        return _as_normal(block.evidence, mean, variance) if measured is None else measured

    behind = _metre(weights, (now.mean, now.cov), now.reads[0], now.steps[0], measure)
    mean, cov = jax.tree.map(lambda new, old: jnp.where(full, new, old), behind, (now.mean, now.cov))
    reads = jnp.concatenate([now.reads[1:], block.read[None]])
    steps = jnp.concatenate([now.steps[1:], block.steps[None]])
    return Filter(mean, cov, reads, steps, now.age + 1.0)


def answer(weights: Weights, now: Filter) -> Estimate:
    """Predicts the filter from where it stands to where the robot is, by the odometer alone."""

    def ahead(state: tuple[Array, Array], metre: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], None]:
        index, read, steps = metre
        moved = _metre(weights, state, read, steps, None)
        there = index >= DELAY - now.age
        return jax.tree.map(lambda new, old: jnp.where(there, new, old), moved, state), None

    (mean, cov), _ = jax.lax.scan(ahead, (now.mean, now.cov), (jnp.arange(DELAY), now.reads, now.steps))
    sigma = jnp.sqrt(jnp.maximum(cov[_S, _S], 1e-4))
    log_scale = jnp.log(_TO_MEAN_ABSOLUTE * sigma) + weights["log_scale"]
    return Estimate(mean[_S], mean[_GAIN] + mean[_SLIP], log_scale)


def sequence(weights: Weights, blocks: Block, measured: Any = None) -> Estimate:
    """Returns the answers to all metres of a drive; all predictions at once, which a GPU likes better."""

    def one(now: Filter, row: Any) -> tuple[Filter, Filter]:
        after = advance(weights, now, *row)
        return after, after

    _, filters = jax.lax.scan(one, start(weights), (blocks, measured))
    return jax.vmap(lambda now: answer(weights, now))(filters)


def _metre(
    weights: Weights, state: tuple[Array, Array], read: Array, steps: Array, measure: Measure | None
) -> tuple[Array, Array]:
    """Takes the filter a metre on, by the odometer and, where there is any, by what the walls tell."""
    mean, cov = state
    noise = jnp.maximum(steps, 1.0) * jnp.exp(2.0 * weights["log_noise"])
    mean, cov = _correct(mean, cov, _READS, read, noise)
    if measure is not None:
        value, variance = measure(_dot(_SLIPS, mean), _dot(_SLIPS, _apply(cov, _SLIPS)))
        mean, cov = _correct(mean, cov, _SLIPS, value, variance)
    mean = mean.at[_S].add(_dot(_SLIPS, mean))
    rows = cov.at[_S].add(_apply(cov, _SLIPS))
    cov = rows.at[:, _S].add(_apply(rows, _SLIPS))
    sizes, keep = jnp.exp(2.0 * weights["log_sizes"]), jnp.exp(-jnp.exp(-weights["log_lengths"]))
    factor = jnp.ones(5).at[_SLIP].set(keep[0]).at[_SCALE].set(keep[1])
    added = jnp.zeros(5).at[_SLIP].set((1.0 - keep[0] ** 2) * sizes[1]).at[_SCALE].set((1.0 - keep[1] ** 2) * sizes[3])
    return factor * mean, cov * factor[:, None] * factor + jnp.diag(added)


def _correct(mean: Array, cov: Array, row: Any, value: Array, noise: Array) -> tuple[Array, Array]:
    """Takes in a measurement of `row · state`."""
    spread = _apply(cov, row)
    gain = spread / (_dot(row, spread) + noise)
    return mean + gain * (value - _dot(row, mean)), cov - gain[:, None] * spread


def _moments(belief: Array) -> tuple[Array, Array]:
    shares = jnp.asarray(SHARES)
    mean = _dot(belief, shares)
    return mean, _dot(belief, (shares - mean) ** 2) + 1e-9


# Written out: a matrix product may round to TF32 on a GPU.
def _dot(a: Any, b: Any) -> Array:
    return jnp.sum(a * b)


def _apply(matrix: Array, vector: Any) -> Array:
    return jnp.sum(matrix * vector, axis=1)


def _as_normal(evidence: Array, prior_mean: Array, prior_variance: Array) -> tuple[Array, Array]:
    """Returns value and variance of a normal measurement that does to the prior what the evidence does."""
    shares = jnp.asarray(SHARES)
    prior = -0.5 * (shares - prior_mean) ** 2 / prior_variance
    belief = jax.nn.softmax(prior + evidence)
    own = jax.nn.softmax(prior)  # of the prior on the same grid, whose ends cut it off
    (mean, variance), (mean_own, variance_own) = _moments(belief), _moments(own)
    precision = jnp.maximum(1.0 / variance - 1.0 / variance_own, 0.01)
    value = mean + (mean - mean_own) / (variance_own * precision)
    return jnp.clip(value, -0.3, 0.3), 1.0 / precision
