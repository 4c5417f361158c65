"""Dead reckoning that drifts: noise at every step, a bias that lasts an episode, and an error that wanders."""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.vehicle import wrap
from subterra_jax.wander import WanderParams, advance_wander, start_wander


@struct.dataclass
class OdometryParams:
    """Odometry errors. The paper names them and prints no sizes; these are the sizes of the later tasks.

    Attributes:
        distance_sigma: Standard deviation of the distance noise of one step, m.
        distance_bias_sigma: Standard deviation over episodes of the relative error of distance, 1.
        heading_sigma: Standard deviation of the heading noise of one step, rad.
        heading_bias_sigma: Standard deviation over episodes of the yaw-rate error, rad/s.
        wander: Relative error of distance that changes along the way, 1; None, as in the paper's task, is none at all.
        backward_bias_sigma: Standard deviation over episodes of the relative error of distance that is added while the
            robot faces falling stations, 1. Without it a constant bias cancels out and back. None is none at all.
    """

    distance_sigma: float = 0.01
    distance_bias_sigma: float = 0.02
    heading_sigma: float = 0.001
    heading_bias_sigma: float = 0.002
    wander: WanderParams | None = None
    backward_bias_sigma: float | None = None

    @property
    def n_reset_noise(self) -> int:
        """Standard normal numbers that the start of an episode needs."""
        return 2 + (self.wander is not None) + (self.backward_bias_sigma is not None)

    @property
    def n_step_noise(self) -> int:
        """Standard normal numbers that a step needs."""
        return 2 if self.wander is None else 3


@struct.dataclass
class OdometryState:
    """What the odometer says, and the bias it has this episode.

    Attributes:
        distance: Dead-reckoned distance travelled, m; may fall when the noise exceeds the motion.
        heading: Dead-reckoned heading since the start, rad, in [-π, π].
        distance_bias: Relative error of distance, 1.
        heading_bias: Error of the yaw rate, rad/s.
        wander: Relative error of distance at present, on top of the bias, 1; None without one.
        backward_bias: Relative error of distance that is added while facing falling stations, 1; None without one.
    """

    distance: Float[Array, ""]
    heading: Float[Array, ""]
    distance_bias: Float[Array, ""]
    heading_bias: Float[Array, ""]
    wander: Float[Array, ""] | None = None
    backward_bias: Float[Array, ""] | None = None


def start_odometry(noise: Float[Array, "n"], params: OdometryParams) -> OdometryState:
    """An odometer at 0 with a fresh bias.

    Args:
        noise: Standard normal numbers, for the bias of distance and of heading, and for the other errors if any.
        params: Sizes of the errors.
    """
    zero = jnp.zeros_like(noise[0])
    return OdometryState(
        distance=zero,
        heading=zero,
        distance_bias=params.distance_bias_sigma * noise[0],
        heading_bias=params.heading_bias_sigma * noise[1],
        wander=None if params.wander is None else start_wander(noise[2], params.wander),
        backward_bias=None if params.backward_bias_sigma is None else params.backward_bias_sigma * noise[-1],
    )


def advance_odometry(
    state: OdometryState,
    motion: Float[Array, "2"],
    period: Float[Array, ""],
    noise: Float[Array, "n"],
    params: OdometryParams,
    backward: Bool[Array, ""] | bool = False,
) -> OdometryState:
    """Add one step's measured motion.

    Args:
        state: The odometer before.
        motion: True speed (m/s) and yaw rate (rad/s) during the step.
        period: Duration of the step, s.
        noise: Standard normal numbers, for distance, heading, and the wandering error if there is one.
        params: Sizes of the errors. All zero gives the truth.
        backward: Whether the robot faces falling stations.
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
