"""How well a distance is known that was counted with the task's slip and odometry."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from subterra_jax.baselines.agent import Observed
from subterra_jax.state import EnvParams
from subterra_jax.wander import WanderParams


def wander_variance(distance: Float[Array, ""], wander: WanderParams | None) -> Float[Array, ""]:
    """Variance of the integral of a wandering error over a distance, m².

    Source: the double integral of the covariance σ² exp(-|u - v| / L).
    """
    if wander is None:
        return jnp.zeros_like(distance)
    length = jnp.asarray(wander.length)
    rest = distance + length * jnp.expm1(-distance / length)
    return 2.0 * wander.sigma * wander.sigma * length * jnp.maximum(rest, 0.0)


def command_sigma(distance: Float[Array, ""], params: EnvParams) -> Float[Array, ""]:
    """Standard deviation of a distance counted from commands, m."""
    variance = jnp.zeros_like(distance)
    if params.slip is not None:
        variance = (params.slip.gain_sigma * distance) ** 2 + wander_variance(distance, params.slip.wander)
    return jnp.sqrt(variance)


def odometry_sigma(distance: Float[Array, ""], steps: Float[Array, ""], params: EnvParams) -> Float[Array, ""]:
    """Standard deviation of a distance counted by the odometer in so many steps, m."""
    odometry = params.odometry
    variance = steps * odometry.distance_sigma**2 + (odometry.distance_bias_sigma * distance) ** 2
    return jnp.sqrt(variance + wander_variance(distance, odometry.wander))


def believed_start(obs: Observed, params: EnvParams) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Where one believes to be at the start, and its standard deviation, m: anywhere, where that is the task."""
    if obs.goal is None and obs.ring_pitch is not None and params.goal is not None:
        room = params.tunnel.length - 2.0 * params.goal.margin
        return 0.5 * params.tunnel.length, room / jnp.sqrt(12.0)
    return jnp.asarray(params.start.station, jnp.float32), jnp.asarray(params.start.station_sigma, jnp.float32)
