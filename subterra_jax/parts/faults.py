"""Faults that come and go: beams that drop out, dust, an odometer that freezes, stale data, wet rails.

Their sizes are drawn for each episode and never reported, and no exact zero gives them away.
"""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, UInt32

from subterra_jax import constants
from subterra_jax.parts.odometer import OdometryState
from subterra_jax.parts.part import Batch, Drive, Keys, Noise, Part, SensingState, Step, uniform_at
from subterra_jax.parts.unicycle import wrap
from subterra_jax.state import EnvParams, State

N_SEVERITIES = 5
MAX_DELAY = 4  # steps
PATCH = constants.WET_PATCH  # m of rail that are wet or dry as a whole
_N_OWN = 5  # uniform numbers of a step beside those of the beams
_WET = 17  # number of the draw that makes a patch wet
SIZES = ("dropout_fraction", "dropout_steps", "dust_rate", "freeze_steps", "delay", "wet_fraction", "wet_loss")


@struct.dataclass
class FaultParams:
    """Faults at severity 4. There are none at severity 0, and proportionally fewer in between.

    Those of `SIZES` are middles of the ranges that the sizes of an episode are drawn from; the ranges are public.

    Attributes:
        severity_low: Least severity of an episode, 0 to 4.
        severity_high: Largest severity; the whole numbers in between are equally likely.
        dropout_rate: Probability per step that a sector of beams drops out for a while.
        dropout_fraction: Largest fraction of the beams that drop out together.
        dropout_steps: Longest drop-out, steps.
        dust_rate: Probability that a beam is reflected by dust before it meets the wall.
        freeze_rate: Probability per step that the odometer stops counting for a while.
        freeze_steps: Longest freeze, steps.
        delay: Age of the observation, steps; at most 4.
        wet_fraction: Fraction of the 10 m patches of rail that are wet.
        wet_loss: Fraction of the speed lost on wet rail, while the wheels turn as before.
        spread: Each of `SIZES` is drawn evenly between 1 - spread and 1 + spread times its middle, by itself.
        origin_distance: Standard deviation of the odometer's distance at the start, m.
        origin_heading: Standard deviation of its heading there, rad.
    """

    severity_low: int = constants.SEVERITY_LOW
    severity_high: int = constants.SEVERITY_HIGH
    dropout_rate: float = constants.DROPOUT_RATE
    dropout_fraction: float = constants.DROPOUT_FRACTION
    dropout_steps: float = constants.DROPOUT_STEPS
    dust_rate: float = constants.DUST_RATE
    freeze_rate: float = constants.FREEZE_RATE
    freeze_steps: float = constants.FREEZE_STEPS
    delay: float = constants.DELAY
    wet_fraction: float = constants.WET_FRACTION
    wet_loss: float = constants.WET_LOSS
    spread: float = constants.FAULT_SPREAD
    origin_distance: float = constants.ORIGIN_DISTANCE_SIGMA
    origin_heading: float = constants.ORIGIN_HEADING_SIGMA


@struct.dataclass
class FaultState:
    """Faults of one episode."""

    severity: Float[Array, ""]  # 0 to 4
    seed: UInt32[Array, ""]  # seed of the wet patches
    # Position x, y (m), heading (rad), station (m) and odometer readings (m, rad) of the last steps, newest first. The
    # observation shows one of them.
    seen: Float[Array, "5 6"]
    dropout_left: Float[Array, ""]  # steps until the lost sector is back
    dropout_first: Float[Array, ""]  # first beam of that sector
    dropout_count: Float[Array, ""]  # beams of that sector
    freeze_left: Float[Array, ""]  # steps until the odometer counts again
    scale: Float[Array, "7"]  # factors on the middles of `SIZES`, 1
    origin: Float[Array, "2"]  # readings of the odometer at the start, m and rad


def sensing(
    position: Float[Array, "2"], heading: Float[Array, ""], station: Float[Array, ""], reading: OdometryState
) -> Float[Array, "6"]:
    """Make a row of `FaultState.seen`."""
    return jnp.concatenate([position, jnp.stack([heading, station, reading.distance, reading.heading])])


