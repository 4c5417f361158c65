"""From metres to estimates: a Kalman filter, a network whose answers are summed, or one whose answers are filtered.

`NAME-kalman` is the hybrid: what the network answers to a metre is a measurement, and the filter keeps what lasts over
the whole drive, the odometer's error foremost, which a network that looks back 30 m forgets.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.policies.locate import kalman, map_filter, matching
from subterra_jax.policies.locate.blocks import DELAY, N_RAW, Block, Estimate, matched_inputs, raw_inputs
from subterra_jax.policies.locate.recurrent import CELLS, HIDDEN, apply, dense

Weights = dict[str, Any]
FILTERED = "-kalman"
MAP = "map"  # the weights that take a map
NETWORKS = ("kalman", *CELLS, *(f"{name}{FILTERED}" for name in CELLS))
FRONTS = ("match", "wide", "scans")
_COMPARED = {"match": matching.SHARES, "wide": matching.WIDE_SHARES}
_UNIT = 0.02  # of the speed: answers of order 1


@struct.dataclass
class Filtered:
    """Memory of a network whose answers are filtered.

    Attributes:
        cell: Memory of its cell.
        filter: Memory of the filter.
    """

    cell: Any
    filter: kalman.Filter


@struct.dataclass
class Sums:
    """Memory of a network.

    Attributes:
        cell: Memory of its cell.
        correction: Sum of its answers for the metres that all beams have passed, m.
        age: Metres so far.
    """

    cell: Any
    correction: Float[Array, ""]
    age: Float[Array, ""]


def init(network: str, front: str, key: PRNGKeyArray, with_map: bool = False) -> Weights:
    """Returns untrained weights of a localiser.

    Args:
        network: One of `NETWORKS`.
        front: One of `FRONTS`.
        key: Source of randomness.
        with_map: Add the filter that takes a map.

    Raises:
        ValueError: There is no such network or front end, a filter shall do without the front end, or a map be taken by
            another than a network with its front end.
    """
    if with_map:
        if network not in CELLS or front != "match":
            raise ValueError(f"a map is taken by {', '.join(CELLS)} with front match, not by {network} with {front}")
        return {**init(network, front, key), MAP: map_filter.init(jax.random.fold_in(key, 2))}
    if network not in NETWORKS or front not in FRONTS:
        known = f"networks are {', '.join(NETWORKS)}; fronts are {', '.join(FRONTS)}"
        raise ValueError(f"no network {network!r} with front {front!r}; {known}")
    if network == "kalman" and front != "match":
        raise ValueError("a Kalman filter needs the evidence of the front end for slip: front = match")
    if network.endswith(FILTERED):
        plain = init(network.removesuffix(FILTERED), front, key)
        del plain["out"]  # the filter answers
        return {**plain, "measure": dense(jax.random.fold_in(key, 1), HIDDEN, 2, 0.1), "kalman": kalman.init(key)}
    keys = jax.random.split(key, 5)
    weights: Weights = {"match": matching.init(keys[0], _COMPARED[front])} if front in _COMPARED else {}
    if network == "kalman":
        return {**weights, "kalman": kalman.init(keys[1])}
    n_in = len(_COMPARED[front]) + 4 if front in _COMPARED else N_RAW + 2
    return {
        **weights,
        "in": dense(keys[1], n_in, HIDDEN),
        "in_2": dense(keys[2], HIDDEN, HIDDEN),
        "cell": CELLS[network].init(keys[3]),
        "out": dense(keys[4], HIDDEN, 3, 0.1),
    }


def front_of(tensors: Any) -> str:
    """Returns the front end of weights by name."""
    shares = tensors.get("match.shares")
    wide = shares is not None and shares.shape == matching.WIDE_SHARES.shape
    return "scans" if shares is None else "wide" if wide else "match"


def passed(estimate: Estimate, age: Array) -> Array:
    """Returns the part of a network's correction that is of metres which all beams have passed, m."""
    return estimate.correction - jnp.minimum(age, DELAY) * estimate.share


