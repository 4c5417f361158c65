"""A target for the map: robots are given a start that may be hidden, and a map that may be of another place."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from subterra_jax import constants
from subterra_jax.policies.locate import map_filter, memory, streams
from subterra_jax.policies.locate.blocks import DELAY
from subterra_jax.policies.locate.map_strip import MapStrip
from train.drives import Drives

_HIDDEN, _WRONG = 0.5, 0.2  # fractions of the drives whose start is hidden, and whose map is of another place
_APART = 50.0  # m from the true place to that of a wrong map, at least


@struct.dataclass
class MapCase:
    """Start and map that a robot is given."""

    offset: Float[Array, "*env"]  # true station of the start less that given, m
    sigma: Float[Array, "*env"]  # standard deviation of the start that it is given, m
    tunnel: Int[Array, "*env"]  # tunnel of its map
    shift: Float[Array, "*env"]  # place on that map less the true one, m
    right: Bool[Array, "*env"]  # whether the map is the right one


def draw_cases(key: PRNGKeyArray, drive: Drives, params: Any) -> MapCase:
    """Draws what each robot with a map is given: a hidden start or not, the right map or one of another place."""
    keys, shape = jax.random.split(key, 4), drive.start.shape
    hidden, wrong = (jax.random.uniform(k, shape) for k in keys[:2])
    sigma = jnp.where(hidden < _HIDDEN, constants.HIDDEN_START_SIGMA, 0.0)
    offset = sigma * jnp.clip(jax.random.normal(keys[2], shape), -3.0, 3.0)
    right = wrong >= _WRONG
    count = params.tunnel.count
    ways = jax.random.uniform(keys[3], (2, *shape))
    # Of one tunnel the other place is another part of it.
    other = (drive.tunnel + 1 + jnp.floor(ways[0] * (count - 1)).astype(jnp.int32)) % count
    room = jnp.broadcast_to(jnp.asarray(params.tunnel.length), (count,))[other]
    away = jnp.mod(drive.start + _APART + ways[1] * jnp.maximum(room - 2.0 * _APART, 0.0), room) - drive.start
    return MapCase(offset, sigma, jnp.where(right, drive.tunnel, other), jnp.where(right, 0.0, away), right)


def map_loss(
    weights: Any, drive: Drives, given: MapCase, answers: Any, truth: Array, valid: Array, strip: MapStrip
) -> tuple[Array, dict[str, Array]]:
    """Returns the negative log probability of shift and map, summed over the metres of one drive, and what is logged.

    Args:
        weights: Of the localiser.
        drive: The drive.
        given: What its robot is given.
        answers: The localiser's own answers, which learn nothing of this.
        truth: True less commanded distance, m.
        valid: Metres that were completed.
        strip: Maps of the tunnels.
    """
    beliefs, passed = believe(weights, drive, given, jax.lax.stop_gradient(answers), strip)
    shift = given.offset + truth[: len(truth) - DELAY] - passed[DELAY:]
    right = jnp.broadcast_to(given.right, shift.shape)
    score = jax.vmap(map_filter.likelihood)(jax.tree.map(lambda leaf: leaf[DELAY:], beliefs), shift, right)
    use = valid[DELAY:] & (jnp.abs(shift) < map_filter.SHIFTS[-1])
    found, _, believed = jax.vmap(map_filter.place)(beliefs)
    near = jnp.abs(found[DELAY:] - shift) < 1.0
    terms = {"mapped": jnp.sum(use & given.right & near), "misled": jnp.sum(use & ~given.right & believed[DELAY:])}
    return -jnp.sum(jnp.where(use, score, 0.0)), jax.tree.map(lambda n: n.astype(jnp.float32), terms)


def believe(weights: Any, drive: Drives, given: MapCase, answers: Any, strip: MapStrip) -> tuple[Any, Array]:
    """Returns the beliefs of a robot with a map after all metres of a drive, and the corrections that they are about.

    Args:
        weights: Of the localiser.
        drive: The drive.
        given: What it is given.
        answers: The localiser's own answers.
        strip: Maps of the tunnels.
    """
    age = jnp.arange(1.0, answers.correction.shape[0] + 1.0)
    passed, rate = memory.passed(answers, age), memory.log_rate(answers, age)
    whole = streams.profiles_of(drive.record, len(age))
    start = drive.start - given.offset + given.shift
    beliefs = map_filter.sequence(
        weights[memory.MAP], whole, streams.BEFORE, strip.pick(given.tunnel), start, given.sigma, passed, rate
    )
    return beliefs, passed
