"""Counting rings without a map: a phase-locked loop on the pattern of pockets and joints in the side beams.

The walls repeat with every ring. Their relief in a scan is compared with the pattern seen so far, kept as the first
harmonics of the ring's pitch for each wall. A pattern seen early or late by a few centimetres shows the error of dead
reckoning. That error grows slowly, so no ring is ever skipped or counted twice. The pattern is learnt on the way,
from the start, whose station is known.
"""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.baselines.reckoning import ODOMETER_SHARE
from subterra_jax.baselines.rings.walls import fit_careful, fit_plain, side_beams

HARMONICS = 4  # pockets are 0.2 m long and 0.4 m apart; a fifth harmonic adds more noise than information
_GAIN, _RATE_GAIN = 0.12, 0.006  # of the loop, per `_STEP`
_STEP = 0.15  # distance of one usual step, the unit of gains and averages, m
_FORGET = 0.004  # least gain of the pattern, small: a pattern that drifts takes the station with it
_USUAL = 0.05  # gain of the usual relief, such as that of a bend
_TRUST = 100.0  # in units of `_STEP`: distance over which a pattern is trusted before its noise is known
_CLEAR = 1.3, 3.0  # noise threshold, in units of what an average leaves of it, and the slope of strength above it
_GIVE_UP = 0.02  # share of the correction lost per `_STEP` without a pattern
_SETTLING = 2.0  # m after the start in which the usual relief is learnt faster
_RATE_MOST = 0.1


@struct.dataclass
class RingTrack:
    """Rings and station of a batch of robots.

    Attributes:
        station: Estimated station less that of the start, m.
        reckoned: Station less that of the start by dead reckoning alone, m.
        rate: Estimated relative error of the dead reckoning.
        pattern: Harmonics of each wall, real and imaginary part, m; left first.
        seen: Distance over which the pattern was averaged, in units of 0.15 m.
        noise: Power of the residual of a single scan, m².
        usual: Average relief of each side beam against a straight wall, m.
        innovation: Correction by the last scan, m.
        strength: Clarity of the pattern, from 0, no pattern, to 1.
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
    """Return the track at the start, without a pattern."""
    zero, side = jnp.zeros(batch), len(side_beams(n_beams, n_beams)[0][0])
    return RingTrack(
        **dict.fromkeys(("station", "reckoned", "rate", "seen", "noise", "innovation", "strength", "driven"), zero),
        pattern=jnp.zeros((*batch, 2, HARMONICS, 2)),
        usual=jnp.zeros((*batch, 2, side)),
    )


def fuse_distances(commanded: Float[Array, "*env"], read: Float[Array, "*env"]) -> Float[Array, "*env"]:
    """Fuses the distances of command and odometer since the last scan, m.

    Args:
        commanded: Distance by the command, m.
        read: Distance by the odometer, m; exactly 0 from one that has stopped counting, since a reading has noise.
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
    """Advances by a scan.

    Args:
        track: Track before.
        ranges: The scan, m, the first beam straight ahead, the others counter-clockwise.
        moved: Dead-reckoned distance since the last scan, m.
        direction: 1 where the robot faces growing stations, else −1.
        pitch: Distance between rings, m; 0 where there are none, which leaves dead reckoning.
        careful: Whether `fit_careful` reads the scan, which ignores obstacles, instead of `fit_plain`, with which the
            first released policies were trained.
    """
    reckoned = track.reckoned + direction * moved
    station = track.station + direction * moved * (1.0 + track.rate)
    share = jnp.minimum(jnp.abs(moved) / _STEP, 2.0)
    bumps = fit_careful(ranges) if careful else fit_plain(ranges)
    bump, along, valid = bumps.height, bumps.along, bumps.valid
    driven = track.driven + jnp.abs(moved)
    learning = _USUAL * share + jnp.where(driven < _SETTLING, 0.1, 0.0)
    usual = track.usual + learning[..., None, None] * (bump - track.usual) * valid
    turn = 2.0 * jnp.pi / jnp.where(pitch > 0.0, pitch, 1.0)
    end = station[..., None, None] + direction[..., None, None] * along
    scanned = _harmonics((bump - track.usual) * valid, turn[..., None, None] * end)
    # The left wall of the tunnel is on the robot's right on the way back.
    scanned = jnp.where((direction > 0.0)[..., None, None, None], scanned, jnp.flip(scanned, axis=-3))
    average = jnp.minimum(jnp.maximum(_FORGET, 1.0 / (track.seen + 1.0)) * share, 1.0)
    # A running mean of weight a keeps a/2 of the power of the noise; a plain mean of n scans keeps 1/n.
    left_over = track.noise * jnp.maximum(0.5 * _FORGET, 1.0 / (track.seen + 1.0))
    innovation, strength = _innovation(track.pattern, scanned, left_over, pitch)
    locked = jnp.where(pitch > 0.0, jnp.where(track.seen < _TRUST, 1.0, strength), 0.0)
    corrected = station - _GAIN * share * locked * innovation
    rate = track.rate - direction * _RATE_GAIN * share * locked * innovation
    keep = 1.0 - _GIVE_UP * share * (1.0 - locked)
    return RingTrack(
        station=reckoned + keep * (corrected - reckoned),
        reckoned=reckoned,
        rate=jnp.clip(keep * rate, -_RATE_MOST, _RATE_MOST),
        pattern=track.pattern + average[..., None, None, None] * (scanned - track.pattern),
        seen=track.seen + share,
        noise=track.noise + average * (_power(scanned - track.pattern) - track.noise),
        usual=usual,
        innovation=innovation,
        strength=strength,
        driven=driven,
    )


