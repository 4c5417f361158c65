"""A trot written down: from a commanded velocity and a clock to the joint targets of the servos.

Diagonal legs step together. A foot on the ground goes back as fast as the trunk is to go forward; one in the air comes
forward on a bow. What is learnt is added to these targets, so that the robot walks before anything has been learnt.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.b2 import constants as b2
from subterra_jax.b2 import legs

_OFFSET = np.array([0.0, 0.5, 0.5, 0.0], np.float32)  # of each leg's clock: diagonal legs together
_WEIGHT = b2.TOTAL_MASS * b2.GRAVITY


@struct.dataclass
class GaitParams:
    """The trot.

    Attributes:
        frequency: Strides per second.
        duty: Share of a stride for which a foot is on the ground.
        height: Of the trunk's middle over the ground, m.
        lift: How far a foot is lifted, m: more than a sleeper stands out of the ballast.
        spread: How far the feet stand outside the legs' own planes, m.
        still: Commands below this, m/s (rad/s count half), are stood out, with all feet on the ground.
        startle: Yet a robot that moves faster than this without having been told to, m/s, steps to catch itself.
        place: How much further a foot is set down where the trunk moves faster than told, m per m/s.
        level: Share of a measured tilt that the legs take back.
        learn: How fast a lasting drift is met by longer or shorter strides, 1/s.
        trim_max: By how much at most, m/s and rad/s.
        slew: Fastest change of the commanded velocity, m/s² and rad/s².
    """

    frequency: float = 2.0
    duty: float = 0.65
    height: float = 0.50
    lift: float = 0.16
    spread: float = 0.035
    still: float = 0.1
    startle: float = 0.3
    place: float = 0.18
    level: float = 1.2
    learn: float = 0.75
    trim_max: float = 0.35
    slew: Array | tuple[float, float, float] = (1.5, 1.0, 2.0)


@struct.dataclass
class GaitState:
    """Where the gait is.

    Attributes:
        phase: Of the clock, in [0, 1).
        velocity: What is being obeyed: forward and to the left (m/s), yaw rate (rad/s); the command, slewed.
        stride: 0 standing to 1 in full stride.
        trim: What is added to that velocity because the robot was too slow or too fast, m/s and rad/s.
        offset: Where each foot was set down beside its usual place, forward and to the left, m.
    """

    phase: Float[Array, ""]
    velocity: Float[Array, "3"]
    stride: Float[Array, ""]
    trim: Float[Array, "3"]
    offset: Float[Array, "4 2"]


def begin(phase: Float[Array, ""]) -> GaitState:
    """Standing."""
    return GaitState(
        phase=phase, velocity=jnp.zeros(3), stride=jnp.zeros(()), trim=jnp.zeros(3), offset=jnp.zeros((4, 2))
    )


def advance(
    state: GaitState, command: Float[Array, "3"], drift: Float[Array, "3"], period: float, params: GaitParams
) -> GaitState:
    """The gait a moment later; the clock stands while the robot does.

    Args:
        state: Before.
        command: Forward and to the left (m/s), yaw rate (rad/s).
        drift: How much faster than told the trunk moves, forward and to the left (m/s), and turns (rad/s); as far as
            anybody knows.
        period: How much later, s.
        params: The trot.
    """
    most = jnp.asarray(params.slew) * period
    velocity = state.velocity + jnp.clip(command - state.velocity, -most, most)
    walks = _size(command) + _size(velocity) > 2.0 * params.still
    walks = walks | (drift[0] * drift[0] + drift[1] * drift[1] > params.startle * params.startle)
    # Into stride within a fifth of a second.
    stride = jnp.clip(state.stride + jnp.where(walks, 1.0, -1.0) * period / 0.2, 0.0, 1.0)
    phase = state.phase + jnp.where(stride > 0.0, params.frequency * period, 0.0)
    trim = jnp.clip(state.trim - params.learn * period * drift, -params.trim_max, params.trim_max) * stride
    state = GaitState(phase - jnp.floor(phase), velocity, stride, trim, state.offset)
    return dataclasses.replace(state, offset=_place(state, drift[:2], period, params))


def _place(state: GaitState, drift: Float[Array, "2"], period: float, params: GaitParams) -> Float[Array, "4 2"]:
    """Feet in the air make for where they would stop the drift; those on the ground stay.

    Source: Raibert, Legged Robots That Balance, 1986: foot placement.
    """
    flies = (_leg_phase(state) >= params.duty)[:, None]
    wanted = state.stride * params.place * jnp.clip(drift, -1.0, 1.0)
    share = jnp.where(flies, period / 0.05, (1.0 - state.stride) * period / 0.2)
    return state.offset + jnp.minimum(share, 1.0) * (wanted - state.offset)


def stance(state: GaitState, params: GaitParams) -> Float[Array, "4"]:
    """How much each leg is meant to carry: 1 on the ground, 0 in the air, with short ramps between."""
    phase = _leg_phase(state)
    edge = 0.05
    on = jnp.clip(jnp.minimum(phase, params.duty - phase) / edge + 0.5, 0.0, 1.0)
    on = jnp.maximum(on, jnp.clip((phase - 1.0) / edge + 0.5, 0.0, 1.0))
    return 1.0 - state.stride * (1.0 - on)


def targets(state: GaitState, gravity: Float[Array, "3"], params: GaitParams) -> Float[Array, "12"]:
    """Where the servos are to go.

    Args:
        state: Where the gait is.
        gravity: Direction of gravity in the trunk's axes, unit vector.
        params: The trot.

    Returns:
        Joint targets, rad: the angles of the gait, and before them what the load costs a servo of finite stiffness.
    """
    wanted = legs.angles(foot_targets(state, gravity, params))
    share = stance(state, params)
    load = _WEIGHT * share / jnp.maximum(jnp.sum(share), 1.0)
    return (wanted + legs.carrying(wanted, load) / legs.STIFFNESS).reshape(-1)


def foot_targets(state: GaitState, gravity: Float[Array, "3"], params: GaitParams) -> Float[Array, "4 3"]:
    """Where the feet are to be, from their legs' abduction axes, m."""
    phase = _leg_phase(state)
    x, y = legs.HIPS[:, 0], legs.HIPS[:, 1] + legs.SIDE * (b2.THIGH_Y + params.spread)
    told = state.velocity + state.trim
    speed_x, speed_y = told[0] - told[2] * y, told[1] + told[2] * x
    half = 0.5 * params.duty / params.frequency
    on = 1.0 - 2.0 * phase / params.duty
    flight = jnp.clip((phase - params.duty) / (1.0 - params.duty), 0.0, 1.0)
    # Cycloid: it leaves and meets the ground upright, and is back where the next stance begins.
    forward = 2.0 * (flight - jnp.sin(2.0 * jnp.pi * flight) / (2.0 * jnp.pi)) - 1.0
    along = state.stride * jnp.where(phase < params.duty, on, forward)
    lifted = params.lift * state.stride * 0.5 * (1.0 - jnp.cos(2.0 * jnp.pi * flight))
    # Tilt towards gravity's direction is met by longer legs on the low side.
    level = params.level * (x * gravity[0] + y * gravity[1])
    return jnp.stack(
        [
            along * half * speed_x + state.offset[:, 0],
            legs.SIDE * (b2.THIGH_Y + params.spread) + along * half * speed_y + state.offset[:, 1],
            -(params.height - b2.FOOT_RADIUS) + lifted - level,
        ],
        axis=1,
    )


def _leg_phase(state: GaitState) -> Float[Array, "4"]:
    phase = state.phase + _OFFSET
    return phase - jnp.floor(phase)


def _size(velocity: Float[Array, "3"]) -> Float[Array, ""]:
    return jnp.sqrt(velocity[0] * velocity[0] + velocity[1] * velocity[1] + 0.25 * velocity[2] * velocity[2])
