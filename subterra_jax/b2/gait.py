"""The gait: a scripted trot, and the trained policy that corrects it.

The trot leads from a commanded velocity and a clock to the joint targets of the servos. Diagonal legs step together.
A foot on the ground moves back as fast as the trunk should move forward. A foot in the air swings forward on an arc.
The learnt action is added to these targets, so the robot walks before any training.
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax.b2 import constants as b2
from subterra_jax.b2 import kinematics
from subterra_jax.policies.files import GAIT, PolicyError, PolicyFile
from subterra_jax.policies.network import act
from subterra_jax.policies.trained import Tensors, nested

_OFFSET = np.array([0.0, 0.5, 0.5, 0.0], np.float32)  # of each leg's clock: diagonal legs together
_WEIGHT = b2.TOTAL_MASS * b2.GRAVITY
RELEASED = "B2Walk-v1"
_CLIP = 10.0  # largest normalised observation, standard deviations


@struct.dataclass
class GaitParams:
    """Parameters of the trot."""

    frequency: float = 2.0  # strides per second
    duty: float = 0.65  # fraction of a stride for which a foot is on the ground
    height: float = 0.50  # height of the trunk's middle over the ground, m
    lift: float = 0.16  # height to which a foot is lifted, m: more than a sleeper stands out of the ballast
    spread: float = 0.035  # distance of the feet outside the legs' own planes, m
    still: float = 0.1  # commands below this, m/s (rad/s count half), are answered by standing on all feet
    startle: float = 0.3  # drift above which a standing robot steps to catch itself, m/s
    place: float = 0.18  # extra distance at which a foot is set down, per drift of the trunk, m per m/s
    level: float = 1.2  # fraction of a measured tilt that the legs compensate
    learn: float = 0.75  # rate at which longer or shorter strides compensate a lasting drift, 1/s
    trim_max: float = 0.35  # largest such compensation, m/s and rad/s
    # fastest change of the commanded velocity, m/s² and rad/s²
    slew: Array | tuple[float, float, float] = (1.5, 1.0, 2.0)


@struct.dataclass
class GaitState:
    """State of the gait."""

    phase: Float[Array, ""]  # phase of the clock, in [0, 1)
    velocity: Float[Array, "3"]  # the slewed command: forward and to the left (m/s), yaw rate (rad/s)
    stride: Float[Array, ""]  # 0 standing to 1 in full stride
    trim: Float[Array, "3"]  # addition to that velocity because the robot was too slow or too fast, m/s and rad/s
    offset: Float[Array, "4 2"]  # offset of each foot's landing point from the usual one, forward and to the left, m


def standing_gait(phase: Float[Array, ""]) -> GaitState:
    """Return the gait of a robot that stands, with a given phase of its clock."""
    return GaitState(
        phase=phase, velocity=jnp.zeros(3), stride=jnp.zeros(()), trim=jnp.zeros(3), offset=jnp.zeros((4, 2))
    )


def advance(
    state: GaitState, command: Float[Array, "3"], drift: Float[Array, "3"], period: float, params: GaitParams
) -> GaitState:
    """Advances the gait by one control period; the clock stops while the robot stands.

    Args:
        state: Gait before.
        command: Forward and to the left (m/s), yaw rate (rad/s).
        drift: Estimated velocity of the trunk minus the slewed command, in the same order and units.
        period: Control period, s.
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
    return dataclasses.replace(state, offset=_foot_offsets(state, drift[:2], period, params))


def _foot_offsets(state: GaitState, drift: Float[Array, "2"], period: float, params: GaitParams) -> Float[Array, "4 2"]:
    """Landing points: feet in the air move to where they would stop the drift; those on the ground stay.

    Source: Raibert, Legged Robots That Balance, 1986: foot placement.
    """
    airborne = (_leg_phase(state) >= params.duty)[:, None]
    aim = state.stride * params.place * jnp.clip(drift, -1.0, 1.0)
    fraction = jnp.where(airborne, period / 0.05, (1.0 - state.stride) * period / 0.2)
    return state.offset + jnp.minimum(fraction, 1.0) * (aim - state.offset)


def stance(state: GaitState, params: GaitParams) -> Float[Array, "4"]:
    """Return the planned fraction of load of each leg: 1 on the ground, 0 in the air, with short ramps between."""
    phase = _leg_phase(state)
    edge = 0.05
    on = jnp.clip(jnp.minimum(phase, params.duty - phase) / edge + 0.5, 0.0, 1.0)
    on = jnp.maximum(on, jnp.clip((phase - 1.0) / edge + 0.5, 0.0, 1.0))
    return 1.0 - state.stride * (1.0 - on)


