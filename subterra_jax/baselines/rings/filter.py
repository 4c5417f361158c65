"""Counting rings through faults, without a map: Bayes filters of error and grip, each with a pattern that it learns.

Dead reckoning is wrong by some percent. On wet rail 30 % of the speed is lost while wheels and odometer turn as before,
beams drop out or end in dust, and observations are late. Here the error of dead reckoning is a belief on a grid with
two modes, dry and wet rail. The walls are tracked past unusable beams (`walls`), the delay shows when the robot sets
off (`reckoning`).

Before a pattern is known, wet rail cannot be distinguished from dry, and a pattern learnt then stays wrong. Therefore
there are two hypotheses, one that begins on dry rail and one that begins on wet rail. The one whose pattern fits the
scans better is used. Neither the severity of an episode nor the position of wet rail is known to them.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.baselines.agent import Known, Observed
from subterra_jax.baselines.avoidance import steering_of
from subterra_jax.baselines.bayes import diffuse
from subterra_jax.baselines.fused import Belief, FusedCount
from subterra_jax.baselines.navigator import Navigator, Pace
from subterra_jax.baselines.reckoning import Reckoning, begin_reckoning, reckon, unobserved_distance
from subterra_jax.baselines.rings import pattern as rings
from subterra_jax.baselines.rings.pattern import Pattern
from subterra_jax.baselines.rings.walls import Bumps, Walls, begin_walls, track_walls
from subterra_jax.baselines.stations import Driven, Localiser, Station, believed_start, fault_sizes
from subterra_jax.baselines.steering import CentreLine
from subterra_jax.parts.faults import FaultParams
from subterra_jax.state import EnvParams

PHASES, RINGS = 48, 5  # cells of one ring, rings
CELLS = PHASES * RINGS
CELL = (np.arange(CELLS) - CELLS // 2).astype(np.float32)  # 0 is where dead reckoning is right
TURNS = CELL[:PHASES] / PHASES  # phases of the cells of one ring
_MOST = 6.0  # cells by which one step moves the grid

WET_LOSS = FaultParams().wet_loss  # nominal share of the speed lost on wet rail
_ODOMETER_SHARE = 0.6  # its errors and the command's are independent: 2 % + 1 % and 2 % + 2 %
_STEP = 0.2  # distance of one usual step, the unit of gains, m
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

Grid = Float[Array, "2 cells"]  # probability of an error of dead reckoning, in cells, on dry and on wet rail


@struct.dataclass
class Hypothesis:
    """Rings, station and grip, as one believes who began on dry rail, or on wet."""

    base: Float[Array, "*bank"]  # station less that of the start at the middle of the grid, m
    belief: Float[Array, "*bank 2 cells"]  # belief about the true station beyond it
    rate: Float[Array, "*bank"]  # estimated relative error of dead reckoning, 1
    evidence: Float[Array, "*bank"]  # log evidence, less that of the best hypothesis
    pattern: Pattern  # pattern of the rings, the tunnel's left first


@struct.dataclass
class Estimate:
    """Estimate of a hypothesis."""

    station: Float[Array, "*bank"]  # station less that of the start, m: the present one, past the delay of observations
    spread: Float[Array, "*bank"]  # standard deviation of the station, m
    strength: Float[Array, "*bank"]  # clarity of the pattern, from 0, no pattern, to 1
    wet: Float[Array, "*bank"]  # probability of wet rail


@struct.dataclass
class RingTrack:
    """Estimate by the rings."""

    walls: Walls  # the tracked walls
    driven: Float[Array, ""]  # distance driven, m
    bank: Hypothesis  # the hypotheses: the first began on dry rail, the second, if any, on wet
    estimate: Estimate  # estimate of the best; its spread is that of all


def start(n_beams: int, wet: bool = True) -> RingTrack:
    """Return the track at the start, without a pattern; `wet` where the rail may be wet there, at twice the cost."""
    odds = (0.0, math.log(_BEGINS_WET / (1.0 - _BEGINS_WET)))

    def hypothesis(is_wet: int) -> Hypothesis:
        zero, nowhere = jnp.zeros(()), jnp.zeros((2, CELLS))
        belief = nowhere.at[is_wet, CELLS // 2].set(1.0)
        return Hypothesis(zero, belief, zero, zero + odds[is_wet], rings.empty_pattern())

    bank = jax.tree.map(lambda *each: jnp.stack(each), *[hypothesis(is_wet) for is_wet in range(2 if wet else 1)])
    return RingTrack(begin_walls(n_beams), jnp.zeros(()), bank, Estimate(*jnp.zeros((4,))))


@struct.dataclass
class _Drive:
    """One step: distance (m, and in usual steps), distance not observed yet (m), direction, pitch (m), rings or none.

    And the share of the speed lost on wet rail, and the distance on which rail may become wet or dry, m.
    """

    step: Array
    share: Array
    pending: Array
    direction: Array
    pitch: Array
    rings: Array
    loss: Array
    changes: Array


def advance(
    track: RingTrack,
    ranges: Float[Array, "n_beams"],
    step: Float[Array, ""],
    direction: Float[Array, ""],
    pitch: Float[Array, ""],
    loss: float | Float[Array, ""] = WET_LOSS,
    pending: float | Float[Array, ""] = 0.0,
) -> RingTrack:
    """Advance by a scan.

    Args:
        track: Track before.
        ranges: The scan, m, the first beam straight ahead, the others counter-clockwise.
        step: Dead-reckoned distance since the last scan along the axis, m.
        direction: 1 where the robot faces growing stations, else -1.
        pitch: Distance between rings, m; 0 where there are none, which leaves dead reckoning.
        loss: Share of the speed lost on wet rail; 0 where there is none.
        pending: Distance driven since that the scan does not show yet, m.
    """
    share, has_rings = jnp.minimum(jnp.abs(step) / _STEP, 2.0), pitch > 0.0
    walls, bumps = track_walls(track.walls, ranges, share)
    driven, loss = track.driven + jnp.abs(step), jnp.where(has_rings, loss, 0.0)
    # Where wet rail loses nothing it is treated as dry.
    changes = jnp.where((driven > _HOLD) & (loss > 0.0), jnp.abs(step), 0.0)
    pitch = jnp.where(has_rings, pitch, 1.0)
    drive = _Drive(step, share, jnp.asarray(pending), direction, pitch, has_rings, loss, changes)
    bank, each = jax.vmap(lambda one: _advance_one(one, bumps, drive, ranges.shape[0]))(track.bank)
    bank = dataclasses.replace(bank, evidence=bank.evidence - jnp.max(bank.evidence))
    best = jnp.argmax(bank.evidence)
    variance = jnp.square(each.spread) + jnp.square(each.station - each.station[best])
    spread = jnp.sqrt(jnp.sum(jax.nn.softmax(bank.evidence) * variance))
    estimate = dataclasses.replace(jax.tree.map(lambda leaf: leaf[best], each), spread=spread)
    return RingTrack(walls, driven, bank, estimate)


def _advance_one(now: Hypothesis, bumps: Bumps, drive: _Drive, n_beams: int) -> tuple[Hypothesis, Estimate]:
    cell = drive.pitch / PHASES
    driven = drive.direction * drive.step * (1.0 + now.rate)
    base = now.base + driven
    blur = jnp.square(_BLUR / cell) * drive.share * drive.rings
    prior = predict(now.belief, drive.loss * driven / cell, _WETTING * drive.changes, _DRYING * drive.changes, blur)
    pattern = now.pattern.facing(drive.direction)
    strength = rings.strength(pattern, bumps.height.shape[1]) * drive.rings
    at = rings.waves_at(base, bumps, drive.direction, drive.pitch)
    trust = jnp.clip(jnp.abs(drive.step) / _LEAST_MOVE, 0.0, 1.0) * drive.rings
    likely = trust * rings.log_likelihood(pattern, bumps, at, rings.waves(TURNS), n_beams)
    belief, evidence = correct(prior, likely)
    before, after = summarise(prior), summarise(belief)
    # What a scan says of dry rail alone tells the error of dead reckoning.
    news = jnp.square(1.0 - after.wet) * cell * (after.dry_error - before.dry_error)
    rate = now.rate + _RATE_GAIN * drive.share * drive.direction * jnp.clip(news, -_RATE_NEWS, _RATE_NEWS)
    rate = jnp.clip(rate, -_RATE_MOST, _RATE_MOST)
    station = base + cell * after.error
    at = rings.waves_at(station, bumps, drive.direction, drive.pitch)
    pattern = rings.learn(pattern, bumps, at, drive.share * jnp.square(after.sharpness) * drive.rings)
    belief, moved_by = recentre(belief, after.error)
    pending = drive.direction * drive.pending * (1.0 + rate) * (1.0 - drive.loss * after.wet)
    kept = Hypothesis(base + cell * moved_by, belief, rate, now.evidence + evidence, pattern.facing(drive.direction))
    return kept, Estimate(station + pending, cell * after.spread, strength, after.wet)


def predict(belief: Grid, lost: Array, wetting: Array, drying: Array, blur: Array) -> Grid:
    """Predict a belief after a step.

    Args:
        belief: Belief before.
        lost: Distance lost on wet rail in the step, cells.
        wetting: Probability that dry rail ends in it.
        drying: Probability that wet rail ends in it.
        blur: Variance added by dead reckoning, cells².
    """
    whole = jnp.floor(lost)
    part, first = lost - whole, whole.astype(jnp.int32)
    dry, wet = belief[0], (1.0 - part) * _take(belief[1], first) + part * _take(belief[1], first + 1)
    mixed = jnp.stack([dry + drying * wet - wetting * dry, wet + wetting * dry - drying * wet])
    return diffuse(mixed, blur, beyond="constant")


def correct(belief: Grid, log_likelihood: Float[Array, "phases"]) -> tuple[Grid, Float[Array, ""]]:
    """Correct a belief by a scan, whose likelihood is the same at every ring; and return the log evidence."""
    most = jnp.max(log_likelihood)
    weighted = belief * jnp.tile(jnp.exp(log_likelihood - most), RINGS)
    before, after = jnp.sum(belief), jnp.sum(weighted)
    return weighted / (after + 1e-30), most + jnp.log(after + 1e-30) - jnp.log(before + 1e-30)


@struct.dataclass
class BeliefSummary:
    """Estimates by a belief, in cells and shares."""

    error: Float[Array, ""]  # mean within half a ring of the likeliest cell, cells
    spread: Float[Array, ""]  # standard deviation of the whole belief, cells
    sharpness: Float[Array, ""]  # certainty of the phase: 1 known, 0 unknown
    wet: Float[Array, ""]  # probability of wet rail
    dry_error: Float[Array, ""]  # mean for dry rail, cells


def summarise(belief: Grid) -> BeliefSummary:
    """Summarise a normalised belief."""
    mean = lambda weight: jnp.sum(weight * CELL) / (jnp.sum(weight) + 1e-30)  # noqa: E731
    either = jnp.sum(belief, axis=0)
    near = jnp.abs(jnp.arange(CELLS) - jnp.argmax(either)) <= PHASES // 2
    error = mean(jnp.where(near, either, 0.0))
    spread = jnp.sqrt(jnp.sum(either * jnp.square(CELL - error)))
    turn = 2.0 * np.pi * CELL / PHASES
    sharpness = jnp.hypot(jnp.sum(either * np.cos(turn)), jnp.sum(either * np.sin(turn)))
    return BeliefSummary(error, spread, sharpness, jnp.sum(belief[1]), mean(belief[0]))


def recentre(belief: Grid, error: Float[Array, ""]) -> tuple[Grid, Float[Array, ""]]:
    """Shift a belief by whole cells so that an error lies at 0; and return the number of cells."""
    cells = jnp.clip(jnp.round(error), -_MOST, _MOST)
    return _take(belief, cells.astype(jnp.int32)), cells


def _take(values: Float[Array, "*mode cells"], cells: Array) -> Float[Array, "*mode cells"]:
    """Values shifted towards lower cells by whole cells, 0 from outside the grid."""
    index = jnp.arange(CELLS) + cells
    inside = (index >= 0) & (index < CELLS)
    return jnp.where(inside, values[..., jnp.clip(index, 0, CELLS - 1)], 0.0)


@struct.dataclass
class RingMemory:
    """Memory of the ring filter."""

    start: Float[Array, "2"]  # believed station of the start, m, and its standard deviation
    track: RingTrack  # the rings
    reckoning: Reckoning  # dead reckoning, with the delay of observations
    fused: Belief  # estimate by commands and odometry


@struct.dataclass
class RingFilter(Localiser):
    """Counts rings where the walls have any, on wet rail too, and falls back on commands and odometry elsewhere."""

    wet: bool = struct.field(pytree_node=False, default=True)  # whether the task may have wet rail, as its params say

    def begin(self, obs: Observed, params: EnvParams) -> RingMemory:
        believed = jnp.stack([jnp.asarray(value, jnp.float32) for value in believed_start(obs, params)])
        track = start(obs.ranges.shape[0], self.wet)
        return RingMemory(believed, track, begin_reckoning(obs), FusedCount().begin(obs, params))

    def update(
        self, memory: RingMemory, obs: Observed, driven: Driven, params: EnvParams, known: Known
    ) -> tuple[Station, RingMemory]:
        period = jnp.asarray(params.vehicle.period)
        counted, fused = FusedCount().update(memory.fused, obs, driven, params, known)
        distance, _, reckoning = reckon(memory.reckoning, obs, driven.speed, _ODOMETER_SHARE, period)
        track = advance(
            memory.track,
            obs.ranges,
            distance * driven.cosine,
            driven.direction,
            jnp.asarray(obs.ring_pitch),
            fault_sizes(params).wet_loss if self.wet else 0.0,
            unobserved_distance(reckoning, period) * driven.cosine,
        )
        found, lost = track.estimate, jnp.exp(counted.log_sigma)
        locked = jnp.hypot(found.spread, _LOCKED)
        sigma = jnp.hypot(found.strength * locked + (1.0 - found.strength) * lost, memory.start[1])
        estimate = Station(memory.start[0] + found.station, jnp.log(sigma), driven.direction)
        return estimate, RingMemory(memory.start, track, reckoning, fused)


def ring_filter(params: EnvParams) -> Navigator:
    """Makes the agent of a task."""
    localiser, steering = RingFilter(wet="faults" in params.parts), steering_of(params, CentreLine())
    return Navigator(localiser, steering, name="ring-filter", pace=Pace(_CRUISE, _SLOW, _LEARNING))
