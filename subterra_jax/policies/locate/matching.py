"""The learnt front end: how well the profiles of two beams agree if commands were wrong by each of some fractions.

A point of the wall is first seen ahead and later behind. If the robot drives (1 + e) times the commanded distance, the
two profiles are apart by e times the distance between the two places: many pairs of beams together tell e.
"""

import itertools
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.policies.locate.profiles import BIN, BLOCK, N_BEARINGS, Grid, Profiles, mean_along

# Errors of the command that are compared: those of slip; and of wet rail, which takes a tenth to half of the speed.
FRACTIONS = np.linspace(-0.08, 0.08, 41).astype(np.float32)
WIDE_FRACTIONS = np.concatenate([np.linspace(-0.53, -0.11, 22), FRACTIONS]).astype(np.float32)
LAGS = 13  # bins by which a profile is shifted to either side
_MEAN, _TAPS = 8, 9  # bins to either side of a running mean; bins of the filter
MARGIN = _MEAN + _TAPS // 2  # bins about a block that its evidence depends on, beside the shifts
N_CUT = BLOCK + 2 * (LAGS + MARGIN)  # bins that the evidence of a block needs
_CHANNELS, _EDGES = 8, 4  # features; the first of them are of one sign, as the edges of niches and boxes are
PAIRS = np.array(list(itertools.combinations(range(N_BEARINGS), 2)))  # (ahead, behind)
_UNIT = 0.03  # m: relief that is large against noise
_DEAD = 0.3  # of an edge, in the filter's unit: noise makes lesser ones
_OFF = -6.0  # of a weight before learning: as good as none

Weights = dict[str, Any]
_einsum = partial(jnp.einsum, precision="highest")  # differences of squares: no TF32


def init(key: PRNGKeyArray, compared: Any = FRACTIONS) -> Weights:
    """Returns weights from which learning goes on: edges that beams ahead or behind see sharply, and smoothed relief.

    Among them are the errors that are compared, which are not learnt.

    A niche hides its near edge from beams ahead and its far edge from those behind; a box does so the other way round.
    So the former meet walls that come nearer sharply, and the latter walls that recede.
    """
    taps = 0.1 * jax.random.normal(key, (N_BEARINGS, _TAPS, 3, _CHANNELS + 1)) / np.sqrt(_TAPS)
    recede = _in_middle([-0.25, -0.25, -0.25, 0.0, 0.25, 0.25, 0.25])
    smooth = _in_middle([0.25, 0.5, 0.25])
    for channel, filters in enumerate((-recede, recede)):
        taps = taps.at[:, :, 0, channel].add(filters)
    taps = taps.at[..., _CHANNELS].set(0.0).at[:, :, 2, _CHANNELS].set(-4.0 / _TAPS)
    taps = taps.at[:, :, 0, _EDGES].add(smooth).at[:, :, 0, _EDGES + 1].add(recede)
    middle = N_BEARINGS // 2
    pair = jnp.full((len(PAIRS), _CHANNELS), _OFF + 3.0)
    pair = pair.at[:, 0].set(np.where(PAIRS[:, 1] <= middle, -0.5, _OFF))
    pair = pair.at[:, 1].set(np.where(PAIRS[:, 0] >= middle, -0.5, _OFF))
    pair = pair.at[:, _EDGES].set(-2.0)
    return {
        "taps": taps,
        "bias": jnp.zeros((N_BEARINGS, _CHANNELS + 1)).at[:, _CHANNELS].set(5.0),
        "pair": pair,
        "count": jnp.zeros(()),
        "shares": jnp.asarray(compared),
    }


