"""Counting rings without a map: a phase-locked loop on the pattern that pockets and joints leave in the side beams.

The walls repeat with every ring. Where beams meet them, less what is smooth, is compared with the pattern seen so far,
kept as the first harmonics of the ring's pitch for each wall. A pattern seen early or late by a few centimetres says
that dead reckoning is wrong by as much; since that grows slowly, no ring is ever skipped or counted twice. The pattern
itself is learnt on the way, from the start, whose station is known.

Measured on the family's test split: `docs/measurements.md`.
"""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.baselines.rings import scan as ringscan

# Command and odometry err independently; this is the weight of the second, for slips of 2 % + 2 % and 2 % + 1 %.
ODOMETER_SHARE = 0.6
HARMONICS = 4  # pockets are 0.2 m long and 0.4 m apart; a fifth harmonic adds more noise than it tells
_GAIN, _RATE_GAIN = 0.12, 0.006  # of the loop, per `_STEP`
_STEP = 0.15  # m driven, by which gains and averages are told
_FORGET = 0.004  # of the pattern: one that drifts takes the station with it
_USUAL = 0.05  # of what a beam sees all the time, such as a bend
_TRUST = 100.0  # in units of `_STEP`: so long a pattern is taken for one before it can be told from noise
_CLEAR = 1.3, 3.0  # noise, in units of what an average leaves of it, and how steeply strength rises above it
_GIVE_UP = 0.02  # of what was corrected, per `_STEP` without a pattern
_SETTLING = 2.0  # m after the start in which the usual is learnt faster
_RATE_MOST = 0.1


@struct.dataclass
class RingTrack:
    """What is known of rings and place.

    Attributes:
        station: Estimated station less that of the start, m.
        reckoned: The same by dead reckoning alone, m.
        rate: Estimated relative error of the dead reckoning.
        pattern: Harmonics of each wall, real and imaginary part, m; left first.
        seen: Distance over which the pattern was averaged, in units of 0.15 m.
        noise: Power of what a single scan hears beside the pattern, m².
        usual: What each side beam sees on average beyond a straight wall, m.
        innovation: Correction that the last scan asked for, m.
        strength: Between 0, no pattern, and 1.
        driven: Distance driven, m.
    """

    station: Float[Array, "*env"]
    reckoned: Float[Array, "*env"]
    rate: Float[Array, "*env"]
    pattern: Float[Array, "*env 2 harmonics 2"]
    seen: Float[Array, "*env"]
    noise: Float[Array, "*env"]
    usual: Float[Array, "*env 2 side"]
    innovation: Float[Array, "*env"]
    strength: Float[Array, "*env"]
    driven: Float[Array, "*env"]


def start(batch: tuple[int, ...], n_beams: int) -> RingTrack:
    """At the start, no pattern known."""
    zero, side = jnp.zeros(batch), len(ringscan.side_beams(n_beams)[0][0])
    return RingTrack(
        station=zero,
        reckoned=zero,
        rate=zero,
        pattern=jnp.zeros((*batch, 2, HARMONICS, 2)),
        seen=zero,
        noise=zero,
        usual=jnp.zeros((*batch, 2, side)),
        innovation=zero,
        strength=zero,
        driven=zero,
    )


def moved(commanded: Float[Array, "*env"], read: Float[Array, "*env"]) -> Float[Array, "*env"]:
    """Distance driven since the last scan as command and odometer together have it, m.

    Args:
        commanded: By the command, m.
        read: By the odometer, m; exactly 0 from one that has stopped counting, since a reading has noise.
    """
    share = jnp.where(read == 0.0, 0.0, ODOMETER_SHARE)
    return commanded + share * (read - commanded)


