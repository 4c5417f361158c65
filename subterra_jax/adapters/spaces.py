"""Gymnasium spaces of an environment, and observations in the form that its space asks for."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from subterra_jax.env import TunnelEnv
from subterra_jax.state import EnvParams

PAPER_FIELDS = ("ranges", "odometry")  # of the paper's task, whose observation is the bare vector
Observation = np.ndarray | dict[str, np.ndarray]


def action_space(env: TunnelEnv, params: EnvParams) -> spaces.Box:
    """Bounds of an action."""
    box = env.action_space(params)
    return spaces.Box(box.low, box.high, dtype=np.float32)


def named_fields(env: TunnelEnv, params: EnvParams, flat: bool) -> dict[str, slice] | None:
    """Names of the parts of an observation; None where it is to be the bare vector.

    Args:
        env: The environment.
        params: Its params.
        flat: Whether a vector is wanted of every task. One whose observation is `PAPER_FIELDS` alone gives it anyway.
    """
    fields = env.fields(params)
    return None if flat or tuple(fields) == PAPER_FIELDS else fields


def observation_space(env: TunnelEnv, params: EnvParams, fields: Mapping[str, slice] | None) -> spaces.Space[Any]:
    """A `Box`, or a `Dict` of one `Box` for each named field."""
    box = env.observation_space(params)
    if fields is None:
        return spaces.Box(box.low, box.high, dtype=np.float32)
    # Gymnasium would sort a plain dict's keys by itself; the order of the fields is that of the vector.
    return spaces.Dict([(name, spaces.Box(box.low[at], box.high[at], dtype=np.float32)) for name, at in fields.items()])


def as_observation(vector: np.ndarray, fields: Mapping[str, slice] | None) -> Observation:
    """Vectors `(..., n_obs)` in the form of the space; the parts of a dict are views."""
    return vector if fields is None else {name: vector[..., at] for name, at in fields.items()}
