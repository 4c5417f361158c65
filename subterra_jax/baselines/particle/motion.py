"""Dead reckoning for a filter: command and odometer fused by their nominal errors; the command alone where it fails."""

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from subterra_jax.baselines.agent import Observed
from subterra_jax.baselines.drift import fault_sizes, slip_sizes
from subterra_jax.baselines.particle.cloud import CloudParams
from subterra_jax.parts.faults import MAX_DELAY
from subterra_jax.parts.unicycle import wrap
from subterra_jax.parts.wander import WanderParams
from subterra_jax.state import EnvParams

# As often as 10 m patches change, 1/m, in a cloud of which some particles must be right at once.
_SLIP_RATE = 0.1


@struct.dataclass
class Reckoning:
    """What dead reckoning remembers.

    Attributes:
        distance: The odometer's distance when it was last read, m.
        heading: Its heading, rad.
        speeds: Commanded speeds of the last steps, newest first, m/s.
        delay: Age of what is observed, steps, as far as it showed when the robot set off.
        waiting: 1 until the odometer first moves.
    """

    distance: Float[Array, ""]
    heading: Float[Array, ""]
    speeds: Float[Array, "5"]
    delay: Int[Array, ""]
    waiting: Float[Array, ""]


def first_reckoning(obs: Observed) -> Reckoning:
    """Nothing travelled yet."""
    return Reckoning(obs.distance, obs.heading, jnp.zeros(MAX_DELAY + 1), jnp.zeros((), jnp.int32), jnp.ones(()))


def reckoned(
    before: Reckoning,
    obs: Observed,
    speed: Float[Array, ""],
    odometer_share: Float[Array, ""] | float,
    period: Float[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, ""], Reckoning]:
    """What the newest observation adds.

    An odometer that reads exactly what it read before has frozen: then the command alone counts. One that has not moved
    since the robot set off tells how old what one observes is.

    Args:
        before: What is remembered.
        obs: The observation.
        speed: Speed of the command before it, m/s.
        odometer_share: Weight of the odometer's distance, the rest being the command's, 1.
        period: Control period, s.

    Returns:
        Distance (m), turn (rad; NaN where it is not known), and what is remembered now.
    """
    moved, turned = obs.distance - before.distance, wrap(obs.heading - before.heading)
    still = (moved == 0.0) & (turned == 0.0)
    waiting = jnp.where(still, before.waiting, 0.0)
    late = (waiting > 0.0) & (speed > 0.0)
    delay = jnp.minimum(before.delay + late.astype(jnp.int32), MAX_DELAY)
    speeds = jnp.concatenate([speed[None], before.speeds[:-1]])
    share = jnp.where(still, 0.0, odometer_share)
    distance = jnp.where(waiting > 0.0, 0.0, share * moved + (1.0 - share) * speeds[delay] * period)
    turn = jnp.where(waiting > 0.0, 0.0, jnp.where(still, jnp.nan, turned))
    return distance, turn, Reckoning(obs.distance, obs.heading, speeds, delay, waiting)


def unseen(now: Reckoning, period: Float[Array, ""]) -> Float[Array, ""]:
    """Distance of the commands whose effect is not observed yet, m."""
    late = jnp.where(jnp.arange(MAX_DELAY + 1) < now.delay, now.speeds, 0.0)
    return period * jnp.sum(late)


def odometer_share(params: EnvParams) -> float:
    """Weight of the odometer that makes the variance of the fused scale least: inverse to the nominal variances."""
    odometer, plant = (lasting**2 + changing**2 for lasting, changing in (_odometer(params), _plant(params)))
    return plant / (odometer + plant) if odometer + plant > 0.0 else 1.0


def cloud_params(params: EnvParams) -> CloudParams:
    """How a cloud moves under the nominal errors of a task; on the host."""
    share = odometer_share(params)
    (lasting, changing), (plant_lasting, plant_changing) = _odometer(params), _plant(params)
    fused = lambda a, b: float(np.hypot(share * a, (1.0 - share) * b))  # noqa: E731
    wander = params.slip.wander if "slip" in params.parts else params.odometry.wander
    return CloudParams(
        scale_sigma=fused(lasting, plant_lasting),
        wander=WanderParams(fused(changing, plant_changing), 30.0 if wander is None else float(wander.length)),
        step_sigma=max(0.005, share * float(params.odometry.distance_sigma)),
        slip_rate=_SLIP_RATE if "faults" in params.parts else 0.0,
        slip_loss=float(fault_sizes(params).wet_loss),
    )


def _odometer(params: EnvParams) -> tuple[float, float]:
    """Nominal lasting and changing error of the odometer's scale, 1."""
    wander = params.odometry.wander
    return float(params.odometry.distance_bias_sigma), 0.0 if wander is None else float(wander.sigma)


def _plant(params: EnvParams) -> tuple[float, float]:
    """Nominal lasting and changing error of the command's scale, 1."""
    slip = slip_sizes(params)
    return float(slip.gain_sigma), float(slip.wander.sigma)
