"""How old what one observes is, and how far the robot had driven when it was so."""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.parts.faults import MAX_DELAY

# Command and odometry err independently; this is the weight of the second, for slips of 2 % + 2 % and 2 % + 1 %.
ODOMETER_SHARE = 0.6


@struct.dataclass
class Moved:
    """What command and odometer say of one step.

    Attributes:
        commanded: Distance commanded, m.
        read: Distance that the odometer has added, m; exactly 0 from one that has stopped counting.
    """

    commanded: Float[Array, "*env"]
    read: Float[Array, "*env"]

    def __mul__(self, cosine: Float[Array, "*env"]) -> "Moved":
        """The same along an axis at an angle."""
        return Moved(self.commanded * cosine, self.read * cosine)


@struct.dataclass
class Lag:
    """What tells the age of observations.

    Attributes:
        commands: Distances commanded in the last steps, newest first, m.
        delay: Age of what is observed, steps, as far as it showed when the robot set off.
        waiting: 1 until the odometer first moves.
    """

    commands: Float[Array, "*env 5"]
    delay: Float[Array, "*env"]
    waiting: Float[Array, "*env"]


def start(batch: tuple[int, ...]) -> Lag:
    """Nothing observed yet."""
    return Lag(jnp.zeros((*batch, MAX_DELAY + 1)), jnp.zeros(batch), jnp.ones(batch))


def advance(before: Lag, moved: Moved) -> tuple[Float[Array, "*env"], Float[Array, "*env"], Lag]:
    """After a step.

    An odometer that has not moved since the robot set off tells how old observations are; one that stands still later
    has frozen, and then the command of the time counts alone.

    Args:
        before: What was remembered.
        moved: What command and odometer say of the step.

    Returns:
        Distance driven between this observation and the one before it (m), distance driven since by commands whose
        effect is not observed yet (m), and what is remembered now.
    """
    commands = jnp.concatenate([moved.commanded[..., None], before.commands[..., :-1]], axis=-1)
    still = moved.read == 0.0
    late = (before.waiting > 0.0) & still & (moved.commanded != 0.0)
    # An odometer that has been frozen from the start would be waited for in vain.
    frozen = late & (before.delay >= MAX_DELAY)
    waiting = jnp.where(still & ~frozen, before.waiting, 0.0)
    delay = jnp.minimum(before.delay + late, float(MAX_DELAY))
    then = jnp.sum(jnp.where(jnp.arange(MAX_DELAY + 1) == delay[..., None], commands, 0.0), axis=-1)
    driven = then + jnp.where(still, 0.0, ODOMETER_SHARE) * (moved.read - then)
    now = Lag(commands, delay, waiting)
    return jnp.where(waiting > 0.0, 0.0, driven), unseen(now), now


def unseen(lag: Lag) -> Float[Array, "*env"]:
    """Distance driven by commands whose effect is not observed yet, m."""
    late = jnp.arange(MAX_DELAY + 1) < lag.delay[..., None]
    return jnp.sum(jnp.where(late, lag.commands, 0.0), axis=-1)
