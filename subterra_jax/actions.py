"""The action of an environment: a command, and where the task asks for it an estimate and the direction faced."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from subterra_jax.env import Box
from subterra_jax.state import EnvParams

COMMAND, ESTIMATE, REPORT = 2, 4, 5  # numbers in an action that holds a command, an estimate too, and a report
_LOG_SIGMA = 5.0  # largest size of the log of an estimate's standard deviation


def action_bounds(size: int, params: EnvParams) -> Box:
    """Return the bounds of an action of so many numbers."""
    speed, yaw_rate = (np.max(np.asarray(v)) for v in (params.vehicle.speed_max, params.vehicle.yaw_rate_max))
    length = np.max(np.asarray(params.tunnel.length))
    low, high = [0.0, -yaw_rate, 0.0, -_LOG_SIGMA, -1.0], [speed, yaw_rate, length, _LOG_SIGMA, 1.0]
    return Box(np.array(low[:size], np.float32), np.array(high[:size], np.float32))


def check_action(action: Any, size: int, id: str) -> Array:
    """Return an action as an array; refuse one of another shape.

    Raises:
        ValueError: The shape is not `(size,)`.
    """
    action = jnp.asarray(action)
    if action.shape != (size,):
        raise ValueError(f"an action of {id} has {size} numbers, got an array of shape {action.shape}")
    return action


def read_report(action: Float[Array, n_action], params: EnvParams) -> Float[Array, 3]:
    """Return estimate, log of its standard deviation and direction: clipped; 0 for a NaN and where absent."""
    size = action.shape[0]
    if size == COMMAND:
        return jnp.zeros(3, action.dtype)
    length = jnp.max(jnp.asarray(params.tunnel.length)).astype(action.dtype)
    low = jnp.array([0.0, -_LOG_SIGMA, -1.0], action.dtype)
    high = jnp.concatenate([length[None], jnp.array([_LOG_SIGMA, 1.0], action.dtype)])
    given = jnp.concatenate([action[COMMAND:], jnp.zeros(REPORT - size, action.dtype)])
    return jnp.clip(jnp.where(jnp.isnan(given), 0.0, given), low, high)