def targets(state: GaitState, gravity: Float[Array, "3"], params: GaitParams) -> Float[Array, "12"]:
    """Computes the joint targets of the servos.

    Args:
        state: State of the gait.
        gravity: Direction of gravity in the trunk's axes, unit vector.

    Returns:
        Joint targets, rad: the angles of the gait, plus the deflection of a servo of finite stiffness under the load.
    """
    angles = kinematics.joint_angles(foot_targets(state, gravity, params))
    fraction = stance(state, params)
    load = _WEIGHT * fraction / jnp.maximum(jnp.sum(fraction), 1.0)
    return (angles + kinematics.load_torques(angles, load) / kinematics.STIFFNESS).reshape(-1)


def foot_targets(state: GaitState, gravity: Float[Array, "3"], params: GaitParams) -> Float[Array, "4 3"]:
    """Computes the target positions of the feet from their legs' abduction axes, m."""
    phase = _leg_phase(state)
    x, y = kinematics.HIPS[:, 0], kinematics.HIPS[:, 1] + kinematics.SIDE * (b2.THIGH_Y + params.spread)
    aim = state.velocity + state.trim
    speed_x, speed_y = aim[0] - aim[2] * y, aim[1] + aim[2] * x
    half = 0.5 * params.duty / params.frequency
    on = 1.0 - 2.0 * phase / params.duty
    flight = jnp.clip((phase - params.duty) / (1.0 - params.duty), 0.0, 1.0)
    # Cycloid: it leaves and meets the ground upright, and is back where the next stance begins.
    forward = 2.0 * (flight - jnp.sin(2.0 * jnp.pi * flight) / (2.0 * jnp.pi)) - 1.0
    along = state.stride * jnp.where(phase < params.duty, on, forward)
    lifted = params.lift * state.stride * 0.5 * (1.0 - jnp.cos(2.0 * jnp.pi * flight))
    # Longer legs on the low side compensate the tilt.
    level = params.level * (x * gravity[0] + y * gravity[1])
    return jnp.stack(
        [
            along * half * speed_x + state.offset[:, 0],
            kinematics.SIDE * (b2.THIGH_Y + params.spread) + along * half * speed_y + state.offset[:, 1],
            -(params.height - b2.FOOT_RADIUS) + lifted - level,
        ],
        axis=1,
    )


def _leg_phase(state: GaitState) -> Float[Array, "4"]:
    phase = state.phase + _OFFSET
    return phase - jnp.floor(phase)


def _size(velocity: Float[Array, "3"]) -> Float[Array, ""]:
    """Size of a velocity, m/s; 1 rad/s of yaw rate counts as 0.5 m/s."""
    return jnp.sqrt(velocity[0] * velocity[0] + velocity[1] * velocity[1] + 0.25 * velocity[2] * velocity[2])


@struct.dataclass(eq=False)
class WalkPolicy:
    """Twelve joint offsets for one observation of `WalkEnv`: the mean of the distribution that was trained.

    It equals itself alone, so that `jax.jit(policy)` takes it.
    """

    tensors: Tensors  # `statistics.mean` and `statistics.std` of one observation, and the layers `actor.…`
    name: str = struct.field(pytree_node=False, default=RELEASED)  # name shown to people

    @property
    def n_observation(self) -> int:
        return self.tensors["statistics.mean"].shape[0]

    def act(self, observation: Float[Array, "*batch n_obs"]) -> Float[Array, "*batch 12"]:
        """Return the action, in [-1, 1]."""
        scaled = (observation - self.tensors["statistics.mean"]) / self.tensors["statistics.std"]
        return jnp.tanh(act(nested(self.tensors)["actor"], jnp.clip(scaled, -_CLIP, _CLIP)))

    def initial_memory(self, key: PRNGKeyArray | None = None, n_envs: int | None = None) -> tuple[()]:
        """Return no memory; for `subterra_jax.policies.Policy`."""
        return ()

    def restart(self, memory: tuple[()], done: Bool[Array, "*env"]) -> tuple[()]:
        return memory

    def __call__(
        self, obs: Float[Array, "*batch n_obs"], memory: tuple[()] = (), state: Any = None
    ) -> tuple[Float[Array, "*batch 12"], tuple[()]]:
        return self.act(obs), memory


def make_policy(file: PolicyFile) -> WalkPolicy:
    """Makes a gait from its file; raises `PolicyError` for another kind of policy, or tensors that do not fit."""
    if file.facts["kind"] != GAIT:
        raise PolicyError(f"{file.path}: a policy of kind {file.facts['kind']!r}, which is no gait")
    try:
        policy = WalkPolicy({name: jnp.asarray(tensor) for name, tensor in file.tensors.items()}, file.facts["name"])
        jax.eval_shape(policy.act, jax.ShapeDtypeStruct((policy.n_observation,), jnp.float32))
    except (KeyError, TypeError, ValueError) as error:
        raise PolicyError(f"{file.path}: tensors and layout do not belong together ({error})") from error
    return policy


def check_fits(policy: WalkPolicy, size: int, source: str | Path) -> None:
    """Raises `PolicyError` where a gait was made for observations of another size than `size`."""
    if policy.n_observation != size:
        raise PolicyError(f"{source}: made for observations of {policy.n_observation} numbers, the B2 gives {size}")
