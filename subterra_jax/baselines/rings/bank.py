"""One filter of the bank in `grid`: its belief about the error of dead reckoning, and its pattern of the rings.

The belief is a histogram over ring, phase within the ring, and dry or wet rail. The pattern is the relief of one ring
of the lining, as the first harmonics of the ring's pitch for each wall. It is learnt on the way.
"""

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.baselines.bayes import diffuse
from subterra_jax.baselines.rings.walls import Bumps, height_variance

HARMONICS = 4  # pockets are 0.2 m long and 0.4 m apart; a fifth harmonic adds more noise than information
PHASES, RINGS = 48, 5  # cells of one ring, rings
CELLS = PHASES * RINGS
CELL = (np.arange(CELLS) - CELLS // 2).astype(np.float32)  # 0 is where dead reckoning is right
PHASE = (2.0 * np.pi * (np.arange(PHASES) - CELLS // 2 % PHASES) / PHASES).astype(np.float32)
_TURN = (2.0 * np.pi * CELL / PHASES).astype(np.float32)
_MOST = 6.0  # cells by which one step moves the grid
STEP = 0.2  # distance of one usual step, the unit of gains, m
_MODEL = 0.03  # error of a relief by a few harmonics, m
_RANGE_VARIANCE = 0.05**2  # m²
_TEMPER = 0.5  # errors of neighbouring beams are not independent
_CAP = 9.0  # squared, in standard deviations: the most that one beam may count against a phase
_PRIOR_SCANS = 4.0, 8.0  # scans that a new pattern is worth, for learning it and for its likelihood
_FORGET = 0.002  # least gain of the pattern, small: a pattern that drifts takes the station with it
_CLEAR = 1.3, 3.0  # noise threshold, in units of what an average leaves of it, and the slope of strength above it

Belief = Float[Array, "*batch 2 cells"]
Pattern = Float[Array, "*batch 2 harmonics 2"]


@struct.dataclass
class BeliefSummary:
    """Estimates by a belief, in cells and shares.

    Attributes:
        error: Mean within half a ring of the likeliest cell, cells.
        spread: Standard deviation of the whole belief, cells.
        sharpness: Certainty of the phase: 1 known, 0 unknown.
        wet: Probability of wet rail.
        dry_error: Mean for dry rail, cells.
    """

    error: Float[Array, "*batch"]
    spread: Float[Array, "*batch"]
    sharpness: Float[Array, "*batch"]
    wet: Float[Array, "*batch"]
    dry_error: Float[Array, "*batch"]


def begin_belief(batch: tuple[int, ...], wet: bool) -> Belief:
    """Return the belief that dead reckoning is right, on wet or dry rail."""
    return jnp.zeros((*batch, 2, CELLS)).at[..., int(wet), CELLS // 2].set(1.0)


def predict(
    belief: Belief,
    lost: Float[Array, "*batch"],
    wetting: Float[Array, "*batch"],
    drying: Float[Array, "*batch"],
    blur: Float[Array, "*batch"],
) -> Belief:
    """Predicts the belief after a step.

    Args:
        belief: Belief before; dry first.
        lost: Distance lost on wet rail in the step, cells.
        wetting: Probability that dry rail ends in it.
        drying: Probability that wet rail ends in it.
        blur: Variance added by dead reckoning, cells².
    """
    dry, wet = belief[..., 0, :], _shift(belief[..., 1, :], lost)
    wetting, drying = wetting[..., None], drying[..., None]
    mixed = jnp.stack([dry + drying * wet - wetting * dry, wet + wetting * dry - drying * wet], axis=-2)
    return diffuse(mixed, blur[..., None, None], beyond="constant")


def correct(belief: Belief, log_likelihood: Float[Array, "*batch phases"]) -> tuple[Belief, Float[Array, "*batch"]]:
    """Corrects the belief by a scan, whose likelihood is the same at every ring; and returns the log evidence."""
    most = jnp.max(log_likelihood, axis=-1, keepdims=True)
    likelihood = jnp.tile(jnp.exp(log_likelihood - most), RINGS)
    weighted = belief * likelihood[..., None, :]
    before, after = jnp.sum(belief, axis=(-2, -1)), jnp.sum(weighted, axis=(-2, -1))
    evidence = most[..., 0] + jnp.log(after + 1e-30) - jnp.log(before + 1e-30)
    return weighted / (after[..., None, None] + 1e-30), evidence


def summarise(belief: Belief) -> BeliefSummary:
    """Summarises a normalised belief."""
    either = jnp.sum(belief, axis=-2)
    best = jnp.argmax(either, axis=-1)[..., None]
    near = jnp.where(jnp.abs(jnp.arange(CELLS) - best) <= PHASES // 2, either, 0.0)
    error, dry = _mean(near), _mean(belief[..., 0, :])
    spread = jnp.sqrt(_total(either * jnp.square(CELL - error[..., None])))
    sharpness = jnp.hypot(_total(either * np.cos(_TURN)), _total(either * np.sin(_TURN)))
    return BeliefSummary(error, spread, sharpness, _total(belief[..., 1, :]), dry)


def recentre(belief: Belief, error: Float[Array, "*batch"]) -> tuple[Belief, Float[Array, "*batch"]]:
    """Shifts the belief by whole cells so that an error lies at 0; and returns the number of cells."""
    cells = jnp.clip(jnp.round(error), -_MOST, _MOST)
    return _take(belief, cells[..., None].astype(jnp.int32)), cells


def _shift(values: Float[Array, "*batch cells"], cells: Float[Array, "*batch"]) -> Float[Array, "*batch cells"]:
    """Values shifted towards lower cells by linear interpolation; those that leave the grid are lost."""
    whole = jnp.floor(cells)
    part, first = (cells - whole)[..., None], whole.astype(jnp.int32)
    return (1.0 - part) * _take(values, first) + part * _take(values, first + 1)


def _take(values: Float[Array, "*batch cells"], cells: Array) -> Float[Array, "*batch cells"]:
    """Values shifted by whole cells, 0 from outside the grid."""
    index = jnp.arange(CELLS) + cells[..., None]
    inside = (index >= 0) & (index < CELLS)
    index = jnp.broadcast_to(jnp.clip(index, 0, CELLS - 1), values.shape)
    return jnp.where(inside, jnp.take_along_axis(values, index, axis=-1), 0.0)


def _mean(weight: Float[Array, "*batch cells"]) -> Float[Array, "*batch"]:
    """Mean cell."""
    return _total(weight * CELL) / (_total(weight) + 1e-30)


def _total(values: Float[Array, "*batch cells"]) -> Float[Array, "*batch"]:
    """Sum over the cells."""
    return jnp.sum(values, axis=-1)


@struct.dataclass
class Multiples:
    """Phases in the ring, times 1, 2, … `HARMONICS`.

    Attributes:
        cosine: Cosine of each multiple.
        sine: Sine of each multiple.
    """

    cosine: Float[Array, "harmonics *batch 2 side"]
    sine: Float[Array, "harmonics *batch 2 side"]


def multiples(phase: Float[Array, "*batch 2 side"]) -> Multiples:
    """Return cosines and sines of the multiples of phases, rad."""
    cosine, sine = [jnp.cos(phase)], [jnp.sin(phase)]
    for _ in range(HARMONICS - 1):
        real, imaginary = cosine[-1], sine[-1]
        cosine.append(real * cosine[0] - imaginary * sine[0])
        sine.append(real * sine[0] + imaginary * cosine[0])
    return Multiples(jnp.stack(cosine), jnp.stack(sine))


def pattern_heights(
    pattern: Pattern, at: Multiples, further: Float[np.ndarray, "n"]
) -> Float[Array, "*batch 2 side n"]:
    """Return the heights of the relief at the phases of `at` plus each of `further` (rad), m."""
    total = jnp.zeros((*at.cosine.shape[1:], len(further)))
    for order in range(HARMONICS):
        real, imaginary = pattern[..., order, 0, None], pattern[..., order, 1, None]
        cosine, sine = at.cosine[order], at.sine[order]
        here, aside = real * cosine - imaginary * sine, real * sine + imaginary * cosine
        angle = np.float32(order + 1) * further
        total = total + 2.0 * (here[..., None] * np.cos(angle) - aside[..., None] * np.sin(angle))
    return total


def update_pattern(
    pattern: Pattern, rest: Float[Array, "*batch 2 side"], at: Multiples, gain: Float[Array, "*batch"]
) -> Pattern:
    """Updates the pattern by one scan.

    Args:
        pattern: Pattern before.
        rest: Measured less expected heights, m; 0 for an unused beam.
        at: Phases of the beams' ends.
        gain: Weight of the scan, 1.
    """
    mean = jnp.stack([jnp.mean(rest * at.cosine, axis=-1), -jnp.mean(rest * at.sine, axis=-1)], axis=-1)
    return pattern + gain[..., None, None, None] * jnp.moveaxis(mean, 0, -2)


def pattern_power(pattern: Pattern) -> Float[Array, "*batch"]:
    """Return the mean square of the heights, summed over both walls, m²."""
    return jnp.sum(2.0 * jnp.square(pattern), axis=(-3, -2, -1))


def orient(pattern: Pattern, direction: Float[Array, "*batch"]) -> Pattern:
    """Exchanges the tunnel's left and right for the robot's, or back: they differ where direction is -1."""
    return jnp.where((direction > 0.0)[..., None, None, None], pattern, jnp.flip(pattern, axis=-3))


@struct.dataclass
class PatternMemory:
    """Learnt pattern of the rings.

    Attributes:
        pattern: Harmonics of each wall, real and imaginary part, m; the tunnel's left first.
        seen: Number of scans from which it was learnt.
        noise: Mean square of the residual of a scan, m².
    """

    pattern: Float[Array, "*batch 2 harmonics 2"]
    seen: Float[Array, "*batch"]
    noise: Float[Array, "*batch"]


def empty_memory(batch: tuple[int, ...]) -> PatternMemory:
    """Return the memory before any scan."""
    return PatternMemory(jnp.zeros((*batch, 2, HARMONICS, 2)), jnp.zeros(batch), jnp.zeros(batch))


def ring_phases(
    station: Float[Array, "*batch"], bumps: Bumps, direction: Float[Array, "*batch"], pitch: Float[Array, "*batch"]
) -> Multiples:
    """Return the phases in the ring at which beams end, from a station; `bumps` has all axes of the batch."""
    end = station[..., None, None] + direction[..., None, None] * bumps.along
    return multiples(2.0 * jnp.pi * end / pitch[..., None, None])


def log_likelihood(
    memory: PatternMemory, pattern: Pattern, bumps: Bumps, at: Multiples, n_beams: int
) -> Float[Array, "*batch phases"]:
    """Computes the log likelihood of a scan at each phase of the ring; a well-known pattern makes it sharper.

    Args:
        memory: The learnt pattern.
        pattern: The pattern of `memory`, the robot's left first.
        bumps: Relief in the scan.
        at: Phases of its beams' ends if dead reckoning is right.
        n_beams: Beams of the whole scan.
    """
    least = height_variance(n_beams, _MODEL)[..., None]
    unknown = 2.0 * HARMONICS * _RANGE_VARIANCE / (memory.seen + _PRIOR_SCANS[1])
    variance = least + unknown[..., None, None, None]
    rest = bumps.height[..., None] - pattern_heights(pattern, at, PHASE)
    cost = jnp.minimum(jnp.square(rest) / variance, _CAP) + jnp.log(variance / least)
    return -0.5 * _TEMPER * jnp.sum(jnp.where(bumps.valid[..., None], cost, 0.0), axis=(-3, -2))


def learn(
    memory: PatternMemory, pattern: Pattern, bumps: Bumps, at: Multiples, trust: Float[Array, "*batch"]
) -> tuple[PatternMemory, Pattern]:
    """Learns from a scan.

    Args:
        memory: Memory before.
        pattern: The pattern of `memory`, the robot's left first.
        bumps: Relief in the scan.
        at: Phases of its beams' ends.
        trust: Weight of the scan, in scans of the usual distance.

    Returns:
        Memory, its pattern unchanged, and the new pattern, the robot's left first.
    """
    expected = pattern_heights(pattern, at, np.zeros(1, np.float32))[..., 0]
    rest = jnp.where(bumps.valid, bumps.height - expected, 0.0)
    gain = jnp.maximum(_FORGET, 1.0 / (memory.seen + _PRIOR_SCANS[0])) * jnp.minimum(trust, 1.0)
    count = jnp.maximum(jnp.sum(bumps.valid, axis=(-2, -1)), 1)
    noise = memory.noise + gain * (jnp.sum(jnp.square(rest), axis=(-2, -1)) / count - memory.noise)
    return PatternMemory(memory.pattern, memory.seen + trust, noise), update_pattern(pattern, rest, at, gain)


def pattern_strength(memory: PatternMemory, side: int) -> Float[Array, "*batch"]:
    """Return how clearly a pattern stands out of the noise, in [0, 1]; `side` beams look at each wall."""
    kept = jnp.maximum(0.5 * _FORGET, 1.0 / (memory.seen + 1.0))
    left_over = 4.0 * HARMONICS / max(side, 1) * memory.noise * kept
    power, (least, steep) = pattern_power(memory.pattern), _CLEAR
    return jnp.clip(steep * (power - least * left_over) / (power + 1e-9), 0.0, 1.0)