def grip(state: FaultState, station: Float[Array, ""], params: FaultParams) -> Float[Array, ""]:
    """Return true speed over wheel speed at a station: 1 on dry rail."""
    patch = jnp.floor(station / PATCH).astype(jnp.int32)
    wet = uniform_at(state.seed, patch, _WET) < params.wet_fraction * _fraction(state)
    return jnp.where(wet, 1.0 - params.wet_loss, 1.0)


def advance_faults(
    state: FaultState, seen: Float[Array, "6"], draw: Float[Array, "k"], n_beams: int, params: FaultParams
) -> FaultState:
    """Go one step on: the history moves back by one, faults end or begin; `draw` is uniform in [0, 1)."""
    fraction = _fraction(state)
    drops = (state.dropout_left <= 0.0) & (draw[0] < params.dropout_rate * fraction)
    freezes = (state.freeze_left <= 0.0) & (draw[3] < params.freeze_rate * fraction)
    left = jnp.maximum(state.dropout_left - 1.0, 0.0)
    return dataclasses.replace(
        state,
        seen=jnp.concatenate([seen[None], state.seen[:-1]]),
        dropout_left=jnp.where(
            drops, jnp.ceil(params.dropout_steps * _again(draw[0], params.dropout_rate * fraction)), left
        ),
        dropout_first=jnp.where(drops, jnp.floor(draw[1] * n_beams), state.dropout_first),
        dropout_count=jnp.where(drops, jnp.ceil(draw[2] * params.dropout_fraction * n_beams), state.dropout_count),
        freeze_left=jnp.where(
            freezes, jnp.ceil(params.freeze_steps * draw[4]), jnp.maximum(state.freeze_left - 1.0, 0.0)
        ),
    )


def observed(state: FaultState, params: FaultParams) -> Float[Array, "6"]:
    """Return the row of `FaultState.seen` that is observed: the newest, or a late one."""
    delay = jnp.clip(jnp.round(params.delay * _fraction(state)), 0, MAX_DELAY).astype(jnp.int32)
    return state.seen[delay]


def corrupt(
    ranges: Float[Array, "n_beams"],
    state: FaultState,
    draw: Float[Array, "k"],
    range_max: Float[Array, ""],
    params: FaultParams,
) -> Float[Array, "n_beams"]:
    """Apply dust and drop-outs to true ranges; a lost beam reports exactly `range_max`."""
    n_beams = ranges.shape[0]
    rate = params.dust_rate * _fraction(state)
    dust = draw[_N_OWN : _N_OWN + n_beams]
    dusty = jnp.where(dust < rate, ranges * _again(dust, rate), ranges)
    return jnp.where(_dropped(state, n_beams), range_max, dusty)


def _dropped(state: FaultState, n_beams: int) -> Bool[Array, "n_beams"]:
    beam: Float[Array, n_beams] = jnp.arange(n_beams, dtype=state.dropout_first.dtype)
    behind = jnp.mod(beam - state.dropout_first, n_beams)
    return (state.dropout_left > 0.0) & (behind < state.dropout_count)


def _fraction(state: FaultState) -> Float[Array, ""]:
    return state.severity / (N_SEVERITIES - 1)


def _again(draw: Float[Array, "*n"], rate: Float[Array, ""]) -> Float[Array, "*n"]:
    """Use a uniform number again: one that fell below a rate is uniform below it."""
    return draw / jnp.maximum(rate, 1e-9)


