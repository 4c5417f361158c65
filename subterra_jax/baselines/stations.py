"""Estimates of the station from the odometer or the truth, their errors, and the sizes of the task's errors."""

from typing import Any, Protocol

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.baselines.agent import Known, Observed
from subterra_jax.parts.faults import FaultParams
from subterra_jax.parts.slip import SlipParams
from subterra_jax.parts.wander import WanderParams
from subterra_jax.state import EnvParams

_LEAST = 0.01  # m; smallest standard deviation of an estimate
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


def odometry_sigma(distance: Float[Array, ""], steps: Float[Array, ""], params: EnvParams) -> Float[Array, ""]:
    """Compute the standard deviation of a distance counted by the odometer in a number of steps, m."""
    odometry = params.odometry
    variance = steps * odometry.distance_sigma**2 + (odometry.distance_bias_sigma * distance) ** 2
    return jnp.sqrt(variance + wander_variance(distance, odometry.wander))


def told_start(obs: Observed, params: EnvParams) -> Float[Array, ""]:
    """Return the station of the start as reported, m."""
    return jnp.asarray(params.start.station if obs.start is None else obs.start, jnp.float32)


def believed_start(obs: Observed, params: EnvParams) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the believed station of the start and its standard deviation, m; anywhere, where that is the task."""
    if params.goal_kind == "report":
        room = params.tunnel.length - 2.0 * params.goal.margin
        return 0.5 * params.tunnel.length, room / jnp.sqrt(12.0)
    return told_start(obs, params), jnp.asarray(params.start.station_sigma, jnp.float32)


@struct.dataclass
class Station:
    """Estimate of the station."""

    station: Float[Array, ""]  # estimated station, m
    log_sigma: Float[Array, ""]  # log of its standard deviation in m
    direction: Float[Array, ""]  # 1 where the robot faces growing stations, else -1


@struct.dataclass
class Driven:
    """Motion since the last estimate."""

    speed: Float[Array, ""]  # commanded speed, m/s; 0 before the first command
    cosine: Float[Array, ""]  # cosine of the angle between heading and axis, by the steering
    direction: Float[Array, ""]  # 1 on the way out, -1 on the way back
    flagged: Bool[Array, ""]  # true where the flag has just been raised: the goal is `flag_reach` away
    walls: Any = None  # memory of the steering: the walls that it tracks


class Localiser(Protocol):
    """Estimates the station; a `flax.struct.dataclass` without state."""

    @property
    def privileged(self) -> bool:
        """True where it gets the truth of `TunnelEnv.privileged`."""
        return False

    def begin(self, obs: Observed, params: EnvParams) -> Any:
        """Returns the memory at the start."""

    def update(
        self, memory: Any, obs: Observed, driven: Driven, params: EnvParams, known: Known
    ) -> tuple[Station, Any]:
        """Returns the estimate after a step, and the memory."""


@struct.dataclass
class Count:
    """Memory of a localiser that sums distances."""

    station: Float[Array, ""]  # estimated station, m
    start_sigma: Float[Array, ""]  # standard deviation of the station of the start, m
    distance: Float[Array, ""]  # summed distance, m
    steps: Float[Array, ""]  # number of steps
    reading: Float[Array, ""]  # last reading of the odometer, m


@struct.dataclass
class OdometerCount(Localiser):
    """Sums the odometer's readings from the believed start."""

    def begin(self, obs: Observed, params: EnvParams) -> Count:
        zero = jnp.zeros(())
        return Count(*believed_start(obs, params), zero, zero, obs.distance)

    def update(
        self, memory: Count, obs: Observed, driven: Driven, params: EnvParams, known: Known
    ) -> tuple[Station, Count]:
        step = obs.distance - memory.reading
        station = memory.station + driven.direction * driven.cosine * step
        distance, steps = memory.distance + jnp.abs(step), memory.steps + 1.0
        sigma = odometry_sigma(distance, steps, params)
        variance = jnp.maximum(sigma * sigma + memory.start_sigma * memory.start_sigma, _LEAST * _LEAST)
        estimate = Station(station, 0.5 * jnp.log(variance), driven.direction)
        return estimate, Count(station, memory.start_sigma, distance, steps, obs.distance)


@struct.dataclass
class Truth(Localiser):
    """Knows the truth: the best possible localiser."""

    privileged = True

    def begin(self, obs: Observed, params: EnvParams) -> Float[Array, ""]:
        return jnp.zeros(())

    def update(
        self, memory: Float[Array, ""], obs: Observed, driven: Driven, params: EnvParams, known: Known
    ) -> tuple[Station, Float[Array, ""]]:
        assert known is not None
        direction = jnp.where(known["heading_cos"] > 0.0, 1.0, -1.0)
        return Station(known["station"], jnp.full((), -5.0), direction), memory
