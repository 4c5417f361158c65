"""Faults that come and go: beams that drop out, dust, an odometer that freezes, stale data, wet rails."""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, UInt32

from subterra_jax.hashing import uniform
from subterra_jax.odometry import OdometryState

N_SEVERITIES = 5
MAX_DELAY = 4  # steps
PATCH = 10.0  # m of rail that are wet or dry as a whole
_WET = 17  # which number of a patch tells


@struct.dataclass
class FaultParams:
    """Faults at severity 4; at severity 0 there are none, in between they are proportionally fewer.

    Attributes:
        severity_low: Least severity of an episode, 0 to 4.
        severity_high: Largest severity of an episode; whole numbers in between are drawn alike.
        dropout_rate: Probability a step that a sector of beams drops out for a while.
        dropout_share: Largest share of the beams that drop out together.
        dropout_steps: Longest time that they stay out, steps.
        dust_rate: Probability that a beam is reflected by dust before it meets the wall.
        freeze_rate: Probability a step that the odometer stops counting for a while.
        freeze_steps: Longest time that it stays so, steps.
        delay: Age of what is observed, steps; at most 4.
        wet_share: Share of the 10 m patches of rail that are wet.
        wet_loss: Share of the speed that is lost on wet rail, while the wheels turn as before.
    """

    severity_low: int = 0
    severity_high: int = 4
    dropout_rate: float = 0.02
    dropout_share: float = 0.75
    dropout_steps: float = 40.0
    dust_rate: float = 0.15
    freeze_rate: float = 0.01
    freeze_steps: float = 30.0
    delay: float = 4.0
    wet_share: float = 0.3
    wet_loss: float = 0.3


@struct.dataclass
class FaultState:
    """Faults of one episode.

    Attributes:
        severity: 0 to 4.
        seed: Tells which patches are wet.
        seen: Position x, y (m), heading (rad), station (m) and odometer readings (m, rad) of the last steps, newest
            first: what is observed is one of them.
        dropout_left: Steps until the sector that has dropped out is back.
        dropout_first: First beam of that sector.
        dropout_count: Its beams.
        freeze_left: Steps until the odometer counts again.
    """

    severity: Float[Array, ""]
    seed: UInt32[Array, ""]
    seen: Float[Array, "5 6"]
    dropout_left: Float[Array, ""]
    dropout_first: Float[Array, ""]
    dropout_count: Float[Array, ""]
    freeze_left: Float[Array, ""]


def sight(
    position: Float[Array, "2"], heading: Float[Array, ""], station: Float[Array, ""], reading: OdometryState
) -> Float[Array, "6"]:
    """A row of `FaultState.seen`."""
    return jnp.concatenate([position, jnp.stack([heading, station, reading.distance, reading.heading])])


def n_step_noise(n_beams: int) -> int:
    """Uniform numbers that one step needs."""
    return 5 + n_beams


def start_faults(
    draw: Float[Array, ""], seed: UInt32[Array, ""], seen: Float[Array, "6"], params: FaultParams
) -> FaultState:
    """An episode without faults as yet; `draw` is uniform in [0, 1) and gives the severity."""
    low, high = jnp.asarray(params.severity_low), jnp.asarray(params.severity_high)
    zero = jnp.zeros(())
    return FaultState(
        severity=jnp.minimum(low + jnp.floor(draw * (high - low + 1)), high).astype(jnp.float32),
        seed=seed,
        seen=jnp.broadcast_to(seen, (MAX_DELAY + 1, 6)),
        dropout_left=zero,
        dropout_first=zero,
        dropout_count=zero,
        freeze_left=zero,
    )


def grip(state: FaultState, station: Float[Array, ""], params: FaultParams) -> Float[Array, ""]:
    """True speed over wheel speed at a station: 1 on dry rail."""
    patch = jnp.floor(station / PATCH).astype(jnp.int32)
    wet = uniform(state.seed, patch, _WET) < params.wet_share * _share(state)
    return jnp.where(wet, 1.0 - params.wet_loss, 1.0)


def frozen(state: FaultState) -> Bool[Array, ""]:
    """Whether the odometer does not count at this step."""
    return state.freeze_left > 0.0


def advance_faults(
    state: FaultState, seen: Float[Array, "6"], draw: Float[Array, "k"], n_beams: int, params: FaultParams
) -> FaultState:
    """One step on: what was seen moves back by one, faults end or begin; `draw` is uniform in [0, 1)."""
    share = _share(state)
    drops = (state.dropout_left <= 0.0) & (draw[0] < params.dropout_rate * share)
    freezes = (state.freeze_left <= 0.0) & (draw[3] < params.freeze_rate * share)
    left = jnp.maximum(state.dropout_left - 1.0, 0.0)
    return dataclasses.replace(
        state,
        seen=jnp.concatenate([seen[None], state.seen[:-1]]),
        dropout_left=jnp.where(
            drops, jnp.ceil(params.dropout_steps * _again(draw[0], params.dropout_rate * share)), left
        ),
        dropout_first=jnp.where(drops, jnp.floor(draw[1] * n_beams), state.dropout_first),
        dropout_count=jnp.where(drops, jnp.ceil(draw[2] * params.dropout_share * n_beams), state.dropout_count),
        freeze_left=jnp.where(
            freezes, jnp.ceil(params.freeze_steps * draw[4]), jnp.maximum(state.freeze_left - 1.0, 0.0)
        ),
    )


def observed(state: FaultState, params: FaultParams) -> Float[Array, "6"]:
    """What is observed at this step, as a row of `FaultState.seen`: the newest, or one that is late."""
    delay = jnp.clip(jnp.round(params.delay * _share(state)), 0, MAX_DELAY).astype(jnp.int32)
    return state.seen[delay]


def spoil(
    ranges: Float[Array, "n_beams"],
    state: FaultState,
    draw: Float[Array, "k"],
    range_max: Float[Array, ""],
    params: FaultParams,
) -> Float[Array, "n_beams"]:
    """True ranges as dust and dropouts leave them: a beam that has dropped out reports exactly `range_max`."""
    n_beams = ranges.shape[0]
    rate = params.dust_rate * _share(state)
    dust = draw[5 : 5 + n_beams]
    dusty = jnp.where(dust < rate, ranges * _again(dust, rate), ranges)
    return jnp.where(_dropped(state, n_beams), range_max, dusty)


def _dropped(state: FaultState, n_beams: int) -> Bool[Array, "n_beams"]:
    beam: Int[Array, n_beams] = jnp.arange(n_beams)
    behind = jnp.mod(beam - state.dropout_first, n_beams)
    return (state.dropout_left > 0.0) & (behind < state.dropout_count)


def _share(state: FaultState) -> Float[Array, ""]:
    return state.severity / (N_SEVERITIES - 1)


def _again(draw: Float[Array, "*n"], rate: Float[Array, ""]) -> Float[Array, "*n"]:
    """A uniform number that fell below a rate is uniform below it: used a second time."""
    return draw / jnp.maximum(rate, 1e-9)
