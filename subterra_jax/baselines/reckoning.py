"""Dead reckoning: command and odometer fused by their nominal errors, with the delay of what is observed.

An odometer that reads less than half of what was commanded has stopped counting: then the command counts alone. One
that has not moved since the robot set off shows how old the observations are.
"""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.baselines.agent import Known, Observed
from subterra_jax.baselines.stations import slip_sizes
from subterra_jax.parts.faults import MAX_DELAY, N_SEVERITIES
from subterra_jax.parts.unicycle import wrap
from subterra_jax.state import EnvParams

_LEAST_COMMAND, _STILL_FRACTION = 0.03, 0.5  # m, 1; half of a step is five standard deviations at full speed


@struct.dataclass
class Reckoning:
    """Dead reckoning of one robot."""

    distance: Float[Array, ""]  # last reading of the odometer's distance, m
    heading: Float[Array, ""]  # last reading of its heading, rad
    speeds: Float[Array, "5"]  # commanded speeds of the last steps, newest first, m/s
    delay: Int[Array, ""]  # age of the observations, steps, as far as it showed when the robot set off
    waiting: Float[Array, ""]  # 1 until the odometer first moves


def begin_reckoning(obs: Observed) -> Reckoning:
    """Return the dead reckoning before the first step."""
    return Reckoning(obs.distance, obs.heading, jnp.zeros(MAX_DELAY + 1), jnp.zeros((), jnp.int32), jnp.ones(()))


def reckon(
    before: Reckoning,
    obs: Observed,
    speed: Float[Array, ""],
    odometer_fraction: Float[Array, ""] | float,
    period: Float[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, ""], Reckoning]:
    """Advances dead reckoning by one observation.

    Args:
        before: Dead reckoning before it.
        speed: Speed of the command before it, m/s.
        odometer_fraction: Weight of the odometer's distance, 1; the rest is the command's.
        period: Control period, s.

    Returns:
        Distance (m), turn (rad; NaN where unknown), and dead reckoning after it.
    """
    moved, turned = obs.distance - before.distance, wrap(obs.heading - before.heading)
    still = seems_still(moved, speed * period)
    late = (before.waiting > 0.0) & still
    # One that was frozen from the start would never end the waiting.
    waits = (still & (before.delay < MAX_DELAY)) | (speed <= 0.0)
    waiting = jnp.where(waits, before.waiting, 0.0)
    delay = jnp.minimum(before.delay + late.astype(jnp.int32), MAX_DELAY)
    speeds = jnp.concatenate([speed[None], before.speeds[:-1]])
    fraction = jnp.where(still, 0.0, odometer_fraction)
    distance = jnp.where(waiting > 0.0, 0.0, fraction * moved + (1.0 - fraction) * speeds[delay] * period)
    turn = jnp.where(waiting > 0.0, 0.0, jnp.where(still, jnp.nan, turned))
    return distance, turn, Reckoning(obs.distance, obs.heading, speeds, delay, waiting)


def known_delay(before: Reckoning, params: EnvParams, known: Known) -> Reckoning:
    """Return the dead reckoning with the delay that the episode has, where the truth is given and faults are drawn."""
    if known is None or "fault_delay" not in known:
        return before
    fraction = known["severity"] / (N_SEVERITIES - 1)
    delay = jnp.clip(jnp.round(params.faults.delay * known["fault_delay"] * fraction), 0, MAX_DELAY).astype(jnp.int32)
    return dataclasses.replace(before, delay=delay, waiting=jnp.zeros_like(before.waiting))


def seems_still(read: Float[Array, ""], commanded: Float[Array, ""]) -> Bool[Array, ""]:
    """Tell by the distances read and commanded in a step, m, whether an odometer seems to have stopped counting.

    Its noise may go on; below 3 cm noise of 1 cm would decide.
    """
    return (commanded > _LEAST_COMMAND) & (jnp.abs(read) < _STILL_FRACTION * commanded)


def unobserved_distance(now: Reckoning, period: Float[Array, ""]) -> Float[Array, ""]:
    """Return the distance of the commands whose effect is not observed yet, m."""
    late = jnp.where(jnp.arange(MAX_DELAY + 1) < now.delay, now.speeds, 0.0)
    return period * jnp.sum(late)


def odometer_fraction(params: EnvParams) -> float:
    """Return the weight of the odometer that minimises the variance of the fused scale: inverse to the variances."""
    errors = odometer_errors(params), command_errors(params)
    odometer, plant = (lasting**2 + changing**2 for lasting, changing in errors)
    return plant / (odometer + plant) if odometer + plant > 0.0 else 1.0


def odometer_errors(params: EnvParams) -> tuple[float, float]:
    """Return the nominal lasting and changing error of the odometer's scale, 1."""
    wander = params.odometry.wander
    return float(params.odometry.distance_bias_sigma), 0.0 if wander is None else float(wander.sigma)


def command_errors(params: EnvParams) -> tuple[float, float]:
    """Return the nominal lasting and changing error of the command's scale, 1."""
    slip = slip_sizes(params)
    return float(slip.gain_sigma), float(slip.wander.sigma)
