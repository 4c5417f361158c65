"""Counting rings through faults, without a map: a bank of Bayes filters of error and grip, with learnt patterns.

Dead reckoning is wrong by some percent. On wet rail 30 % of the speed is lost while
wheels and odometer turn as before, beams drop out or end in dust, and observations are late. Here the error of dead
reckoning is a belief on a grid with two modes, dry and wet rail (`bank`). The walls are tracked past unusable beams
(`walls`). The delay shows when the robot sets off (`reckoning`).

Before a pattern is known, wet rail cannot be distinguished from dry, and a pattern learnt then stays wrong. Therefore
there are two filters, one that begins on dry rail and one that begins on wet rail. The one whose pattern fits the scans
better is used. Neither the severity of an episode nor the position of wet rail is known to them.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.baselines.agent import Known, Observed
from subterra_jax.baselines.avoidance import steering_of
from subterra_jax.baselines.fused import Belief, FusedCount
from subterra_jax.baselines.navigator import Navigator
from subterra_jax.baselines.reckoning import (
    Delay,
    StepDistances,
    advance_delay,
    begin_delay,
    delayed_distance,
    seems_still,
)
from subterra_jax.baselines.rings import bank
from subterra_jax.baselines.rings.walls import Bumps, Walls, begin_walls, track_walls
from subterra_jax.baselines.stations import Driven, Localiser, Station, believed_start, fault_sizes
from subterra_jax.baselines.steering import CentreLine, PacedSteering
from subterra_jax.parts.faults import FaultParams
from subterra_jax.state import EnvParams

WET_LOSS = FaultParams().wet_loss  # nominal share of the speed lost on wet rail
_WETTING, _DRYING = 0.02, 0.08  # 1/m; patches are 10 m long
_HOLD = 8.0  # m after the start, in which the pattern is learnt and the grip does not change
_BLUR = 0.01  # standard deviation of dead reckoning in a step of the usual length, m
_LEAST_MOVE = 0.05  # m; a scan after less counts in part: it shares the errors of the scan before
_RATE_GAIN, _RATE_MOST = 0.1, 0.08
_RATE_NEWS = 0.1  # largest news of one scan, m
_BEGINS_WET = 0.15  # probability that the start is wet
_LEARNING, _SLOW = 15.0, 0.5  # distance in which rings are learnt, m, and the speed there, m/s: four scans for one
_CRUISE = 1.2  # m/s: a patch of wet rail takes less from a step than a scan can measure
_LOCKED = 0.1  # error of the pattern itself, m: it was learnt while the start was left behind


@struct.dataclass
class GridTrack:
    """Rings, station and grip of a batch of robots. A bank is one filter: the first began on dry rail, the second wet.

    Attributes:
        station: Estimated station less that of the start, m: the present one, past the delay of observations.
        reckoned: Station less that of the start by dead reckoning alone, m.
        rate: Estimated relative error of the dead reckoning.
        innovation: Excess of the station by the last scan, m.
        strength: Clarity of the pattern, from 0, no pattern, to 1.
        spread: Standard deviation of the station by the belief, m.
        wet: Probability of wet rail.
        driven: Distance driven, m.
        walls: The tracked walls.
        lag: Delay of the observations.
        base: Station at the middle of each bank's grid, m.
        belief: Belief about the true station beyond it, dry and wet.
        rates: Estimated relative error of dead reckoning of each bank.
        evidence: Log evidence of each bank, less that of the best.
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
    walls: Walls
    lag: Delay
    base: Float[Array, "*env bank"]
    belief: Float[Array, "*env bank 2 cells"]
    rates: Float[Array, "*env bank"]
    evidence: Float[Array, "*env bank"]
    memory: bank.PatternMemory


def start(batch: tuple[int, ...], n_beams: int, wet: bool = True) -> GridTrack:
    """Return the track at the start, without a pattern; `wet` where the rail may be wet there, at twice the cost."""
    zero, banks = jnp.zeros(batch), (False, True) if wet else (False,)
    each = jnp.zeros((*batch, len(banks)))
    odds = (0.0, math.log(_BEGINS_WET / (1.0 - _BEGINS_WET)))[: len(banks)]
    return GridTrack(
        **dict.fromkeys(("station", "reckoned", "rate", "innovation", "strength", "spread", "wet", "driven"), zero),
        walls=begin_walls(batch, n_beams),
        lag=begin_delay(batch),
        base=each,
        belief=jnp.stack([bank.begin_belief(batch, is_wet) for is_wet in banks], axis=-3),
        rates=each,
        evidence=each + jnp.asarray(odds),
        memory=bank.empty_memory(each.shape),
    )


