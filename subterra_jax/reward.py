"""Reward of the paper, Eq. 1, term by term."""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float


@struct.dataclass
class RewardParams:
    """Weights of the terms. The paper prints none; with these PPO learns the task.

    Attributes:
        terminal: Paid once, on success.
        coverage: g, for the share of the tunnel newly covered.
        lateral: c_d, charged for the distance from the centreline over the half-width.
        jerk: c_s, charged for the change of command, m/s and rad/s alike.
    """

    terminal: float = 1.0
    coverage: float = 100.0
    lateral: float = 0.1
    jerk: float = 0.01


def reward_terms(
    *,
    success: Bool[Array, ""],
    newly_covered: Float[Array, ""],
    length: Float[Array, ""],
    lateral: Float[Array, ""],
    half_width: Float[Array, ""],
    command: Float[Array, "2"],
    previous: Float[Array, "2"],
    params: RewardParams,
) -> dict[str, Float[Array, ""]]:
    """The terms of one step's reward; the reward is their sum.

    Args:
        success: Whether the task was achieved at this step.
        newly_covered: Arc length beyond the furthest station so far, m; 0 on ground covered before.
        length: Length of the tunnel, m.
        lateral: Distance to the left of the centreline, m.
        half_width: Half the local width, m.
        command: Speed (m/s) and yaw rate (rad/s) of this step, after clipping.
        previous: The same of the step before; zeros at the start of an episode.
        params: Weights.

    Source: paper, Eq. 1.
    """
    change = jnp.abs(command - previous)
    return {
        "reward_terminal": params.terminal * success,
        "reward_coverage": params.coverage * newly_covered / length,
        "reward_lateral": -params.lateral * jnp.abs(lateral) / half_width,
        "reward_jerk": -params.jerk * (change[0] + change[1]),
    }
