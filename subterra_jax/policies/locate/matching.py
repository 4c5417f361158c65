"""The learnt front end: how well the profiles of two beams agree if commands were wrong by each of some shares.

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

N_SHARES = 41
SHARES = np.linspace(-0.08, 0.08, N_SHARES).astype(np.float32)  # errors of the command that are compared
LAGS = 13  # bins by which a profile is shifted to either side
_MEAN, _TAPS = 8, 9  # bins to either side of a running mean; bins of the filter
MARGIN = _MEAN + _TAPS // 2  # bins about a block that its evidence depends on, beside the shifts
N_CUT = BLOCK + 2 * (LAGS + MARGIN)  # bins that the evidence of a block needs
_CHANNELS = 6
PAIRS = np.array(list(itertools.combinations(range(N_BEARINGS), 2)))  # (ahead, behind)
_UNIT = 0.03  # m: relief that is large against noise

Weights = dict[str, Any]
_einsum = partial(jnp.einsum, precision="highest")  # differences of squares: no TF32


def init(key: PRNGKeyArray) -> Weights:
    """Returns weights that compare the profiles themselves, high-passed and smoothed; learning improves on them."""
    taps = 0.15 * jax.random.normal(key, (N_BEARINGS, _TAPS, 2, _CHANNELS)) / np.sqrt(_TAPS)
    smooth = jnp.array([0.0, 0.0, 0.0, 0.25, 0.5, 0.25, 0.0, 0.0, 0.0])
    slope = jnp.array([0.0, 0.0, -0.25, -0.25, 0.0, 0.25, 0.25, 0.0, 0.0])
    taps = taps.at[:, :, 0, 0].add(smooth).at[:, :, 0, 1].add(slope)
    return {
        "taps": taps,
        "bias": jnp.zeros((N_BEARINGS, _CHANNELS)),
        "gain": jnp.zeros((_CHANNELS,)).at[2:].set(-1.5),
        "pair": jnp.full(len(PAIRS), -2.5),
        "count": jnp.zeros(()),
    }


def encode(weights: Weights, profiles: Profiles) -> tuple[Float[Array, "2 7 bins c"], Grid]:
    """Returns features of the profiles and the weight of each bin, 0 to 1; `MARGIN` bins at either end are lost."""
    there = jnp.minimum(profiles.weight, 1.0)
    out = profiles.out / jnp.maximum(profiles.weight, 1e-3)
    n = profiles.weight.shape[-1] - 2 * _MEAN
    sums = [_running(values, n) for values in (there * out, there)]
    relief = out[..., _MEAN : _MEAN + n] - sums[0] / jnp.maximum(sums[1], 1e-3)
    there = there[..., _MEAN : _MEAN + n]
    inputs = jnp.stack([there * jnp.arcsinh(relief / _UNIT), 1.0 - there], axis=-1)
    m = n - _TAPS + 1
    rows = jnp.stack([inputs[..., k : k + m, :] for k in range(_TAPS)], axis=-2)
    found = _einsum("sbukc,bkcd->sbud", rows, weights["taps"]) + weights["bias"][:, None]
    half = _TAPS // 2
    return jnp.exp(weights["gain"]) * jnp.tanh(found), there[..., half : half + m]


def _running(values: Grid, n: int) -> Grid:
    """Returns sums over `_MEAN` bins to either side."""
    total = jnp.cumsum(jnp.pad(values, ((0, 0), (0, 0), (1, 0))), axis=-1)
    return total[..., 2 * _MEAN + 1 : 2 * _MEAN + 1 + n] - total[..., :n]


def evidence(weights: Weights, profiles: Profiles) -> Float[Array, "n_shares"]:
    """Returns the log likelihood, up to a constant, of each of `SHARES` by one block.

    Args:
        weights: Of `init`, trained.
        profiles: `N_CUT` bins about the block.
    """
    features, there = encode(weights, profiles)
    middle = slice(LAGS + MARGIN, LAGS + MARGIN + BLOCK)
    along = mean_along(jax.tree.map(lambda sums: sums[..., middle], profiles))
    return compare(weights, features, there, along)


def compare(
    weights: Weights, features: Float[Array, "2 7 bins c"], there: Grid, along: Float[Array, "2 7"]
) -> Float[Array, "n_shares"]:
    """Compares the pairs of beams on either side.

    Args:
        weights: Of `init`, trained.
        features: Features of `BLOCK + 2 LAGS` bins about the block.
        there: Weights of the bins.
        along: Mean distance ahead at which each beam saw the block, m.
    """
    shifts = range(2 * LAGS + 1)
    seen_ahead = jnp.stack([features[:, :, k : k + BLOCK] for k in shifts], axis=2)
    there_ahead = jnp.stack([there[:, :, k : k + BLOCK] for k in shifts], axis=2)
    behind, there_behind = features[:, :, LAGS : LAGS + BLOCK], there[:, :, LAGS : LAGS + BLOCK]
    square = lambda f: jnp.sum(f * f, axis=-1)  # noqa: E731
    ahead_square = _einsum("saku,sbu->sabk", there_ahead * square(seen_ahead), there_behind)
    behind_square = _einsum("saku,sbu->sabk", there_ahead, there_behind * square(behind))
    product = _einsum("sakuc,sbuc->sabk", there_ahead[..., None] * seen_ahead, there_behind[..., None] * behind)
    count = _einsum("saku,sbu->sabk", there_ahead, there_behind)
    a, b = PAIRS[:, 0], PAIRS[:, 1]
    cost = ((ahead_square + behind_square - 2.0 * product) / (count + 1.0))[:, a, b]
    shares = jnp.asarray(SHARES)
    apart = (along[:, a] - along[:, b]) / BIN
    target = LAGS + jnp.clip(apart[..., None] * shares / (1.0 + shares), 2.0 - LAGS, LAGS - 2.0)
    curve = _einsum("spek,spk->spe", _cubic(jnp.arange(2 * LAGS + 1) - target[..., None]), cost)
    present = jnp.max(count[:, a, b], axis=-1) / BLOCK
    weight = jax.nn.softplus(weights["pair"]) * BLOCK * present**2
    return -jnp.exp(weights["count"]) * _einsum("sp,spe->e", weight, curve)


def _cubic(x: Array) -> Array:
    """Returns the weights of a cubic convolution at distances in samples. Source: Keys 1981, a = -1/2."""
    x = jnp.abs(x)
    near, far = (1.5 * x - 2.5) * x * x + 1.0, ((-0.5 * x + 2.5) * x - 4.0) * x + 2.0
    return jnp.where(x < 1.0, near, jnp.where(x < 2.0, far, 0.0))
