"""Dead reckoning that drifts: noise at every step and a bias that lasts an episode, on distance and on heading."""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.vehicle import wrap


@struct.dataclass
class OdometryParams:
    """Odometry errors. The paper names them and prints no sizes; these are the sizes of the later tasks.

    Attributes:
        distance_sigma: Standard deviation of the distance noise of one step, m.
        distance_bias_sigma: Standard deviation over episodes of the relative error of distance, 1.
        heading_sigma: Standard deviation of the heading noise of one step, rad.
        heading_bias_sigma: Standard deviation over episodes of the yaw-rate error, rad/s.
    """

    distance_sigma: float = 0.01
    distance_bias_sigma: float = 0.02
    heading_sigma: float = 0.001
    heading_bias_sigma: float = 0.002


@struct.dataclass
class OdometryState:
    """What the odometer says, and the bias it has this episode.

    Attributes:
        distance: Dead-reckoned distance travelled, m; may fall when the noise exceeds the motion.
        heading: Dead-reckoned heading since the start, rad, in [-π, π].
        distance_bias: Relative error of distance, 1.
        heading_bias: Error of the yaw rate, rad/s.
    """

    distance: Float[Array, ""]
    heading: Float[Array, ""]
    distance_bias: Float[Array, ""]
    heading_bias: Float[Array, ""]


def start_odometry(noise: Float[Array, "2"], params: OdometryParams) -> OdometryState:
    """An odometer at 0 with a fresh bias.

    Args:
        noise: Two standard normal numbers, for the bias of distance and of heading.
        params: Sizes of the errors.
    """
    zero = jnp.zeros_like(noise[0])
    return OdometryState(
        distance=zero,
        heading=zero,
        distance_bias=params.distance_bias_sigma * noise[0],
        heading_bias=params.heading_bias_sigma * noise[1],
    )


def advance_odometry(
    state: OdometryState,
    motion: Float[Array, "2"],
    period: Float[Array, ""],
    noise: Float[Array, "2"],
    params: OdometryParams,
) -> OdometryState:
    """Add one step's measured motion.

    Args:
        state: The odometer before.
        motion: True speed (m/s) and yaw rate (rad/s) during the step.
        period: Duration of the step, s.
        noise: Two standard normal numbers, for distance and heading.
        params: Sizes of the errors. All zero gives the truth.
    """
    travelled = motion[0] * period * (1.0 + state.distance_bias) + params.distance_sigma * noise[0]
    turned = (motion[1] + state.heading_bias) * period + params.heading_sigma * noise[1]
    return dataclasses.replace(state, distance=state.distance + travelled, heading=wrap(state.heading + turned))