def restart(track: GridTrack, keep: Float[Array, "*env"]) -> GridTrack:
    """Return the track where `keep` is 1, and one at the start where it is 0."""
    fresh = start((), 1, wet=track.base.shape[-1] > 1)
    fresh = dataclasses.replace(fresh, walls=jax.tree.map(lambda part: jnp.zeros(()), track.walls))

    def choose(now: Array, begun: Array) -> Array:
        return jnp.where(keep.reshape(keep.shape + (1,) * (now.ndim - keep.ndim)) > 0.0, now, begun)

    return jax.tree.map(choose, track, fresh)


def advance(
    track: GridTrack,
    ranges: Float[Array, "*env n_beams"],
    moved: StepDistances,
    direction: Float[Array, "*env"],
    pitch: Float[Array, "*env"],
    loss: float | Float[Array, ""] = WET_LOSS,
) -> GridTrack:
    """Advances by a scan.

    Args:
        track: Track before.
        ranges: The scan, m, the first beam straight ahead, the others counter-clockwise.
        moved: Distance since the last scan along the axis, by command and odometer.
        direction: 1 where the robot faces growing stations, else −1.
        pitch: Distance between rings, m; 0 where there are none, which leaves dead reckoning.
        loss: Share of the speed lost on wet rail; 0 where there is none.
    """
    step, unobserved, lag = advance_delay(track.lag, moved)
    share = jnp.minimum(jnp.abs(step) / bank.STEP, 2.0)
    walls, bumps = track_walls(track.walls, ranges, share)
    scanned = dataclasses.replace(track, walls=walls, lag=lag, driven=track.driven + jnp.abs(step))
    # From here on everything has an axis of banks.
    relief = jax.tree.map(lambda part: part[..., None, :, :], bumps)
    drive = _Drive.of(step, share, direction, pitch, loss)
    after, estimates = _advance_banks(scanned, relief, drive, ranges.shape[-1])
    pending = drive.direction * unobserved[..., None] * (1.0 + after.rates)
    station = estimates.station + pending * (1.0 - drive.loss * estimates.wet)
    best = jnp.argmax(after.evidence, axis=-1)[..., None]
    of_best = lambda each: jnp.take_along_axis(each, best, axis=-1)[..., 0]  # noqa: E731
    weight = jax.nn.softmax(after.evidence, axis=-1)
    variance = jnp.square(estimates.spread) + jnp.square(station - of_best(station)[..., None])
    reckoned = track.reckoned + direction * (step + unobserved - delayed_distance(track.lag))
    return dataclasses.replace(
        after,
        station=of_best(station),
        reckoned=reckoned,
        rate=of_best(after.rates),
        innovation=of_best(estimates.innovation),
        strength=of_best(estimates.strength),
        spread=jnp.sqrt(jnp.sum(weight * variance, axis=-1)),
        wet=of_best(estimates.wet),
    )


@struct.dataclass
class _Drive:
    """One step of all banks: distance (m, and in usual steps), direction, pitch (m), presence of rings, loss."""

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
class _Estimates:
    """Estimates of each bank: observed station (m), innovation (m), strength, spread (m), probability of wet rail."""

    station: Array
    innovation: Array
    strength: Array
    spread: Array
    wet: Array