def log_rate(estimate: Estimate, age: Array) -> Array:
    """Returns the log of how fast a network says that its error grows; 0 is 3 cm after a metre."""
    return estimate.log_scale - _log_scale(jnp.zeros(()), age)


def start(network: str, weights: Weights) -> Any:
    """Returns the memory at the start."""
    if network == "kalman":
        return kalman.start(weights["kalman"])
    if network.endswith(FILTERED):
        return Filtered(CELLS[network.removesuffix(FILTERED)].start(), kalman.start(weights["kalman"]))
    return Sums(CELLS[network].start(), jnp.zeros(()), jnp.zeros(()))


def step(network: str, weights: Weights, memory: Any, block: Block) -> tuple[Any, Estimate]:
    """Takes in one metre, and answers."""
    if network == "kalman":
        return kalman.step(weights["kalman"], memory, block)
    if network.endswith(FILTERED):
        cell, hidden = CELLS[network.removesuffix(FILTERED)].step(weights["cell"], memory.cell, _embed(weights, block))
        after, estimate = kalman.step(weights["kalman"], memory.filter, block, measured(weights, hidden))
        return Filtered(cell, after), estimate
    cell, hidden = CELLS[network].step(weights["cell"], memory.cell, _embed(weights, block))
    passed, coming, log_rate = _answers(weights, hidden)
    age = memory.age + 1.0
    correction = memory.correction + jnp.where(age > DELAY, passed, 0.0)
    ahead = jnp.minimum(age, DELAY) * coming
    estimate = Estimate(correction + ahead, coming, _log_scale(log_rate, age))
    return Sums(cell, correction, age), estimate


def sequence(network: str, weights: Weights, blocks: Block) -> Estimate:
    """Returns the answers to all metres of a drive; fields of `blocks` have the metres as first axis."""
    if network == "kalman":
        return kalman.sequence(weights["kalman"], blocks)
    if network.endswith(FILTERED):
        hidden = hidden_rows(network, weights, blocks)
        return kalman.sequence(weights["kalman"], blocks, measured(weights, hidden))
    return summed(weights, hidden_rows(network, weights, blocks))


def summed(weights: Weights, hidden: Float[Array, "t n"]) -> Estimate:
    """Returns the answers of a network without a filter: its answers to the metres, summed."""
    passed, coming, log_rate = _answers(weights, hidden)
    age = jnp.arange(1.0, hidden.shape[0] + 1.0)
    correction = jnp.cumsum(jnp.where(age > DELAY, passed, 0.0))
    return Estimate(correction + jnp.minimum(age, DELAY) * coming, coming, _log_scale(log_rate, age))


def hidden_rows(network: str, weights: Weights, blocks: Block) -> Float[Array, "t n"]:
    """Returns what the cell of a network makes of all metres of a drive."""
    return CELLS[network.removesuffix(FILTERED)].sequence(weights["cell"], _embed(weights, blocks))


def measured(weights: Weights, hidden: Float[Array, "*t n"]) -> tuple[Float[Array, "*t"], Float[Array, "*t"]]:
    """Returns the error of the command `DELAY` metres ago that a network sees, m per m, and its variance."""
    out = apply(weights["measure"], hidden)
    return _UNIT * out[..., 0], _UNIT**2 * jnp.exp(2.0 * jnp.clip(out[..., 1], -4.0, 6.0))


def _embed(weights: Weights, block: Block) -> Array:
    rows = matched_inputs(block, matching.shares(weights["match"])) if "match" in weights else raw_inputs(block)
    return apply(weights["in_2"], jax.nn.gelu(apply(weights["in"], rows)))


def _answers(weights: Weights, hidden: Array) -> tuple[Array, Array, Array]:
    """Returns error of the command in the metre passed and in those to come, and the log of the error's growth."""
    out = apply(weights["out"], hidden)
    return _UNIT * out[..., 0], _UNIT * out[..., 1], out[..., 2]


def _log_scale(log_rate: Array, age: Array) -> Array:
    """Returns the log of the error expected after `age` metres."""
    return jnp.log(0.03) + 0.5 * jnp.log(age) + log_rate
