"""One-dimensional Kalman filter of station, slip and odometer errors: the best that is possible without LiDAR."""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.baselines.agent import Known, Observed
from subterra_jax.baselines.stations import Driven, Localiser, Station, believed_start, slip_sizes
from subterra_jax.parts.wander import WanderParams
from subterra_jax.state import EnvParams

_S, _GAIN, _SLIP, _BIAS, _SCALE = range(5)
_LEAST_STEP = 1e-3  # m; a shorter step holds no information on scales
_FLAG_SIGMA = 0.1  # m; the flag is noticed within one step of 0.2 m


@struct.dataclass
class Belief:
    """A normal distribution."""

    # station (m), constant and wandering slip, constant and wandering scale error of the odometer
    mean: Float[Array, "5"]
    cov: Float[Array, "5 5"]  # its covariance
    reading: Float[Array, ""]  # last reading of the odometer, m


@struct.dataclass
class FusedCount(Localiser):
    """Fuses commands and odometry; to the first order in the errors, which are some percent, it is exact.

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
    """Returns factor and added variance of one step of a wandering error."""
    ratio = jnp.abs(step) / wander.length
    return jnp.exp(-ratio), -jnp.expm1(-2.0 * ratio) * wander.sigma**2
