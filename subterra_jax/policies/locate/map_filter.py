"""A learnt localiser with a map: a differentiable histogram filter over how far off its own estimate is.

relief seen ─┐
             ├─► agreement of each shift from −12 to 12 m, by the metre ─► belief over the shift ─► correction
relief mapped┘                                                           └─► belief that the map is of this tunnel

The filter stands `DELAY` metres behind the robot, where all beams have passed. The localiser moves the belief's middle,
and says by how much it widens. Learnt are what is compared of the two reliefs, how much each beam counts, and both
widths. A map of another tunnel agrees no better than by chance: it is then left aside, and so is no map at all.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax.policies.locate.blocks import DELAY, Estimate
from subterra_jax.policies.locate.map_strip import MapStrip
from subterra_jax.policies.locate.profiles import BIN, BLOCK, N_BEARINGS, Profiles, mean_along

Weights = dict[str, Any]
CELL = 0.2  # m of a cell of the belief
SIDE = 60  # cells to either side
SHIFTS = (CELL * np.arange(-SIDE, SIDE + 1)).astype(np.float32)
FARTHEST = 20.0  # m by which the localiser's own correction may move the middle
_STRIDE = round(CELL / BIN)
_NEAR, _WIDE, _TAPS = 8, 30, 9  # bins to either side of two running means; bins of the filter
MARGIN = _WIDE + _TAPS // 2  # bins about a block that its features depend on
SLACK = 12  # bins by which a row may be moved beyond the shifts
N_SEEN = BLOCK + 2 * MARGIN  # bins of the profiles that a block needs
N_REACH = BLOCK + 2 * (_STRIDE * SIDE + SLACK)  # bins of the map's features that a block needs
BEFORE = _STRIDE * SIDE + SLACK + round(FARTHEST / BIN)  # bins of the map before and after a whole drive
_CHANNELS = 6
_UNIT = 0.03  # m: relief that is large against noise
_ROOF = 3.0  # of a feature: deeper niches count as so deep
_MOST = 8.0  # log odds of the map at most
_LEAST_SIGMA = 0.12  # m; a start that is reported exactly
_WINDOW = 3  # cells to either side that count as one place
_FLOOR = 1e-7  # of the probability of a cell, in the loss
_TO_MEAN_ABSOLUTE = float(np.sqrt(2.0 / np.pi))


@struct.dataclass
class MapBelief:
    """Memory of the filter."""

    fraction: Float[Array, "n_shifts"]  # probability of each of `SHIFTS`, if the map is of this tunnel
    log_odds: Float[Array, ""]  # log odds that it is


def init(key: PRNGKeyArray) -> Weights:
    """Returns weights from which learning goes on: smoothed relief, its slope, and both over a longer stretch."""
    smooth, recede = _in_middle([0.25, 0.5, 0.25]), _in_middle([-0.3, -0.3, -0.3, 0.0, 0.3, 0.3, 0.3])
    taps = jnp.zeros((N_BEARINGS, _TAPS, 3, _CHANNELS))
    for channel, (source, filters) in enumerate(((0, smooth), (0, recede), (1, smooth), (1, recede))):
        taps = taps.at[:, :, source, channel].set(filters)
    random = 0.05 * jax.random.normal(key, (2, *taps.shape)) / np.sqrt(_TAPS)
    return {
        "seen": taps + random[0],
        "mapped": taps + random[1],
        "pair": jnp.full((N_BEARINGS, _CHANNELS), -3.0),
        "log_cap": jnp.log(jnp.array(6.0)),
        "log_widen": jnp.log(jnp.array(0.003)),  # m² in a metre, where the localiser claims its usual error
        "widen_by": jnp.ones(()),
        "leak": jnp.array(-9.0),
        "log_odds": jnp.array(2.0),
    }


def _in_middle(taps: list[float]) -> Float[Array, "tap"]:
    return jnp.pad(jnp.array(taps), (_TAPS - len(taps)) // 2)


def start(weights: Weights, sigma: Float[Array, ""]) -> MapBelief:
    """Returns the belief at the start, whose station is reported with a standard deviation (m)."""
    width = jnp.maximum(sigma, _LEAST_SIGMA)
    return MapBelief(jax.nn.softmax(-0.5 * (jnp.asarray(SHIFTS) / width) ** 2), weights["log_odds"])


def seen_features(weights: Weights, profiles: Profiles) -> Float[Array, "2 7 bins c"]:
    """Returns features of what was seen; `MARGIN` bins at either end are lost."""
    weight = jnp.minimum(profiles.weight, 1.0)
    return _encode(weights["seen"], profiles.out / jnp.maximum(profiles.weight, 1e-3), weight)


def map_features(weights: Weights, strip: MapStrip, start: Float[Array, ""], n: int) -> Float[Array, "2 7 bins c"]:
    """Returns what beams would see along a stretch of the map.

    Args:
        weights: Trained weights, as `init` makes them.
        strip: The map of one tunnel.
        start: Station of the first bin, m.
        n: Number of bins.
    """
    wall, inside = strip.sample(start - BIN * MARGIN, n + 2 * MARGIN)
    rows = lambda values: jnp.broadcast_to(values[:, None], (2, N_BEARINGS, values.shape[-1]))  # noqa: E731
    return _encode(weights["mapped"], rows(wall), rows(jnp.broadcast_to(inside, wall.shape).astype(jnp.float32)))


def _encode(taps: Array, out: Array, there: Array) -> Float[Array, "2 7 bins c"]:
    near, wide = (_mean(out, there, reach) for reach in (_NEAR, _WIDE))
    relief, swell = jnp.arcsinh((out - near) / _UNIT), jnp.arcsinh((near - wide) / _UNIT)
    inputs = jnp.stack([there * relief, there * swell, 1.0 - there], axis=-1)[:, :, _WIDE:-_WIDE]
    m = inputs.shape[2] - _TAPS + 1
    rows = jnp.stack([inputs[:, :, k : k + m] for k in range(_TAPS)], axis=-2)
    found = jnp.einsum("sbukc,bkcd->sbud", rows, taps, precision="highest")
    half = _WIDE + _TAPS // 2
    return there[:, :, half : half + m, None] * _ROOF * jnp.tanh(found / _ROOF)


def _mean(out: Array, there: Array, reach: int) -> Array:
    """Returns the weighted mean over `reach` bins to either side; there are fewer at the ends."""
    size = out.shape[-1]
    ends = [np.clip(np.arange(size) + k, 0, size) for k in (-reach, reach + 1)]

    def sums(values: Array) -> Array:
        total = jnp.cumsum(jnp.pad(values, ((0, 0), (0, 0), (1, 0))), axis=-1)
        return total[..., ends[1]] - total[..., ends[0]]

    # About a middle value, or a sum over thousands of bins would blur millimetres in 32 bits.
    middle = jnp.sum(there * out, axis=-1, keepdims=True) / jnp.maximum(jnp.sum(there, axis=-1, keepdims=True), 1e-3)
    return middle + sums(there * (out - middle)) / jnp.maximum(sums(there), 1e-3)


def agreement(
    weights: Weights,
    seen: Float[Array, "2 7 block c"],
    mapped: Float[Array, "2 7 reach c"],
    along: Float[Array, "2 7"],
    part: Float[Array, ""],
    error: Float[Array, ""],
) -> Float[Array, "n_shifts"]:
    """Returns the log likelihood ratio, map against no map, of each of `SHIFTS` by one block.

    Args:
        weights: Trained weights, as `init` makes them.
        seen: Features of the block.
        mapped: Features of the map about where the block is believed to be, rounded down to a bin.
        along: Mean distance ahead at which each beam saw the block, m.
        part: Rest after rounding, in bins.
        error: Error of the command in the block, m per m: what was seen ahead lies further on by that.
    """
    moved = jnp.clip(part - (error / BIN) * (0.5 + along), 1.0 - SLACK, SLACK - 1.0)
    lower = jnp.floor(moved)
    n = N_REACH - 2 * SLACK
    cut = lambda row, first: jax.lax.dynamic_slice_in_dim(row, first, n + 1)  # noqa: E731
    rows = jax.vmap(jax.vmap(cut))(mapped, SLACK + lower.astype(jnp.int32))
    fraction = (moved - lower)[..., None, None]
    rows = (1.0 - fraction) * rows[:, :, :-1] + fraction * rows[:, :, 1:]
    counts = jax.nn.softplus(weights["pair"])[:, None]
    there = jnp.any(seen != 0.0, axis=-1, keepdims=True)
    left = jnp.concatenate([2.0 * counts * seen, -counts * there], axis=-1)
    right = jnp.concatenate([rows, rows * rows], axis=-1)
    fit = jnp.einsum("sbud,sbvd->uv", left, right, precision="highest")
    index = np.arange(BLOCK)[:, None] + _STRIDE * np.arange(2 * SIDE + 1)
    total = jnp.sum(fit[np.arange(BLOCK)[:, None], index], axis=0)
    cap = jnp.exp(weights["log_cap"])
    return cap * jnp.tanh(total / cap)


def advance(weights: Weights, now: MapBelief, ratio: Float[Array, "n_shifts"], log_rate: Float[Array, ""]) -> MapBelief:
    """Takes in one metre.

    Args:
        weights: Trained weights, as `init` makes them.
        now: The belief.
        ratio: Ratio of `agreement`.
        log_rate: Log of the rate at which the localiser says that its error grows, of `memory`.
    """
    variance = jnp.exp(weights["log_widen"] + 2.0 * weights["widen_by"] * log_rate) / CELL**2
    variance = jnp.clip(variance, 1e-3, 0.9)
    wide = jnp.pad(now.fraction, 1, mode="edge")
    fraction = (1.0 - variance) * now.fraction + 0.5 * variance * (wide[:-2] + wide[2:])
    leak = jax.nn.sigmoid(weights["leak"])
    fraction = (1.0 - leak) * fraction / jnp.sum(fraction) + leak / len(SHIFTS)
    top = jnp.max(ratio)
    weighed = fraction * jnp.exp(ratio - top)
    total = jnp.sum(weighed)
    log_odds = jnp.clip(now.log_odds + top + jnp.log(total), -_MOST, _MOST)
    return MapBelief(weighed / total, log_odds)


def likelihood(now: MapBelief, shift: Float[Array, ""], right: Bool[Array, ""]) -> Float[Array, ""]:
    """Returns the log probability of the truth: shift (m) and map if it is the right one, else that it is not."""
    place = jnp.clip(shift / CELL + SIDE, 0.0, 2.0 * SIDE - 1e-3)
    lower = jnp.floor(place).astype(jnp.int32)
    fraction = place - lower
    there = (1.0 - fraction) * now.fraction[lower] + fraction * now.fraction[lower + 1]
    mine = jax.nn.log_sigmoid(now.log_odds) + jnp.log(there + _FLOOR)
    return jnp.where(right, mine, jax.nn.log_sigmoid(-now.log_odds))


def place(now: MapBelief) -> tuple[Float[Array, ""], Float[Array, ""], Bool[Array, ""]]:
    """Returns the likeliest place of some cells, m, the standard deviation of all about it, and whether to believe."""
    wide = jnp.pad(now.fraction, _WINDOW)
    n = len(SHIFTS)
    mass = sum(wide[k : k + n] for k in range(2 * _WINDOW + 1))
    best = jnp.argmax(mass)
    near = jnp.where(jnp.abs(jnp.arange(n) - best) <= _WINDOW, now.fraction, 0.0)
    shift = jnp.sum(near * jnp.asarray(SHIFTS)) / jnp.sum(near)
    sigma = jnp.sqrt(jnp.sum(now.fraction * (jnp.asarray(SHIFTS) - shift) ** 2))
    return shift, sigma, now.log_odds > 0.0


def corrected(now: MapBelief, plain: Estimate, age: Float[Array, ""], start_sigma: Float[Array, ""]) -> Estimate:
    """Returns the localiser's estimate with what the map tells, if it is believed.

    Args:
        now: The belief, `DELAY` metres ago.
        plain: Estimate without a map.
        age: Metres so far.
        start_sigma: Standard deviation of the station reported as the start, m.
    """
    shift, sigma, believed = place(now)
    believed &= age > DELAY
    since = plain.log_scale + 0.5 * jnp.log(jnp.minimum(DELAY / jnp.maximum(age, 1.0), 1.0))
    mapped = 0.5 * jnp.log(jnp.exp(2.0 * since) + (_TO_MEAN_ABSOLUTE * sigma) ** 2)
    unmapped = 0.5 * jnp.log(jnp.exp(2.0 * plain.log_scale) + (_TO_MEAN_ABSOLUTE * start_sigma) ** 2)
    return Estimate(
        plain.correction + jnp.where(believed, shift, 0.0), plain.fraction, jnp.where(believed, mapped, unmapped)
    )


def metre(
    weights: Weights,
    profiles: Profiles,
    strip: MapStrip,
    reported: Float[Array, ""],
    block: Array,
    passed: Float[Array, ""],
    error: Float[Array, ""],
) -> Float[Array, "n_shifts"]:
    """Returns the agreement of one block, as the robot goes.

    Args:
        weights: Trained weights, as `init` makes them.
        profiles: `N_SEEN` bins about the block.
        strip: The map of the tunnel.
        reported: Station reported as the start, m.
        block: Number of the block.
        passed: Correction at its end, by the localiser alone, m.
        error: Correction in it, m.
    """
    middle = slice(MARGIN, MARGIN + BLOCK)
    along = mean_along(jax.tree.map(lambda sums: sums[..., middle], profiles))
    moved = jnp.clip(passed, -FARTHEST, FARTHEST) / BIN
    lower = jnp.floor(moved)
    first = reported + BIN * (BLOCK * block + lower - _STRIDE * SIDE - SLACK)
    mapped = map_features(weights, strip, first, N_REACH)
    return agreement(weights, seen_features(weights, profiles), mapped, along, moved - lower, error)


def sequence(
    weights: Weights,
    whole: Profiles,
    before: int,
    strip: MapStrip,
    reported: Float[Array, ""],
    sigma: Float[Array, ""],
    passed: Float[Array, "n"],
    log_rate: Float[Array, "n"],
) -> MapBelief:
    """Returns the beliefs after all metres of a drive: the fields have the metres as first axis.

    Args:
        weights: Trained weights, as `init` makes them.
        whole: Profiles of the drive.
        before: Bins of them before the start; at least `MARGIN`.
        strip: The map of the tunnel.
        reported: Station reported as the start, m.
        sigma: Its standard deviation, m.
        passed: Correction at the end of the block `DELAY` metres before each metre, by the localiser alone, m.
        log_rate: Log of the rate at which the localiser says that its error grows, at each metre.
    """
    n = passed.shape[0]
    seen = seen_features(weights, whole)
    mapped = map_features(weights, strip, reported - BIN * BEFORE, BLOCK * n + 2 * BEFORE)

    def one(block: Array, moved: Array, error: Array) -> Array:
        mine = jax.lax.dynamic_slice_in_dim(seen, before - MARGIN + BLOCK * block, BLOCK, axis=2)
        middle = lambda sums: jax.lax.dynamic_slice_in_dim(sums, before + BLOCK * block, BLOCK, axis=2)  # noqa: E731
        along = mean_along(Profiles(middle(whole.weight), middle(whole.out), middle(whole.along)))
        moved = jnp.clip(moved, -FARTHEST, FARTHEST) / BIN
        lower = jnp.floor(moved)
        first = BEFORE - _STRIDE * SIDE - SLACK + BLOCK * block + lower.astype(jnp.int32)
        some = jax.lax.dynamic_slice_in_dim(mapped, first, N_REACH, axis=2)
        return agreement(weights, mine, some, along, moved - lower, error)

    error = jnp.diff(passed, prepend=0.0)
    ratio = jax.vmap(one)(jnp.arange(n - DELAY), passed[DELAY:], error[DELAY:])

    def step(now: MapBelief, row: tuple[Array, Array]) -> tuple[MapBelief, MapBelief]:
        after = advance(weights, now, *row)
        return after, after

    prior = start(weights, sigma)
    _, after = jax.lax.scan(step, prior, (ratio, log_rate[DELAY:]))
    return jax.tree.map(
        lambda first, rest: jnp.concatenate([jnp.broadcast_to(first, (DELAY, *first.shape)), rest]), prior, after
    )