@dataclasses.dataclass(frozen=True)
class Faults(Part):
    """Lost beams, dust, a frozen odometer, late observations and wet rail, all of one severity.

    A frozen odometer goes on with its noise, as does one of a standing robot, and late observations begin with readings
    from before the start: neither shows as an exact zero.
    """

    name: ClassVar[str] = "faults"
    streams: ClassVar[tuple[int, ...]] = (6, 7, 8, 9)

    def defaults(self) -> dict[str, Any]:
        return {"faults": FaultParams()}

    def draw_reset(self, key: Keys, batch: Batch, params: EnvParams) -> tuple[Array, ...]:
        """Draw what an episode needs.

        Returns:
            Random bits `(*batch, 2)`, of which the second word counts; uniform numbers for the severity `(*batch,)` and
            the sizes `(*batch, 7)`; and normal ones for what was read before the start, `(*batch, 5, 2)`.
        """
        return (
            jax.random.bits(key[0], (*batch, 2), jnp.uint32),
            jax.random.uniform(key[1], batch, jnp.float32),
            jax.random.uniform(key[2], (*batch, len(SIZES)), jnp.float32),
            jax.random.normal(key[3], (*batch, MAX_DELAY + 1, 2), jnp.float32),
        )

    def uniforms(self, params: EnvParams) -> int:
        return _N_OWN + params.lidar.n_beams

    def begin(self, draw: tuple[Array, ...], state: State, params: EnvParams) -> FaultState:
        """Begin an episode without faults; the robot has stood still until now."""
        faults, odometry = params.faults, params.odometry
        noise = jnp.stack([jnp.asarray(odometry.distance_sigma), jnp.asarray(odometry.heading_sigma)])
        past = noise[None, :] * jnp.cumsum(draw[3][:-1], axis=0)
        origin = jnp.stack([jnp.asarray(faults.origin_distance), jnp.asarray(faults.origin_heading)]) * draw[3][-1]
        now = sensing(state.position, state.heading, state.station, state.odometry)
        zero = jnp.zeros_like(draw[1])
        low, high = (jnp.asarray(end).astype(zero.dtype) for end in (faults.severity_low, faults.severity_high))
        return FaultState(
            severity=jnp.minimum(low + jnp.floor(draw[1] * (high - low + 1)), high),
            seed=draw[0][1],
            seen=jnp.broadcast_to(now, (MAX_DELAY + 1, 6)).at[1:, 4:].add(-past),
            dropout_left=zero,
            dropout_first=zero,
            dropout_count=zero,
            freeze_left=zero,
            scale=1.0 + faults.spread * (2.0 * draw[2] - 1.0),
            origin=origin,
        )

    def sizes(self, own: FaultState, params: EnvParams) -> FaultParams:
        """Return the sizes of the faults of an episode at severity 4."""
        middle: Any = params.faults
        sizes: FaultParams = middle.replace(**{n: getattr(middle, n) * own.scale[i] for i, n in enumerate(SIZES)})
        return sizes

    def drive(self, own: FaultState, drive: Drive, state: State, params: EnvParams) -> Drive:
        """Take speed from the robot on wet rail, and none from its wheels; those of a frozen odometer seem to stand."""
        fraction = grip(own, state.station, self.sizes(own, params))
        motion = jnp.stack([drive.motion[0] * fraction, drive.motion[1]])
        return Drive(jnp.where(own.freeze_left > 0.0, 0.0, drive.wheels), motion)

    def advance(self, own: FaultState, step: Step, noise: Noise, params: EnvParams) -> FaultState:
        seen = sensing(step.position, step.heading, step.place.station, step.after["odometry"])
        return advance_faults(own, seen, noise.uniform, params.lidar.n_beams, self.sizes(own, params))

    def look_from(self, own: FaultState, sensing: SensingState, params: EnvParams) -> SensingState:
        """Show an earlier state, by an odometer that did not begin at 0."""
        seen = observed(own, self.sizes(own, params))
        reading = dataclasses.replace(
            sensing.parts["odometry"], distance=seen[4] + own.origin[0], heading=wrap(seen[5] + own.origin[1])
        )
        parts = {**sensing.parts, "odometry": reading}
        return dataclasses.replace(sensing, position=seen[:2], heading=seen[2], station=seen[3], parts=parts)

    def corrupt(self, own: FaultState, ranges: Array, noise: Noise, params: EnvParams) -> Array:
        return corrupt(ranges, own, noise.uniform, jnp.asarray(params.lidar.range_max), self.sizes(own, params))

    def privileged(self, own: FaultState) -> dict[str, Array]:
        """Return the severity, and the factors on the middles of the sizes that a bound may know."""
        return {"severity": own.severity, **{f"fault_{name}": own.scale[i] for i, name in enumerate(SIZES)}}

    def info(self, own: FaultState) -> dict[str, Array]:
        return {"severity": own.severity}

    def levels(self, params: EnvParams) -> range:
        return range(int(np.min(params.faults.severity_low)), int(np.max(params.faults.severity_high)) + 1)

    def at_level(self, params: EnvParams, level: Any) -> EnvParams:
        one = dataclasses.replace(params.faults, severity_low=level, severity_high=level)
        return params.replace(faults=one)
