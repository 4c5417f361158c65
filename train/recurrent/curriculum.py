"""A task that becomes harder while it is learnt."""

from typing import Any

import jax.numpy as jnp


def nearer(params: Any, progress: Any, until: float) -> Any:
    """The task with goals as far away as is fit after a share of the training: a third of them at first.

    Args:
        params: The task.
        progress: Share of the training that is done.
        until: Share after which goals are as far away as the task has them.
    """
    share = jnp.clip(progress / max(until, 1e-6), 0.0, 1.0)
    goal = params.goal
    far = (1.0 + 2.0 * share) / 3.0
    high = jnp.maximum(goal.low, goal.high * far * far)
    # A stop is ten steps below 5 cm/s, which no random policy ever does: at first one slow step is enough.
    still_steps = jnp.maximum(1, jnp.floor(goal.still_steps * jnp.minimum(2.0 * share, 1.0))).astype(jnp.int32)
    still_speed = goal.still_speed + 0.15 * (1.0 - jnp.minimum(2.0 * share, 1.0))
    goal = goal.replace(low=goal.low * (0.3 + 0.7 * share), high=high, still_steps=still_steps, still_speed=still_speed)
    return params.replace(goal=goal)
