"""Estimates of the station without LiDAR: odometer, the best of all else, truth; and the sizes of the task's errors."""

import dataclasses
from typing import Any, Protocol

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.baselines.agent import Known, Observed
from subterra_jax.parts.faults import FaultParams
from subterra_jax.parts.slip import SlipParams, WanderParams
from subterra_jax.state import EnvParams

_S, _GAIN, _SLIP, _BIAS, _SCALE = range(5)  # of a `Belief`
_LEAST_STEP = 1e-3  # m; a shorter step holds no information on scales
_FLAG_SIGMA = 0.1  # m; the flag is noticed within one step of 0.2 m
_LEAST = 0.01  # m; smallest standard deviation of an estimate
_NO_SLIP = SlipParams(gain_sigma=0.0, yaw_sigma=0.0, wander=WanderParams(sigma=0.0))
_NO_FAULTS = FaultParams(wet_fraction=0.0, wet_loss=0.0)


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


def reported_start(obs: Observed, params: EnvParams) -> Float[Array, ""]:
    """Return the station of the start as reported, m."""
    return jnp.asarray(params.start.station if obs.start is None else obs.start, jnp.float32)


def believed_start(obs: Observed, params: EnvParams) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the believed station of the start and its standard deviation, m; anywhere, where that is the task."""
    if params.goal_kind == "report":
        room = params.tunnel.length - 2.0 * params.goal.margin
        return 0.5 * params.tunnel.length, room / jnp.sqrt(12.0)
    return reported_start(obs, params), jnp.asarray(params.start.station_sigma, jnp.float32)


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
class Belief:
    """A normal distribution."""

    # station (m), constant and wandering slip, constant and wandering scale error of the odometer
    mean: Float[Array, "5"]
    cov: Float[Array, "5 5"]  # its covariance
    reading: Float[Array, ""]  # last reading of the odometer, m


@struct.dataclass
class FusedCount(Localiser):
    """Fuses commands and odometry by a Kalman filter; to the first order in the errors, some percent, it is exact.

    The truth of a step is command × (1 + gain + slip), the odometer's reading truth × (1 + bias + scale) + noise; gain
    and bias last an episode, slip and scale wander. In tasks with a flag, its raising is a fix.
    """

    def begin(self, obs: Observed, params: EnvParams) -> Belief:
        start, start_sigma = believed_start(obs, params)
        sigmas = jnp.zeros(5).at[_S].set(start_sigma)
        slip = slip_sizes(params)
        sigmas = sigmas.at[_GAIN].set(slip.gain_sigma).at[_SLIP].set(slip.wander.sigma)
        sigmas = sigmas.at[_BIAS].set(params.odometry.distance_bias_sigma)
        if params.odometry.wander is not None:
            sigmas = sigmas.at[_SCALE].set(params.odometry.wander.sigma)
        mean = jnp.zeros(5).at[_S].set(start)
        return Belief(mean, jnp.diag(sigmas * sigmas), obs.distance)

    def update(
        self, memory: Belief, obs: Observed, driven: Driven, params: EnvParams, known: Known
    ) -> tuple[Station, Belief]:
        step = driven.speed * params.vehicle.period
        belief = _predict(memory, driven.direction * driven.cosine * step)
        # Only the ratio of reading to command is new, and it must not move the mean of the station by itself.
        read = obs.distance - memory.reading - step
        row = step * jnp.array([0.0, 1.0, 1.0, 1.0, 1.0])
        noise = params.odometry.distance_sigma**2
        corrected = _correct(belief, row, read, jnp.maximum(noise, 1e-10))
        belief = _where(step > _LEAST_STEP, corrected, belief)
        belief = _advance_errors(belief, step, params)
        if params.goal_kind == "return":
            at = obs.goal - driven.direction * params.goal.flag_reach
            fix = _correct(belief, jnp.eye(5)[_S], at - belief.mean[_S], jnp.asarray(_FLAG_SIGMA**2))
            belief = _where(driven.flagged, fix, belief)
        sigma = jnp.sqrt(jnp.maximum(belief.cov[_S, _S], 1e-4))
        estimate = Station(belief.mean[_S], jnp.log(sigma), driven.direction)
        return estimate, dataclasses.replace(belief, reading=obs.distance)


def _where(condition: Array, one: Belief, other: Belief) -> Belief:
    return dataclasses.replace(
        one, mean=jnp.where(condition, one.mean, other.mean), cov=jnp.where(condition, one.cov, other.cov)
    )


def _predict(belief: Belief, step: Float[Array, ""]) -> Belief:
    """Predicts the belief after a commanded step along the axis, m."""
    moved = jnp.zeros(5).at[_S].set(1.0)
    slips = belief.mean[_GAIN] + belief.mean[_SLIP]
    rows = belief.cov + moved[:, None] * step * (belief.cov[_GAIN] + belief.cov[_SLIP])[None]
    cov = rows + (rows[:, _GAIN] + rows[:, _SLIP])[:, None] * step * moved[None]
    return dataclasses.replace(belief, mean=belief.mean + moved * step * (1.0 + slips), cov=cov)


def _correct(belief: Belief, row: Float[Array, "5"], innovation: Float[Array, ""], noise: Float[Array, ""]) -> Belief:
    """Corrects by one scalar measurement; `innovation` is the reading less that of a world without errors."""
    spread = jnp.sum(belief.cov * row[None], axis=1)
    total = jnp.sum(row * spread) + noise
    gain = spread / total
    # The innovation of a row with the station is complete; the part of the errors is subtracted here.
    expected = jnp.sum(row.at[_S].set(0.0) * belief.mean)
    mean = belief.mean + gain * (innovation - expected)
    cov = belief.cov - gain[:, None] * spread[None]
    return dataclasses.replace(belief, mean=mean, cov=0.5 * (cov + cov.T))


def _advance_errors(belief: Belief, step: Float[Array, ""], params: EnvParams) -> Belief:
    """Advances the wandering errors over a distance, m."""
    keep, added = jnp.ones(5), jnp.zeros(5)
    for index, wander in ((_SLIP, slip_sizes(params).wander), (_SCALE, params.odometry.wander)):
        if wander is not None:
            ratio, variance = _process(wander, step)
            keep, added = keep.at[index].set(ratio), added.at[index].set(variance)
    cov = belief.cov * keep[:, None] * keep[None] + jnp.diag(added)
    return dataclasses.replace(belief, mean=belief.mean * keep, cov=cov)


def _process(wander: WanderParams, step: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    ratio = jnp.abs(step) / wander.length
    return jnp.exp(-ratio), -jnp.expm1(-2.0 * ratio) * wander.sigma**2


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
