"""Counting rings through faults, without a map: a Bayes filter of place and grip, and a pattern learnt on the way.

`rings` follows dead reckoning that is out by some percent. On wet rail 30 % of the speed is lost while wheels and
odometer turn as before, beams drop out or end in dust, and what one observes is old. Here the error of dead reckoning
is a belief on a grid (`ringbelief`), dry and wet rail are two modes of it, the walls are fitted past beams that do not
count (`wallfit`), and the age of observations shows when the robot sets off (`ringlag`).

Before a pattern is known nothing tells wet rail from dry, and what is learnt then stays wrong: therefore there are two
such filters, one that begins on dry rail and one that begins on wet rail, and the one counts to whose pattern the scans
keep better. Nothing is told of an episode: neither its severity nor where rail is wet.

Measured: `docs/measurements.md`.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.baselines.rings import bank as ringbank
from subterra_jax.baselines.rings import belief as ringbelief
from subterra_jax.baselines.rings import lag as ringlag
from subterra_jax.baselines.rings import pattern as ringpattern
from subterra_jax.baselines.rings import walls as wallfit
from subterra_jax.baselines.rings.lag import Moved
from subterra_jax.baselines.rings.track import GridTrack, anew, start
from subterra_jax.parts.faults import FaultParams

__all__ = ["WET_LOSS", "GridTrack", "advance", "anew", "moved", "start"]

WET_LOSS = FaultParams().wet_loss  # of the speed, on wet rail; nominal, as the sizes of slip and odometer errors are
_WETTING, _DRYING = 0.02, 0.08  # 1/m; patches are 10 m long
_HOLD = 8.0  # m after the start in which the grip does not change: the pattern is learnt
_BLUR = 0.01  # m, of dead reckoning in a step of the usual length
_LEAST_MOVE = 0.05  # m; of a scan after less only a share is believed: its errors are those of the scan before
_RATE_GAIN, _RATE_MOST = 0.1, 0.08
_RATE_NEWS = 0.1  # m, of one scan


def moved(commanded: Float[Array, "*env"], read: Float[Array, "*env"]) -> Moved:
    """Distance since the last scan by the command and by the odometer, m: as `rings.moved`, but kept apart."""
    return Moved(commanded, read)


def advance(
    track: GridTrack,
    ranges: Float[Array, "*env n_beams"],
    moved: Moved,
    direction: Float[Array, "*env"],
    pitch: Float[Array, "*env"],
    loss: float | Float[Array, ""] = WET_LOSS,
) -> GridTrack:
    """After a scan.

    Args:
        track: Before.
        ranges: The scan, m, the first beam straight ahead, the others counter-clockwise.
        moved: Distance since the last scan along the axis, by command and odometer.
        direction: 1 where the robot faces growing stations, else −1.
        pitch: Distance between rings, m. Where it is 0 there are none, and this is dead reckoning.
        loss: Share of the speed that is lost on wet rail; 0 where there is none.
    """
    step, unseen, lag = ringlag.advance(track.lag, moved)
    share = jnp.minimum(jnp.abs(step) / ringbank.STEP, 2.0)
    walls, bumps = wallfit.look(track.walls, ranges, share)
    seen = dataclasses.replace(track, walls=walls, lag=lag, driven=track.driven + jnp.abs(step))
    # From here on everything has an axis of banks.
    heard = jax.tree.map(lambda part: part[..., None, :, :], bumps)
    drive = _Drive.of(step, share, direction, pitch, loss)
    after, says = _advanced(seen, heard, drive, ranges.shape[-1])
    pending = drive.direction * unseen[..., None] * (1.0 + after.rates)
    station = says.station + pending * (1.0 - drive.loss * says.wet)
    best = jnp.argmax(after.evidence, axis=-1)[..., None]
    chosen = lambda each: jnp.take_along_axis(each, best, axis=-1)[..., 0]  # noqa: E731
    weight = jax.nn.softmax(after.evidence, axis=-1)
    variance = jnp.square(says.spread) + jnp.square(station - chosen(station)[..., None])
    reckoned = track.reckoned + direction * (step + unseen - ringlag.unseen(track.lag))
    return dataclasses.replace(
        after,
        station=chosen(station),
        reckoned=reckoned,
        rate=chosen(after.rates),
        innovation=chosen(says.innovation),
        strength=chosen(says.strength),
        spread=jnp.sqrt(jnp.sum(weight * variance, axis=-1)),
        wet=chosen(says.wet),
    )


@struct.dataclass
class _Drive:
    """One step of all banks: distance (m), the same in usual steps, direction, pitch, whether there are rings, loss."""

    step: Array
    share: Array
    direction: Array
    pitch: Array
    rings: Array
    loss: Array

    @classmethod
    def of(cls, step: Array, share: Array, direction: Array, pitch: Array, loss: float | Array) -> "_Drive":
        rings = pitch > 0.0
        values = (step, share, direction, jnp.where(rings, pitch, 1.0), rings, jnp.where(rings, loss, 0.0))
        return cls(*(jnp.broadcast_to(value, step.shape)[..., None] for value in values))


@struct.dataclass
class _Says:
    """What each bank says: station as observed (m), innovation (m), strength, spread (m), probability of wet rail."""

    station: Array
    innovation: Array
    strength: Array
    spread: Array
    wet: Array


def _advanced(track: GridTrack, heard: wallfit.Bumps, drive: _Drive, n_beams: int) -> tuple[GridTrack, _Says]:
    """Each bank after a step and a scan."""
    cell = drive.pitch / ringbelief.PHASES
    driven = drive.direction * drive.step * (1.0 + track.rates)
    base = track.base + driven
    # Where nothing can be lost, wet rail is dry.
    changes = jnp.where((track.driven[..., None] > _HOLD) & (drive.loss > 0.0), jnp.abs(drive.step), 0.0)
    lost, blur = drive.loss * driven / cell, jnp.square(_BLUR / cell) * drive.share * drive.rings
    prior = ringbelief.predicted(track.belief, lost, _WETTING * changes, _DRYING * changes, blur)
    pattern = ringpattern.sides(track.memory.pattern, drive.direction)
    strong = ringbank.strength(track.memory, heard.height.shape[-1]) * drive.rings
    at = ringbank.phases(base, heard, drive.direction, drive.pitch)
    told = jnp.clip(jnp.abs(drive.step) / _LEAST_MOVE, 0.0, 1.0) * drive.rings
    likely = told[..., None] * ringbank.log_likelihood(track.memory, pattern, heard, at, n_beams)
    belief, evidence = ringbelief.updated(prior, likely)
    before, after = ringbelief.summary(prior), ringbelief.summary(belief)
    news = cell * (after.dry_error - before.dry_error)
    rate = _rate(track.rates, drive, jnp.square(1.0 - after.wet) * news)
    station = base + cell * after.error
    at = ringbank.phases(station, heard, drive.direction, drive.pitch)
    weight = drive.share * jnp.square(after.sharpness) * drive.rings
    memory, pattern = ringbank.learnt(track.memory, pattern, heard, at, weight)
    memory = dataclasses.replace(memory, pattern=ringpattern.sides(pattern, drive.direction))
    belief, moved_by = ringbelief.recentred(belief, after.error)
    evidence = track.evidence + evidence
    banks = dataclasses.replace(
        track,
        base=base + cell * moved_by,
        belief=belief,
        rates=rate,
        evidence=evidence - jnp.max(evidence, axis=-1, keepdims=True),
        memory=memory,
    )
    return banks, _Says(station, -news, strong, cell * after.spread, after.wet)


def _rate(rate: Array, drive: _Drive, news: Array) -> Array:
    """The rate after a scan that moved the station by so much on dry rail."""
    news = jnp.clip(news, -_RATE_NEWS, _RATE_NEWS)
    return jnp.clip(rate + _RATE_GAIN * drive.share * drive.direction * news, -_RATE_MOST, _RATE_MOST)
