"""Rewards, term by term: the paper's, Eq. 1, and the one of tasks with a goal."""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

Terms = dict[str, Float[Array, ""]]


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


@struct.dataclass
class GoalRewardParams:
    """Weights of the terms of tasks with a goal.

    Attributes:
        terminal: Paid once, on success.
        precision: Paid at a stop, times exp(-error / tolerance).
        miss: Charged at a stop or a contact, for each metre of error.
        crash: Charged at a contact, and for not reporting in time.
        progress: Paid for each metre by which the way to go has become shorter.
        time: Charged at every step.
        lateral: Charged for the distance from the centreline over the half-width.
        jerk: Charged for the change of command, m/s and rad/s alike.
    """

    terminal: float = 4.0
    precision: float = 4.0
    miss: float = 0.05
    crash: float = 1.0
    progress: float = 0.05
    time: float = 0.002
    lateral: float = 0.01
    jerk: float = 0.003


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
) -> Terms:
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
    return {
        "reward_terminal": params.terminal * success,
        "reward_coverage": params.coverage * newly_covered / length,
        "reward_lateral": -params.lateral * jnp.abs(lateral) / half_width,
        "reward_jerk": -params.jerk * _change(command, previous),
    }


def goal_terms(
    *,
    success: Bool[Array, ""],
    stopped: Bool[Array, ""],
    failed: Bool[Array, ""],
    error: Float[Array, ""],
    tolerance: Float[Array, ""],
    nearer: Float[Array, ""],
    lateral: Float[Array, ""],
    half_width: Float[Array, ""],
    command: Float[Array, "2"],
    previous: Float[Array, "2"],
    params: GoalRewardParams,
) -> Terms:
    """The terms of one step's reward in a task with a goal; the reward is their sum.

    Args:
        success: Whether the task was achieved at this step.
        stopped: Whether the robot has come to a stop, right or wrong.
        failed: Whether it touched something, or did not report in time.
        error: What is wrong at a stop, m.
        tolerance: Error of success, m.
        nearer: By how much the way to go has become shorter, m.
        lateral: Distance to the left of the centreline, m.
        half_width: Half the local width, m.
        command: Speed (m/s) and yaw rate (rad/s) of this step, after clipping.
        previous: The same of the step before; zeros at the start of an episode.
        params: Weights.
    """
    size = jnp.abs(error)
    return {
        "reward_terminal": params.terminal * success,
        "reward_precision": params.precision * stopped * jnp.exp(-size / tolerance),
        "reward_miss": -params.miss * (stopped | failed) * size,
        "reward_crash": -params.crash * failed,
        "reward_progress": params.progress * nearer,
        "reward_time": -params.time * jnp.ones_like(size),
        "reward_lateral": -params.lateral * jnp.abs(lateral) / half_width,
        "reward_jerk": -params.jerk * _change(command, previous),
    }


def _change(command: Float[Array, "2"], previous: Float[Array, "2"]) -> Float[Array, ""]:
    change = jnp.abs(command - previous)
    return change[0] + change[1]