def _in_middle(taps: list[float]) -> Float[Array, "tap"]:
    """Returns a filter of `_TAPS` bins with an odd number of taps in its middle."""
    return jnp.pad(jnp.array(taps), (_TAPS - len(taps)) // 2)


def fractions(weights: Weights) -> Float[Array, "n_fractions"]:
    """Returns the errors of the command that are compared."""
    return jax.lax.stop_gradient(weights["shares"])


def encode(weights: Weights, profiles: Profiles) -> tuple[Float[Array, "side 7 bins c"], Float[Array, "side 7 bins c"]]:
    """Returns features of the profiles and their weights, 0 to 1; `MARGIN` bins at either end are lost."""
    there = jnp.minimum(profiles.weight, 1.0)
    out = profiles.out / jnp.maximum(profiles.weight, 1e-3)
    n = profiles.weight.shape[-1] - 2 * _MEAN
    sums = [_running(values, n) for values in (there * out, there)]
    relief = out[..., _MEAN : _MEAN + n] - sums[0] / jnp.maximum(sums[1], 1e-3)
    there = there[..., _MEAN : _MEAN + n]
    relief = there * jnp.arcsinh(relief / _UNIT)
    inputs = jnp.stack([relief, 1.0 - there, jnp.abs(relief)], axis=-1)
    m = n - _TAPS + 1
    rows = jnp.stack([inputs[..., k : k + m, :] for k in range(_TAPS)], axis=-2)
    found = _einsum("sbukc,bkcd->sbud", rows, weights["taps"]) + weights["bias"][:, None]
    half = _TAPS // 2
    edges = jnp.maximum(found[..., :_EDGES] - _DEAD, 0.0)
    features = jnp.tanh(jnp.concatenate([edges, found[..., _EDGES:_CHANNELS]], axis=-1))
    there = there[..., half : half + m, None]
    gated = there * jax.nn.sigmoid(found[..., _CHANNELS:])  # relief counts where nothing deep hides the wall
    edge = np.arange(_CHANNELS) < _EDGES
    return features, jnp.where(edge, there, gated)


def _running(values: Grid, n: int) -> Grid:
    """Returns sums over `_MEAN` bins to either side."""
    total = jnp.cumsum(jnp.pad(values, ((0, 0), (0, 0), (1, 0))), axis=-1)
    return total[..., 2 * _MEAN + 1 : 2 * _MEAN + 1 + n] - total[..., :n]


def evidence(weights: Weights, profiles: Profiles) -> Float[Array, "n_fractions"]:
    """Returns the log likelihood, up to a constant, of each of `fractions` by one block.

    Args:
        weights: Trained weights, as `init` makes them.
        profiles: `N_CUT` bins about the block.
    """
    features, there = encode(weights, profiles)
    middle = slice(LAGS + MARGIN, LAGS + MARGIN + BLOCK)
    along = mean_along(jax.tree.map(lambda sums: sums[..., middle], profiles))
    return compare(weights, features, there, along)


def compare(
    weights: Weights,
    features: Float[Array, "side 7 bins c"],
    there: Float[Array, "side 7 bins c"],
    along: Float[Array, "side 7"],
) -> Float[Array, "n_fractions"]:
    """Compares the pairs of beams on either side.

    Args:
        weights: Trained weights, as `init` makes them.
        features: Features of `BLOCK + 2 LAGS` bins about the block.
        there: Weights of the features.
        along: Mean distance ahead at which each beam saw the block, m.
    """
    shifts = range(2 * LAGS + 1)
    seen_ahead = jnp.stack([features[:, :, k : k + BLOCK] for k in shifts], axis=2)
    there_ahead = jnp.stack([there[:, :, k : k + BLOCK] for k in shifts], axis=2)
    behind, there_behind = features[:, :, LAGS : LAGS + BLOCK], there[:, :, LAGS : LAGS + BLOCK]
    overlap = partial(_einsum, "sakuc,sbuc->sabkc")
    ahead_square, behind_square = (
        overlap(there_ahead * seen_ahead**2, there_behind),
        overlap(there_ahead, there_behind * behind**2),
    )
    product, count = overlap(there_ahead * seen_ahead, there_behind * behind), overlap(there_ahead, there_behind)
    a, b = PAIRS[:, 0], PAIRS[:, 1]
    cost = ((ahead_square + behind_square - 2.0 * product) / (count + 1.0))[:, a, b]
    cost = jnp.sum(jax.nn.softplus(weights["pair"])[:, None] * cost, axis=-1)
    apart = (along[:, a] - along[:, b]) / BIN
    error = fractions(weights)
    target = LAGS + jnp.clip(apart[..., None] * error / (1.0 + error), 2.0 - LAGS, LAGS - 2.0)
    curve = _einsum("spek,spk->spe", _cubic(jnp.arange(2 * LAGS + 1) - target[..., None]), cost)
    present = jnp.max(count[..., 0][:, a, b], axis=-1) / BLOCK
    return -jnp.exp(weights["count"]) * _einsum("sp,spe->e", BLOCK * present**2, curve)


def _cubic(x: Array) -> Array:
    """Returns the weights of a cubic convolution at distances in samples. Source: Keys 1981, a = -1/2."""
    x = jnp.abs(x)
    near, far = (1.5 * x - 2.5) * x * x + 1.0, ((-0.5 * x + 2.5) * x - 4.0) * x + 2.0
    return jnp.where(x < 1.0, near, jnp.where(x < 2.0, far, 0.0))
