"""Dead reckoning: command and odometer fused by their nominal errors, with the delay of what is observed.

An odometer that reads exactly what it read before, or where its noise goes on less than half of what was commanded, has
stopped counting: then the command counts alone. One that has not moved since the robot set off shows how old the
observations are.
"""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.baselines.agent import Observed
from subterra_jax.baselines.stations import slip_sizes
from subterra_jax.parts.faults import MAX_DELAY
from subterra_jax.parts.unicycle import wrap
from subterra_jax.state import EnvParams

# Weight of the odometer for ring counting; its errors and the command's are independent: 2 % + 1 % and 2 % + 2 %.
ODOMETER_SHARE = 0.6
_LEAST_COMMAND, _STILL_SHARE = 0.03, 0.5  # m, 1; half of a step is five standard deviations at full speed


@struct.dataclass
class Reckoning:
    """Dead reckoning of one robot.

    Attributes:
        distance: Last reading of the odometer's distance, m.
        heading: Last reading of its heading, rad.
        speeds: Commanded speeds of the last steps, newest first, m/s.
        delay: Age of the observations, steps, as far as it showed when the robot set off.
        waiting: 1 until the odometer first moves.
    """

    distance: Float[Array, ""]
    heading: Float[Array, ""]
    speeds: Float[Array, "5"]
    delay: Int[Array, ""]
    waiting: Float[Array, ""]


def begin_reckoning(obs: Observed) -> Reckoning:
    """Return the dead reckoning before the first step."""
    return Reckoning(obs.distance, obs.heading, jnp.zeros(MAX_DELAY + 1), jnp.zeros((), jnp.int32), jnp.ones(()))


def reckon(
    before: Reckoning,
    obs: Observed,
    speed: Float[Array, ""],
    odometer_share: Float[Array, ""] | float,
    period: Float[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, ""], Reckoning]:
    """Advances dead reckoning by one observation.

    Args:
        before: Dead reckoning before it.
        obs: The observation.
        speed: Speed of the command before it, m/s.
        odometer_share: Weight of the odometer's distance, 1; the rest is the command's.
        period: Control period, s.

    Returns:
        Distance (m), turn (rad; NaN where unknown), and dead reckoning after it.
    """
    moved, turned = obs.distance - before.distance, wrap(obs.heading - before.heading)
    still = (moved == 0.0) & (turned == 0.0)
    if obs.start is not None:
        still = seems_still(moved, speed * period)
    waiting = jnp.where(still, before.waiting, 0.0)
    late = (waiting > 0.0) & (speed > 0.0)
    delay = jnp.minimum(before.delay + late.astype(jnp.int32), MAX_DELAY)
    speeds = jnp.concatenate([speed[None], before.speeds[:-1]])
    share = jnp.where(still, 0.0, odometer_share)
    distance = jnp.where(waiting > 0.0, 0.0, share * moved + (1.0 - share) * speeds[delay] * period)
    turn = jnp.where(waiting > 0.0, 0.0, jnp.where(still, jnp.nan, turned))
    return distance, turn, Reckoning(obs.distance, obs.heading, speeds, delay, waiting)


def seems_still(read: Float[Array, "*env"], commanded: Float[Array, "*env"]) -> Bool[Array, "*env"]:
    """Tell whether an odometer seems to have stopped counting, where its noise goes on (tasks of version 1).

    Args:
        read: Distance added in a step, m.
        commanded: Distance commanded in that step, m; below 3 cm noise of 1 cm would decide.
    """
    return (commanded > _LEAST_COMMAND) & (jnp.abs(read) < _STILL_SHARE * commanded)


def unobserved_distance(now: Reckoning, period: Float[Array, ""]) -> Float[Array, ""]:
    """Return the distance of the commands whose effect is not observed yet, m."""
    late = jnp.where(jnp.arange(MAX_DELAY + 1) < now.delay, now.speeds, 0.0)
    return period * jnp.sum(late)


@struct.dataclass
class StepDistances:
    """Distances of one step, by command and by odometer.

    Attributes:
        commanded: Distance commanded, m.
        read: Distance added by the odometer, m; exactly 0 from one that has stopped counting.
    """

    commanded: Float[Array, "*env"]
    read: Float[Array, "*env"]

    def __mul__(self, cosine: Float[Array, "*env"]) -> "StepDistances":
        """Return the distances along an axis at an angle with this cosine."""
        return StepDistances(self.commanded * cosine, self.read * cosine)


@struct.dataclass
class Delay:
    """Delay of the observations of a batch of robots.

    Attributes:
        commands: Distances commanded in the last steps, newest first, m.
        delay: Age of the observations, steps, as far as it showed when the robot set off.
        waiting: 1 until the odometer first moves.
    """

    commands: Float[Array, "*env 5"]
    delay: Float[Array, "*env"]
    waiting: Float[Array, "*env"]


def begin_delay(batch: tuple[int, ...]) -> Delay:
    """Return the delay before anything was observed."""
    return Delay(jnp.zeros((*batch, MAX_DELAY + 1)), jnp.zeros(batch), jnp.ones(batch))


def advance_delay(before: Delay, moved: StepDistances) -> tuple[Float[Array, "*env"], Float[Array, "*env"], Delay]:
    """Advances by one step.

    Args:
        before: Delay before the step.
        moved: Distances of the step.

    Returns:
        Distance driven between this observation and the last one (m), distance driven since by commands whose effect
        is not observed yet (m), and the delay after the step.
    """
    commands = jnp.concatenate([moved.commanded[..., None], before.commands[..., :-1]], axis=-1)
    still = moved.read == 0.0
    late = (before.waiting > 0.0) & still & (moved.commanded != 0.0)
    # An odometer that was frozen from the start would never end the waiting.
    frozen = late & (before.delay >= MAX_DELAY)
    waiting = jnp.where(still & ~frozen, before.waiting, 0.0)
    delay = jnp.minimum(before.delay + late, float(MAX_DELAY))
    then = jnp.sum(jnp.where(jnp.arange(MAX_DELAY + 1) == delay[..., None], commands, 0.0), axis=-1)
    driven = then + jnp.where(still, 0.0, ODOMETER_SHARE) * (moved.read - then)
    now = Delay(commands, delay, waiting)
    return jnp.where(waiting > 0.0, 0.0, driven), delayed_distance(now), now


def delayed_distance(delay: Delay) -> Float[Array, "*env"]:
    """Return the distance of the commands whose effect is not observed yet, m."""
    late = jnp.arange(MAX_DELAY + 1) < delay.delay[..., None]
    return jnp.sum(jnp.where(late, delay.commands, 0.0), axis=-1)


def odometer_share(params: EnvParams) -> float:
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
