"""One of the filters of `ringgrid`: what a scan says against its pattern, and what the pattern learns from the scan."""

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.baselines.rings import belief as ringbelief
from subterra_jax.baselines.rings import pattern as ringpattern
from subterra_jax.baselines.rings import walls as wallfit
from subterra_jax.baselines.rings.pattern import Pattern
from subterra_jax.baselines.rings.walls import Bumps

STEP = 0.2  # m driven, by which gains are told
_MODEL = 0.03  # m, of the relief that a few harmonics leave out
_RANGE_VARIANCE = 0.05**2  # m²
_TEMPER = 0.5  # errors of neighbouring beams are not independent
_CAP = 9.0  # squared, in standard deviations: what one beam may say at most against a place
_BEGUN = 4.0, 8.0  # scans that a new pattern is worth, in what it is learnt with and in what it is believed
_FORGET = 0.002  # of the pattern: one that drifts takes the station with it
_CLEAR = 1.3, 3.0  # noise, in units of what an average leaves of it, and how steeply strength rises above it


@struct.dataclass
class Memory:
    """What is remembered of the rings.

    Attributes:
        pattern: Harmonics of each wall, real and imaginary part, m; the tunnel's left first.
        seen: Scans that it was learnt from.
        noise: Mean square of what a scan has beside it, m².
    """

    pattern: Float[Array, "*batch 2 harmonics 2"]
    seen: Float[Array, "*batch"]
    noise: Float[Array, "*batch"]


def start(batch: tuple[int, ...]) -> Memory:
    """Nothing known."""
    return Memory(jnp.zeros((*batch, 2, ringpattern.HARMONICS, 2)), jnp.zeros(batch), jnp.zeros(batch))


def phases(
    station: Float[Array, "*batch"], bumps: Bumps, direction: Float[Array, "*batch"], pitch: Float[Array, "*batch"]
) -> ringpattern.Turns:
    """Where in the ring the beams end if the robot is at a station; `bumps` with all axes of the batch, 1 or more."""
    place = station[..., None, None] + direction[..., None, None] * bumps.along
    return ringpattern.turns(2.0 * jnp.pi * place / pitch[..., None, None])


def log_likelihood(
    memory: Memory, pattern: Pattern, bumps: Bumps, at: ringpattern.Turns, n_beams: int
) -> Float[Array, "*batch phases"]:
    """Of a scan in each phase of the ring; the better a pattern is known the more can be said for and against it.

    Args:
        memory: What is remembered.
        pattern: That of `memory`, the robot's left first.
        bumps: What the scan shows.
        at: Where its beams end if dead reckoning is right.
        n_beams: Beams of the whole scan.
    """
    least = wallfit.height_variance(n_beams, _MODEL)[..., None]
    unknown = 2.0 * ringpattern.HARMONICS * _RANGE_VARIANCE / (memory.seen + _BEGUN[1])
    variance = least + unknown[..., None, None, None]
    rest = bumps.height[..., None] - ringpattern.heights(pattern, at, ringbelief.PHASE)
    cost = jnp.minimum(jnp.square(rest) / variance, _CAP) + jnp.log(variance / least)
    return -0.5 * _TEMPER * jnp.sum(jnp.where(bumps.valid[..., None], cost, 0.0), axis=(-3, -2))


def learnt(
    memory: Memory, pattern: Pattern, bumps: Bumps, at: ringpattern.Turns, trust: Float[Array, "*batch"]
) -> tuple[Memory, Pattern]:
    """After a scan.

    Args:
        memory: Before.
        pattern: That of `memory`, the robot's left first.
        bumps: What the scan shows.
        at: Where its beams end.
        trust: Weight of the scan: scans of usual distance from one another.

    Returns:
        Memory, with its pattern as it was, and the new pattern, the robot's left first.
    """
    expected = ringpattern.heights(pattern, at, np.zeros(1, np.float32))[..., 0]
    rest = jnp.where(bumps.valid, bumps.height - expected, 0.0)
    gain = jnp.maximum(_FORGET, 1.0 / (memory.seen + _BEGUN[0])) * jnp.minimum(trust, 1.0)
    count = jnp.maximum(jnp.sum(bumps.valid, axis=(-2, -1)), 1)
    noise = memory.noise + gain * (jnp.sum(jnp.square(rest), axis=(-2, -1)) / count - memory.noise)
    return Memory(memory.pattern, memory.seen + trust, noise), ringpattern.learnt(pattern, rest, at, gain)


def strength(memory: Memory, side: int) -> Float[Array, "*batch"]:
    """How clearly a pattern stands out of the noise, between 0 and 1; `side` beams look at each wall."""
    kept = jnp.maximum(0.5 * _FORGET, 1.0 / (memory.seen + 1.0))
    left_over = 4.0 * ringpattern.HARMONICS / max(side, 1) * memory.noise * kept
    power, (least, steep) = ringpattern.power(memory.pattern), _CLEAR
    return jnp.clip(steep * (power - least * left_over) / (power + 1e-9), 0.0, 1.0)
