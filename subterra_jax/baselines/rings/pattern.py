"""The pattern of the rings: relief of one ring at each wall, as the first harmonics of the ring's pitch."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Complex, Float

from subterra_jax.baselines.rings.walls import Bumps, height_variance

HARMONICS = 4  # pockets are 0.2 m long and 0.4 m apart; a fifth harmonic adds more noise than information
_ORDER = np.arange(1, HARMONICS + 1, dtype=np.float32)
_MODEL = 0.03  # error of a relief by a few harmonics, m
_RANGE_VARIANCE = 0.05**2  # m²
_TEMPER = 0.5  # errors of neighbouring beams are not independent
_CAP = 9.0  # squared, in standard deviations: the most that one beam may count against a phase
_PRIOR_SCANS = 4.0, 8.0  # scans that a new pattern is worth, for learning it and for its likelihood
_FORGET = 0.002  # least gain of the pattern, small: a pattern that drifts takes the station with it
_CLEAR = 1.3, 3.0  # noise threshold, in units of what an average leaves of it, and the slope of strength above it

Waves = Complex[Array, "2 side harmonics"]


@struct.dataclass
class Pattern:
    """A pattern as it was learnt."""

    # harmonics of each wall, m; the left wall first, of the tunnel or of the robot
    harmonics: Complex[Array, "2 harmonics"]
    seen: Float[Array, ""]  # number of scans from which it was learnt
    noise: Float[Array, ""]  # mean square of the residual of a scan, m²

    def facing(self, direction: Float[Array, ""]) -> "Pattern":
        """Exchange left and right of the tunnel for those of the robot, or back: they differ where direction is -1."""
        flipped = jnp.where(direction > 0.0, self.harmonics, self.harmonics[::-1])
        return dataclasses.replace(self, harmonics=flipped)


def empty_pattern() -> Pattern:
    """Return the pattern before any scan."""
    return Pattern(jnp.zeros((2, HARMONICS), jnp.complex64), jnp.zeros(()), jnp.zeros(()))


def waves(turns: Float[Array, "*n"] | Float[np.ndarray, "*n"]) -> Complex[Array, "*n harmonics"]:
    """Return the unit waves of all harmonics at phases in the ring, in turns."""
    phase = (2.0 * jnp.pi) * jnp.mod(turns, 1.0)[..., None] * _ORDER
    return jnp.exp(1j * phase)


def waves_at(station: Float[Array, ""], bumps: Bumps, direction: Float[Array, ""], pitch: Float[Array, ""]) -> Waves:
    """Return the waves where the beams of a scan end that was taken at a station, m."""
    return waves((station + direction * bumps.along) / pitch)


def heights(pattern: Pattern, at: Waves, further: Complex[Array, "n harmonics"]) -> Float[Array, "2 side n"]:
    """Return the heights of the relief at `at`, turned on by each of `further`, m."""
    here = pattern.harmonics[:, None, :] * at
    return 2.0 * jnp.real(jnp.sum(here[:, :, None, :] * further, axis=-1))


def log_likelihood(
    pattern: Pattern, bumps: Bumps, at: Waves, further: Complex[Array, "n harmonics"], n_beams: int
) -> Float[Array, "n"]:
    """Compute the log likelihood of a scan at phases further on; a well-known pattern makes it sharper.

    Args:
        pattern: The pattern, the robot's left first.
        bumps: Relief in the scan.
        at: Waves where its beams end if dead reckoning is right.
        further: Waves of the phases to be compared.
        n_beams: Beams of the whole scan.
    """
    least = height_variance(n_beams, _MODEL)[..., None]
    variance = least + 2.0 * HARMONICS * _RANGE_VARIANCE / (pattern.seen + _PRIOR_SCANS[1])
    rest = bumps.height[..., None] - heights(pattern, at, further)
    cost = jnp.minimum(jnp.square(rest) / variance, _CAP) + jnp.log(variance / least)
    return -0.5 * _TEMPER * jnp.sum(jnp.where(bumps.valid[..., None], cost, 0.0), axis=(0, 1))


def learn(pattern: Pattern, bumps: Bumps, at: Waves, trust: Float[Array, ""]) -> Pattern:
    """Learn from a scan; `trust` is its weight, in scans of the usual distance."""
    expected = heights(pattern, at, jnp.ones((1, HARMONICS)))[..., 0]
    rest = jnp.where(bumps.valid, bumps.height - expected, 0.0)
    gain = jnp.maximum(_FORGET, 1.0 / (pattern.seen + _PRIOR_SCANS[0])) * jnp.minimum(trust, 1.0)
    news = jnp.sum(jnp.square(rest)) / jnp.maximum(jnp.sum(bumps.valid), 1) - pattern.noise
    mean = jnp.mean(rest[..., None] * jnp.conj(at), axis=1)
    return Pattern(pattern.harmonics + gain * mean, pattern.seen + trust, pattern.noise + gain * news)


def strength(pattern: Pattern, side: int) -> Float[Array, ""]:
    """Return how clearly a pattern stands out of the noise, in [0, 1]; `side` beams look at each wall."""
    kept = jnp.maximum(0.5 * _FORGET, 1.0 / (pattern.seen + 1.0))
    left_over = 4.0 * HARMONICS / max(side, 1) * pattern.noise * kept
    power = jnp.sum(2.0 * jnp.square(jnp.abs(pattern.harmonics)))  # mean square of the heights of both walls, m²
    least, steep = _CLEAR
    return jnp.clip(steep * (power - least * left_over) / (power + 1e-9), 0.0, 1.0)