def _advance_banks(track: GridTrack, relief: Bumps, drive: _Drive, n_beams: int) -> tuple[GridTrack, _Estimates]:
    """Each bank after a step and a scan, and its estimates."""
    cell = drive.pitch / bank.PHASES
    driven = drive.direction * drive.step * (1.0 + track.rates)
    base = track.base + driven
    # Where wet rail loses nothing it is treated as dry.
    changes = jnp.where((track.driven[..., None] > _HOLD) & (drive.loss > 0.0), jnp.abs(drive.step), 0.0)
    lost, blur = drive.loss * driven / cell, jnp.square(_BLUR / cell) * drive.share * drive.rings
    prior = bank.predict(track.belief, lost, _WETTING * changes, _DRYING * changes, blur)
    pattern = bank.orient(track.memory.pattern, drive.direction)
    strong = bank.pattern_strength(track.memory, relief.height.shape[-1]) * drive.rings
    at = bank.ring_phases(base, relief, drive.direction, drive.pitch)
    trust = jnp.clip(jnp.abs(drive.step) / _LEAST_MOVE, 0.0, 1.0) * drive.rings
    likely = trust[..., None] * bank.log_likelihood(track.memory, pattern, relief, at, n_beams)
    belief, evidence = bank.correct(prior, likely)
    before, after = bank.summarise(prior), bank.summarise(belief)
    news = cell * (after.dry_error - before.dry_error)
    rate = _rate(track.rates, drive, jnp.square(1.0 - after.wet) * news)
    station = base + cell * after.error
    at = bank.ring_phases(station, relief, drive.direction, drive.pitch)
    weight = drive.share * jnp.square(after.sharpness) * drive.rings
    memory, pattern = bank.learn(track.memory, pattern, relief, at, weight)
    memory = dataclasses.replace(memory, pattern=bank.orient(pattern, drive.direction))
    belief, moved_by = bank.recentre(belief, after.error)
    evidence = track.evidence + evidence
    banks = dataclasses.replace(
        track,
        base=base + cell * moved_by,
        belief=belief,
        rates=rate,
        evidence=evidence - jnp.max(evidence, axis=-1, keepdims=True),
        memory=memory,
    )
    return banks, _Estimates(station, -news, strong, cell * after.spread, after.wet)


def _rate(rate: Array, drive: _Drive, news: Array) -> Array:
    """Rates after a scan that moved the station on dry rail by `news`, m."""
    news = jnp.clip(news, -_RATE_NEWS, _RATE_NEWS)
    return jnp.clip(rate + _RATE_GAIN * drive.share * drive.direction * news, -_RATE_MOST, _RATE_MOST)


@struct.dataclass
class RingMemory:
    """Memory of the ring filter.

    Attributes:
        start: Believed station of the start, m, and its standard deviation.
        track: The rings.
        reckoning: Estimate by commands and odometry.
    """

    start: Float[Array, "2"]
    track: GridTrack
    reckoning: Belief


@struct.dataclass
class RingFilter(Localiser):
    """Counts rings where the walls have any, on wet rail too, and falls back on commands and odometry elsewhere.

    Attributes:
        wet: Whether the task may have wet rail, as its params say.
    """

    wet: bool = struct.field(pytree_node=False, default=True)

    def begin(self, obs: Observed, params: EnvParams) -> RingMemory:
        """Begins at the believed start."""
        believed = jnp.stack([jnp.asarray(value, jnp.float32) for value in believed_start(obs, params)])
        return RingMemory(believed, start((), obs.ranges.shape[-1], self.wet), FusedCount().begin(obs, params))

    def update(
        self, memory: RingMemory, obs: Observed, driven: Driven, params: EnvParams, known: Known
    ) -> tuple[Station, RingMemory]:
        """Advances by dead reckoning and a scan."""
        fused, reckoning = FusedCount().update(memory.reckoning, obs, driven, params, known)
        commanded = driven.speed * params.vehicle.period
        read = obs.distance - memory.reckoning.reading
        if obs.start is not None:
            read = jnp.where(seems_still(read, commanded), 0.0, read)
        moved = StepDistances(commanded, read) * driven.cosine
        pitch = jnp.asarray(obs.ring_pitch)
        loss = fault_sizes(params).wet_loss if self.wet else 0.0
        track = advance(memory.track, obs.ranges, moved, driven.direction, pitch, loss)
        locked, lost = jnp.hypot(track.spread, _LOCKED), jnp.exp(fused.log_sigma)
        sigma = jnp.hypot(track.strength * locked + (1.0 - track.strength) * lost, memory.start[1])
        estimate = Station(memory.start[0] + track.station, jnp.log(sigma), driven.direction)
        return estimate, dataclasses.replace(memory, track=track, reckoning=reckoning)


def ring_filter(params: EnvParams) -> Navigator:
    """Makes the agent of a task."""
    steering = PacedSteering(steering_of(params, CentreLine()), _CRUISE, _SLOW, _LEARNING)
    return Navigator(RingFilter(wet="faults" in params.parts), steering, name="ring-filter")
