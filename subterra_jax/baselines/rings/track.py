"""What `ringgrid` remembers: for the robot what is known, and for each of its filters a belief and a pattern."""

import dataclasses
import math

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.baselines.rings import bank as ringbank
from subterra_jax.baselines.rings import belief as ringbelief
from subterra_jax.baselines.rings import lag as ringlag
from subterra_jax.baselines.rings import walls as wallfit

_BEGINS_WET = 0.15


@struct.dataclass
class GridTrack:
    """What is known of rings, place and grip. A bank is a filter: the first began on dry rail, the second on wet rail.

    Attributes:
        station: Estimated station less that of the start, m: where the robot is now, not where it was observed.
        reckoned: The same by dead reckoning alone, m.
        rate: Estimated relative error of the dead reckoning.
        innovation: By how much the last scan found the station too large, m.
        strength: Between 0, no pattern, and 1.
        spread: Standard deviation of the station by the belief, m.
        wet: Probability of wet rail.
        driven: Distance driven, m.
        walls: The walls as fitted.
        lag: Age of what is observed.
        base: Station at the middle of each bank's grid, m.
        belief: How far the true station lies beyond it, dry and wet.
        rates: Rate of each bank.
        evidence: Log of what speaks for a bank, less that of the best.
        memory: The pattern of each bank.
    """

    station: Float[Array, "*env"]
    reckoned: Float[Array, "*env"]
    rate: Float[Array, "*env"]
    innovation: Float[Array, "*env"]
    strength: Float[Array, "*env"]
    spread: Float[Array, "*env"]
    wet: Float[Array, "*env"]
    driven: Float[Array, "*env"]
    walls: wallfit.Walls
    lag: ringlag.Lag
    base: Float[Array, "*env bank"]
    belief: Float[Array, "*env bank 2 cells"]
    rates: Float[Array, "*env bank"]
    evidence: Float[Array, "*env bank"]
    memory: ringbank.Memory


def start(batch: tuple[int, ...], n_beams: int, wet: bool = True) -> GridTrack:
    """At the start, no pattern known; `wet` where the rail may be wet there, at twice the cost."""
    zero, banks = jnp.zeros(batch), (False, True) if wet else (False,)
    each = jnp.zeros((*batch, len(banks)))
    odds = (0.0, math.log(_BEGINS_WET / (1.0 - _BEGINS_WET)))[: len(banks)]
    return GridTrack(
        **dict.fromkeys(("station", "reckoned", "rate", "innovation", "strength", "spread", "wet", "driven"), zero),
        walls=wallfit.start(batch, n_beams),
        lag=ringlag.start(batch),
        base=each,
        belief=jnp.stack([ringbelief.start(batch, is_wet) for is_wet in banks], axis=-3),
        rates=each,
        evidence=each + jnp.asarray(odds),
        memory=ringbank.start(each.shape),
    )


def anew(track: GridTrack, keep: Float[Array, "*env"]) -> GridTrack:
    """As it is where `keep` is 1, and as at the start where it is 0."""
    fresh = start((), 1, wet=track.base.shape[-1] > 1)
    fresh = dataclasses.replace(fresh, walls=jax.tree.map(lambda part: jnp.zeros(()), track.walls))

    def chosen(now: Array, begun: Array) -> Array:
        return jnp.where(keep.reshape(keep.shape + (1,) * (now.ndim - keep.ndim)) > 0.0, now, begun)

    return jax.tree.map(chosen, track, fresh)
