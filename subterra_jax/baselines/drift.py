"""Nominal errors of slip and odometer, and the uncertainty of a distance counted with them."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from subterra_jax.parts.faults import FaultParams
from subterra_jax.parts.slip import SlipParams
from subterra_jax.parts.wander import WanderParams
from subterra_jax.state import EnvParams

_NO_SLIP = SlipParams(gain_sigma=0.0, yaw_sigma=0.0, wander=WanderParams(sigma=0.0))
_NO_FAULTS = FaultParams(wet_share=0.0, wet_loss=0.0)


def slip_sizes(params: EnvParams) -> SlipParams:
    """Return the nominal slip of the task; 0 where nothing slips."""
    return params.parts.get("slip", _NO_SLIP)


def fault_sizes(params: EnvParams) -> FaultParams:
    """Return the nominal faults of the task; no wet rail where nothing fails."""
    return params.parts.get("faults", _NO_FAULTS)


def wander_variance(distance: Float[Array, ""], wander: WanderParams | None) -> Float[Array, ""]:
    """Compute the variance of the integral of a wandering error over a distance, m².

    Source: the double integral of the covariance σ² exp(-|u - v| / L).
    """
    if wander is None:
        return jnp.zeros_like(distance)
    length = jnp.asarray(wander.length)
    rest = distance + length * jnp.expm1(-distance / length)
    return 2.0 * wander.sigma * wander.sigma * length * jnp.maximum(rest, 0.0)


def command_sigma(distance: Float[Array, ""], params: EnvParams) -> Float[Array, ""]:
    """Compute the standard deviation of a distance counted from commands, m."""
    slip = slip_sizes(params)
    return jnp.sqrt((slip.gain_sigma * distance) ** 2 + wander_variance(distance, slip.wander))


def odometry_sigma(distance: Float[Array, ""], steps: Float[Array, ""], params: EnvParams) -> Float[Array, ""]:
    """Compute the standard deviation of a distance counted by the odometer in a number of steps, m."""
    odometry = params.odometry
    variance = steps * odometry.distance_sigma**2 + (odometry.distance_bias_sigma * distance) ** 2
    return jnp.sqrt(variance + wander_variance(distance, odometry.wander))


def believed_start(params: EnvParams) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the believed station of the start and its standard deviation, m; anywhere, where that is the task."""
    if params.errand == "report":
        room = params.tunnel.length - 2.0 * params.goal.margin
        return 0.5 * params.tunnel.length, room / jnp.sqrt(12.0)
    return jnp.asarray(params.start.station, jnp.float32), jnp.asarray(params.start.station_sigma, jnp.float32)
