"""Dead reckoning that drifts: noise at every step, a bias that lasts an episode, and an error that wanders."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax import constants
from subterra_jax.parts.part import Batch, Bounds, Keys, Noise, Part, SensingState, Step
from subterra_jax.parts.slip import WanderParams, advance_wander
from subterra_jax.parts.unicycle import wrap
from subterra_jax.state import EnvParams, State


@struct.dataclass
class OdometryParams:
    """Odometry errors. The paper names them and prints no sizes; these are the sizes of the later tasks.

    Attributes:
        distance_sigma: Standard deviation of the distance noise of one step, m.
        distance_bias_sigma: Standard deviation over episodes of the relative error of distance, 1.
        heading_sigma: Standard deviation of the heading noise of one step, rad.
        heading_bias_sigma: Standard deviation over episodes of the yaw-rate error, rad/s.
        wander: Relative error of distance that changes along the way, 1; None for no such error, as in T0.
        backward_bias_sigma: Standard deviation over episodes of the relative error of distance that is added while the
            robot faces falling stations, 1. Without it, a constant bias would cancel on the way back. None for no such
            error.
    """

    distance_sigma: float = constants.DISTANCE_SIGMA
    distance_bias_sigma: float = constants.DISTANCE_BIAS_SIGMA
    heading_sigma: float = constants.HEADING_SIGMA
    heading_bias_sigma: float = constants.HEADING_BIAS_SIGMA
    wander: WanderParams | None = None
    backward_bias_sigma: float | None = None

    @property
    def n_reset_noise(self) -> int:
        """Standard normal numbers at the start of an episode."""
        return 2 + (self.wander is not None) + (self.backward_bias_sigma is not None)

    @property
    def n_step_noise(self) -> int:
        """Standard normal numbers of a step."""
        return 2 if self.wander is None else 3


@struct.dataclass
class OdometryState:
    """Readings of the odometer, and its errors in this episode."""

    distance: Float[Array, ""]  # dead-reckoned distance travelled, m; may fall when the noise exceeds the motion
    heading: Float[Array, ""]  # dead-reckoned heading since the start, rad, in [-π, π]
    distance_bias: Float[Array, ""]  # relative error of distance, 1
    heading_bias: Float[Array, ""]  # error of the yaw rate, rad/s
    # relative error of distance at present, on top of the bias, 1; None without one
    wander: Float[Array, ""] | None = None
    # relative error of distance that is added while facing falling stations, 1; None without one
    backward_bias: Float[Array, ""] | None = None


def advance_odometry(
    state: OdometryState,
    motion: Float[Array, "2"],
    period: Float[Array, ""],
    noise: Float[Array, "n"],
    params: OdometryParams,
    backward: Bool[Array, ""],
) -> OdometryState:
    """Add the measured motion of one step.

    Args:
        motion: True speed (m/s) and yaw rate (rad/s) during the step.
        period: Duration of the step, s.
        noise: Standard normal numbers: distance, heading, then the wandering error if any.
        params: Sizes of the errors. All zero gives the truth.
        backward: The robot faces falling stations.
    """
    moved, scale, wander = motion[0] * period, 1.0 + state.distance_bias, state.wander
    if params.wander is not None and wander is not None:
        scale = scale + wander
        wander = advance_wander(wander, moved, noise[2], params.wander)
    if state.backward_bias is not None:
        scale = scale + jnp.where(backward, state.backward_bias, 0.0)
    travelled = moved * scale + params.distance_sigma * noise[0]
    turned = (motion[1] + state.heading_bias) * period + params.heading_sigma * noise[1]
    return dataclasses.replace(
        state, distance=state.distance + travelled, heading=wrap(state.heading + turned), wander=wander
    )


@dataclasses.dataclass(frozen=True)
class Odometer(Part):
    """Distance and heading counted from the wheels."""

    name: ClassVar[str] = "odometry"
    place: ClassVar[int] = 1
    streams: ClassVar[tuple[int, ...]] = (1,)

    def defaults(self) -> dict[str, Any]:
        return {"odometry": OdometryParams()}

    def draw_reset(self, key: Keys, batch: Batch, params: EnvParams) -> Float[Array, "*batch n"]:
        return jax.random.normal(key, (*batch, params.odometry.n_reset_noise), jnp.float32)

    def normals(self, params: EnvParams) -> int:
        return params.odometry.n_step_noise

    def begin(self, draw: Float[Array, "n"], state: State, params: EnvParams) -> OdometryState:
        """Set the odometer to 0; `draw` makes the biases of distance and heading, then the other errors if any."""
        sizes, zero = params.odometry, jnp.zeros_like(draw[0])
        return OdometryState(
            distance=zero,
            heading=zero,
            distance_bias=sizes.distance_bias_sigma * draw[0],
            heading_bias=sizes.heading_bias_sigma * draw[1],
            wander=None if sizes.wander is None else sizes.wander.sigma * draw[2],
            backward_bias=None if sizes.backward_bias_sigma is None else sizes.backward_bias_sigma * draw[-1],
        )

    def advance(self, own: OdometryState, step: Step, noise: Noise, params: EnvParams) -> OdometryState:
        facing, along = step.before.heading, step.place.tangent
        backward = jnp.cos(facing) * along[0] + jnp.sin(facing) * along[1] < 0.0
        period = jnp.asarray(params.vehicle.period)
        return advance_odometry(own, step.drive.wheels, period, noise.normal, params.odometry, backward)

    def observe(self, own: OdometryState, sensing: SensingState, noise: Noise, params: EnvParams) -> dict[str, Array]:
        seen = sensing.parts[self.name]
        return {"odometry": jnp.stack([seen.distance, seen.heading])}

    def space(self, params: EnvParams) -> dict[str, Bounds]:
        return {"odometry": (np.array([-np.inf, -np.pi]), np.array([np.inf, np.pi]))}

    def privileged(self, own: OdometryState) -> dict[str, Array]:
        """Return the biases of distance (1) and heading (rad/s)."""
        return {"distance_bias": own.distance_bias, "heading_bias": own.heading_bias}
