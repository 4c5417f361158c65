"""From metres to estimates: a transformer answers for each metre, and its answers are summed."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.policies.locate import attention, map_filter, matching
from subterra_jax.policies.locate.attention import HIDDEN, apply, dense
from subterra_jax.policies.locate.blocks import DELAY, Block, Estimate, matched_inputs

Weights = dict[str, Any]
MAP = "map"  # the weights that take a map
_COMPARED = {"match": matching.FRACTIONS, "wide": matching.WIDE_FRACTIONS}
_UNIT = 0.02  # of the speed: answers of order 1


@struct.dataclass
class Sums:
    """Memory of the network."""

    cell: Any  # memory of the transformer
    correction: Float[Array, ""]  # sum of its answers for the metres that all beams have passed, m
    age: Float[Array, ""]  # metres so far


def init(front: str, key: PRNGKeyArray, with_map: bool = False) -> Weights:
    """Returns untrained weights of a localiser.

    Args:
        front: Errors of the command that are compared: `match` of slip, `wide` of wet rail too.
        key: Source of randomness.
        with_map: Add the filter that takes a map; with `match` alone.
    """
    keys = jax.random.split(key, 5)
    weights = {
        "match": matching.init(keys[0], _COMPARED[front]),
        "in": dense(keys[1], len(_COMPARED[front]) + 4, HIDDEN),
        "in_2": dense(keys[2], HIDDEN, HIDDEN),
        "cell": attention.init(keys[3]),
        "out": dense(keys[4], HIDDEN, 3, 0.1),
    }
    return {**weights, MAP: map_filter.init(jax.random.fold_in(key, 2))} if with_map else weights


def front_of(tensors: Any) -> str:
    """Returns the front end of weights by name."""
    return "wide" if tensors["match.shares"].shape == matching.WIDE_FRACTIONS.shape else "match"


def passed(estimate: Estimate, age: Array) -> Array:
    """Returns the part of a network's correction that is of metres which all beams have passed, m."""
    return estimate.correction - jnp.minimum(age, DELAY) * estimate.fraction


def log_rate(estimate: Estimate, age: Array) -> Array:
    """Returns the log of how fast a network says that its error grows; 0 is 3 cm after a metre."""
    return estimate.log_scale - _log_scale(jnp.zeros(()), age)


def start() -> Sums:
    """Returns the memory at the start."""
    return Sums(attention.start(), jnp.zeros(()), jnp.zeros(()))


def step(weights: Weights, memory: Sums, block: Block) -> tuple[Sums, Estimate]:
    """Takes in one metre, and answers."""
    cell, hidden = attention.step(weights["cell"], memory.cell, _embed(weights, block))
    passed, coming, log_rate = _answers(weights, hidden)
    age = memory.age + 1.0
    correction = memory.correction + jnp.where(age > DELAY, passed, 0.0)
    ahead = jnp.minimum(age, DELAY) * coming
    return Sums(cell, correction, age), Estimate(correction + ahead, coming, _log_scale(log_rate, age))


def sequence(weights: Weights, blocks: Block) -> Estimate:
    """Returns the answers to all metres of a drive; fields of `blocks` have the metres as first axis."""
    hidden = attention.sequence(weights["cell"], _embed(weights, blocks))
    passed, coming, log_rate = _answers(weights, hidden)
    age = jnp.arange(1.0, hidden.shape[0] + 1.0)
    correction = jnp.cumsum(jnp.where(age > DELAY, passed, 0.0))
    return Estimate(correction + jnp.minimum(age, DELAY) * coming, coming, _log_scale(log_rate, age))


def _embed(weights: Weights, block: Block) -> Array:
    rows = matched_inputs(block, matching.fractions(weights["match"]))
    return apply(weights["in_2"], jax.nn.gelu(apply(weights["in"], rows)))


def _answers(weights: Weights, hidden: Array) -> tuple[Array, Array, Array]:
    """Returns error of the command in the metre passed and in those to come, and the log of the error's growth."""
    out = apply(weights["out"], hidden)
    return _UNIT * out[..., 0], _UNIT * out[..., 1], out[..., 2]


def _log_scale(log_rate: Array, age: Array) -> Array:
    """Returns the log of the error expected after `age` metres."""
    return jnp.log(0.03) + 0.5 * jnp.log(age) + log_rate
