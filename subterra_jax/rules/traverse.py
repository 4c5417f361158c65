"""T0, the paper's task: cover nine tenths of the tunnel without touching it."""

import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax import constants
from subterra_jax.parts.part import Step
from subterra_jax.rules.rule import Rule, Terms, Verdict, jerk
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import Tunnel


@struct.dataclass
class RewardParams:
    """Weights of the paper's reward, Eq. 1. The paper prints none; with these PPO learns the task.

    Attributes:
        terminal: Reward of success, once.
        coverage: g, reward of the share of the tunnel newly covered.
        lateral: c_d, cost of the distance from the centreline over the half-width.
        jerk: c_s, cost of the change of command, m/s and rad/s alike.
    """

    terminal: float = constants.REWARD_TERMINAL
    coverage: float = constants.REWARD_COVERAGE
    lateral: float = constants.REWARD_LATERAL
    jerk: float = constants.REWARD_JERK


@dataclasses.dataclass(frozen=True)
class Traverse(Rule):
    """Success is coverage."""

    key: ClassVar[str] = "traverse"
    covers: ClassVar[bool] = True

    def defaults(self) -> dict[str, Any]:
        return {**super().defaults(), "reward": RewardParams(), "goal_coverage": constants.GOAL_COVERAGE}

    def judge(self, step: Step, params: EnvParams) -> Verdict:
        coverage = jnp.clip(step.furthest / step.tunnel.length, 0.0, 1.0)
        success = (coverage >= params.goal_coverage) & ~step.contact
        terms = reward_terms(
            success=success,
            newly_covered=step.furthest - step.before.furthest,
            length=step.tunnel.length,
            lateral=step.place.lateral,
            half_width=step.place.half_width,
            command=step.command,
            previous=step.before.command,
            params=params.reward,
        )
        return Verdict(success, success, terms)

    def shortest_way(self, state: State, tunnel: Tunnel, params: EnvParams) -> Float[Array, ""]:
        return params.goal_coverage * tunnel.length - state.station


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
    """Return the terms of one step's reward; the reward is their sum.

    Args:
        success: The task was achieved at this step.
        newly_covered: Arc length beyond the furthest station so far, m; 0 on ground covered before.
        length: Length of the tunnel, m.
        lateral: Distance to the left of the centreline, m.
        half_width: Half the local width, m.
        command: Speed (m/s) and yaw rate (rad/s) of this step, after clipping.
        previous: Command of the step before; zeros at the start of an episode.
        params: Weights.

    Source: paper, Eq. 1.
    """
    return {
        "reward_terminal": params.terminal * success.astype(newly_covered.dtype),
        "reward_coverage": params.coverage * newly_covered / length,
        "reward_lateral": -params.lateral * jnp.abs(lateral) / half_width,
        "reward_jerk": -params.jerk * jerk(command, previous),
    }
