"""A belief about how far dead reckoning is out, on a grid of ring and phase, and about the grip of the rail."""

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

PHASES, RINGS = 48, 5  # cells of one ring, rings
CELLS = PHASES * RINGS
CELL = (np.arange(CELLS) - CELLS // 2).astype(np.float32)  # 0 is where dead reckoning is right
PHASE = (2.0 * np.pi * (np.arange(PHASES) - CELLS // 2 % PHASES) / PHASES).astype(np.float32)
_TURN = (2.0 * np.pi * CELL / PHASES).astype(np.float32)
_MOST = 6.0  # cells by which one step moves the grid

Belief = Float[Array, "*batch 2 cells"]


@struct.dataclass
class Summary:
    """What a belief says, in cells and shares.

    Attributes:
        error: Mean within half a ring of the likeliest cell, cells.
        spread: Standard deviation of the whole belief, cells.
        sharpness: How well the phase is known: 1 known, 0 not at all.
        wet: Probability of wet rail.
        dry_error: Mean where the rail is dry, cells.
    """

    error: Float[Array, "*batch"]
    spread: Float[Array, "*batch"]
    sharpness: Float[Array, "*batch"]
    wet: Float[Array, "*batch"]
    dry_error: Float[Array, "*batch"]


def start(batch: tuple[int, ...], wet: bool) -> Belief:
    """Dead reckoning is right, and the rail is as one says."""
    return jnp.zeros((*batch, 2, CELLS)).at[..., int(wet), CELLS // 2].set(1.0)


def predicted(
    belief: Belief,
    lost: Float[Array, "*batch"],
    wetting: Float[Array, "*batch"],
    drying: Float[Array, "*batch"],
    blur: Float[Array, "*batch"],
) -> Belief:
    """After a step.

    Args:
        belief: Before; dry first.
        lost: Distance that wet rail takes from the step, cells.
        wetting: Probability that dry rail ends in it.
        drying: Probability that wet rail ends in it.
        blur: Variance that dead reckoning adds, cells².
    """
    dry, wet = belief[..., 0, :], _shifted(belief[..., 1, :], lost)
    wetting, drying = wetting[..., None], drying[..., None]
    mixed = jnp.stack([dry + drying * wet - wetting * dry, wet + wetting * dry - drying * wet], axis=-2)
    none = jnp.zeros_like(mixed[..., :1])
    ahead = jnp.concatenate([mixed[..., 1:], none], axis=-1)
    behind = jnp.concatenate([none, mixed[..., :-1]], axis=-1)
    return mixed + 0.5 * blur[..., None, None] * (ahead + behind - 2.0 * mixed)


def updated(belief: Belief, log_likelihood: Float[Array, "*batch phases"]) -> tuple[Belief, Float[Array, "*batch"]]:
    """By a scan, whose likelihood is the same at every ring; and the log of the evidence."""
    most = jnp.max(log_likelihood, axis=-1, keepdims=True)
    likelihood = jnp.tile(jnp.exp(log_likelihood - most), RINGS)
    weighed = belief * likelihood[..., None, :]
    before, after = jnp.sum(belief, axis=(-2, -1)), jnp.sum(weighed, axis=(-2, -1))
    evidence = most[..., 0] + jnp.log(after + 1e-30) - jnp.log(before + 1e-30)
    return weighed / (after[..., None, None] + 1e-30), evidence


def summary(belief: Belief) -> Summary:
    """What a normalised belief says."""
    either = jnp.sum(belief, axis=-2)
    best = jnp.argmax(either, axis=-1)[..., None]
    near = jnp.where(jnp.abs(jnp.arange(CELLS) - best) <= PHASES // 2, either, 0.0)
    error, dry = _mean(near), _mean(belief[..., 0, :])
    spread = jnp.sqrt(_total(either * jnp.square(CELL - error[..., None])))
    sharpness = jnp.hypot(_total(either * np.cos(_TURN)), _total(either * np.sin(_TURN)))
    return Summary(error, spread, sharpness, _total(belief[..., 1, :]), dry)


def recentred(belief: Belief, error: Float[Array, "*batch"]) -> tuple[Belief, Float[Array, "*batch"]]:
    """Moved by whole cells so that an error lies at 0; and by how many cells it was moved."""
    cells = jnp.clip(jnp.round(error), -_MOST, _MOST)
    return _taken(belief, cells[..., None].astype(jnp.int32)), cells


def _shifted(values: Float[Array, "*batch cells"], cells: Float[Array, "*batch"]) -> Float[Array, "*batch cells"]:
    """Moved towards lower cells, by linear interpolation; what leaves the grid is lost."""
    whole = jnp.floor(cells)
    part, first = (cells - whole)[..., None], whole.astype(jnp.int32)
    return (1.0 - part) * _taken(values, first) + part * _taken(values, first + 1)


def _taken(values: Float[Array, "*batch cells"], cells: Array) -> Float[Array, "*batch cells"]:
    index = jnp.arange(CELLS) + cells[..., None]
    inside = (index >= 0) & (index < CELLS)
    index = jnp.broadcast_to(jnp.clip(index, 0, CELLS - 1), values.shape)
    return jnp.where(inside, jnp.take_along_axis(values, index, axis=-1), 0.0)


def _mean(weight: Float[Array, "*batch cells"]) -> Float[Array, "*batch"]:
    return _total(weight * CELL) / (_total(weight) + 1e-30)


def _total(values: Float[Array, "*batch cells"]) -> Float[Array, "*batch"]:
    return jnp.sum(values, axis=-1)