def restart(track: RingTrack, keep: Float[Array, "*env"]) -> RingTrack:
    """Return the track where `keep` is 1, and one at the start where it is 0."""
    parts = {field.name: getattr(track, field.name) for field in dataclasses.fields(track)}
    spread = {name: keep.reshape(keep.shape + (1,) * (part.ndim - keep.ndim)) for name, part in parts.items()}
    return RingTrack(**{name: spread[name] * part for name, part in parts.items()})


def _harmonics(bump: Float[Array, "*env 2 side"], phase: Float[Array, "*env 2 side"]) -> Float[Array, "*env 2 k 2"]:
    """Mean of `bump · exp(−i k phase)` over a side's beams, for k from 1."""
    cosine, sine = jnp.cos(phase), jnp.sin(phase)
    real, imaginary, harmonics = cosine, -sine, []
    for _ in range(HARMONICS):
        harmonics.append(jnp.stack([jnp.mean(bump * real, axis=-1), jnp.mean(bump * imaginary, axis=-1)], axis=-1))
        real, imaginary = real * cosine + imaginary * sine, imaginary * cosine - real * sine
    return jnp.stack(harmonics, axis=-2)


def _power(pattern: Float[Array, "*env 2 k 2"]) -> Float[Array, "*env"]:
    """Power of the slope of a pattern over the phase, m²: the k-th harmonic counts k² times."""
    order = jnp.arange(1.0, HARMONICS + 1.0)
    return jnp.sum(jnp.square(order[:, None] * pattern), axis=(-3, -2, -1))


def _innovation(
    pattern: Float[Array, "*env 2 k 2"],
    scanned: Float[Array, "*env 2 k 2"],
    left_over: Float[Array, "*env"],
    pitch: Float[Array, "*env"],
) -> tuple[Float[Array, "*env"], Float[Array, "*env"]]:
    """Excess of the station if this scan is right, to the first order (m), and the strength of the pattern."""
    order = jnp.arange(1.0, HARMONICS + 1.0)
    # Im(pattern · conj(scanned)): seen from a station too large by e, a pattern c exp(ikx) becomes c exp(−ike).
    turned = pattern[..., 1] * scanned[..., 0] - pattern[..., 0] * scanned[..., 1]
    slope, power = jnp.sum(order * turned, axis=(-2, -1)), _power(pattern)
    radians = jnp.clip(slope / (power + 1e-9), -2.0, 2.0)
    least, steep = _CLEAR
    strength = jnp.clip(steep * (power - least * left_over) / (power + 1e-9), 0.0, 1.0)
    return radians * pitch / (2.0 * jnp.pi), strength