def advance(
    track: RingTrack,
    ranges: Float[Array, "*env n_beams"],
    moved: Float[Array, "*env"],
    direction: Float[Array, "*env"],
    pitch: Float[Array, "*env"],
    careful: bool = False,
) -> RingTrack:
    """After a scan.

    Args:
        track: Before.
        ranges: The scan, m, the first beam straight ahead, the others counter-clockwise.
        moved: Dead-reckoned distance since the last scan, m.
        direction: 1 where the robot faces growing stations, else −1.
        pitch: Distance between rings, m. Where it is 0 there are none, and this is dead reckoning.
        careful: The scan is read by `ringscan.careful`, which sees past what stands in the tunnel, and not by
            `ringscan.plain`, with which the first released policies were trained.
    """
    reckoned = track.reckoned + direction * moved
    station = track.station + direction * moved * (1.0 + track.rate)
    share = jnp.minimum(jnp.abs(moved) / _STEP, 2.0)
    bump, along, valid = ringscan.careful(ranges) if careful else ringscan.plain(ranges)
    driven = track.driven + jnp.abs(moved)
    learning = _USUAL * share + jnp.where(driven < _SETTLING, 0.1, 0.0)
    usual = track.usual + learning[..., None, None] * (bump - track.usual) * valid
    turn = 2.0 * jnp.pi / jnp.where(pitch > 0.0, pitch, 1.0)
    place = station[..., None, None] + direction[..., None, None] * along
    heard = _harmonics((bump - track.usual) * valid, turn[..., None, None] * place)
    # The left wall of the tunnel is on the robot's right on the way back.
    heard = jnp.where((direction > 0.0)[..., None, None, None], heard, jnp.flip(heard, axis=-3))
    average = jnp.minimum(jnp.maximum(_FORGET, 1.0 / (track.seen + 1.0)) * share, 1.0)
    # A running mean with weight a keeps a/2 of the power of what it averages; a plain one of n the n-th part.
    left_over = track.noise * jnp.maximum(0.5 * _FORGET, 1.0 / (track.seen + 1.0))
    innovation, strength = _innovation(track.pattern, heard, left_over, pitch)
    locked = jnp.where(pitch > 0.0, jnp.where(track.seen < _TRUST, 1.0, strength), 0.0)
    corrected = station - _GAIN * share * locked * innovation
    rate = track.rate - direction * _RATE_GAIN * share * locked * innovation
    keep = 1.0 - _GIVE_UP * share * (1.0 - locked)
    return RingTrack(
        station=reckoned + keep * (corrected - reckoned),
        reckoned=reckoned,
        rate=jnp.clip(keep * rate, -_RATE_MOST, _RATE_MOST),
        pattern=track.pattern + average[..., None, None, None] * (heard - track.pattern),
        seen=track.seen + share,
        noise=track.noise + average * (_power(heard - track.pattern) - track.noise),
        usual=usual,
        innovation=innovation,
        strength=strength,
        driven=driven,
    )


def anew(track: RingTrack, keep: Float[Array, "*env"]) -> RingTrack:
    """As it is where `keep` is 1, and as at the start where it is 0."""
    parts = {field.name: getattr(track, field.name) for field in dataclasses.fields(track)}
    spread = {name: keep.reshape(keep.shape + (1,) * (part.ndim - keep.ndim)) for name, part in parts.items()}
    return RingTrack(**{name: spread[name] * part for name, part in parts.items()})


def _harmonics(bump: Float[Array, "*env 2 side"], phase: Float[Array, "*env 2 side"]) -> Float[Array, "*env 2 k 2"]:
    """Mean of `bump · exp(−i k phase)` over a side's beams, for k from 1."""
    cosine, sine = jnp.cos(phase), jnp.sin(phase)
    real, imaginary, found = cosine, -sine, []
    for _ in range(HARMONICS):
        found.append(jnp.stack([jnp.mean(bump * real, axis=-1), jnp.mean(bump * imaginary, axis=-1)], axis=-1))
        real, imaginary = real * cosine + imaginary * sine, imaginary * cosine - real * sine
    return jnp.stack(found, axis=-2)


def _power(pattern: Float[Array, "*env 2 k 2"]) -> Float[Array, "*env"]:
    """Of the slope of a pattern with the phase, m²: the k-th harmonic tells k² as much of the place."""
    order = jnp.arange(1.0, HARMONICS + 1.0)
    return jnp.sum(jnp.square(order[:, None] * pattern), axis=(-3, -2, -1))


def _innovation(
    pattern: Float[Array, "*env 2 k 2"],
    heard: Float[Array, "*env 2 k 2"],
    left_over: Float[Array, "*env"],
    pitch: Float[Array, "*env"],
) -> tuple[Float[Array, "*env"], Float[Array, "*env"]]:
    """By how much the station is too large if this scan is right, to the first order (m), and the strength."""
    order = jnp.arange(1.0, HARMONICS + 1.0)
    # Im(pattern · conj(heard)): heard from a station too large by e, a pattern c exp(ikx) becomes c exp(−ike).
    turned = pattern[..., 1] * heard[..., 0] - pattern[..., 0] * heard[..., 1]
    slope, power = jnp.sum(order * turned, axis=(-2, -1)), _power(pattern)
    radians = jnp.clip(slope / (power + 1e-9), -2.0, 2.0)
    least, steep = _CLEAR
    strength = jnp.clip(steep * (power - least * left_over) / (power + 1e-9), 0.0, 1.0)
    return radians * pitch / (2.0 * jnp.pi), strength
