"""T0, the paper's task: cover nine tenths of the tunnel without touching it."""

import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax import constants
from subterra_jax.parts.part import Step
from subterra_jax.rules.rule import Rule, Verdict, jerk
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import Tunnel


@struct.dataclass
class RewardParams:
    """Weights of the paper's reward, Eq. 1. The paper prints none; with these PPO learns the task.

    Attributes:
        terminal: Reward of success, once.
        coverage: g, reward of the fraction of the tunnel newly covered.
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
        weights, place, before = params.reward, step.place, step.before
        newly_covered = step.furthest - before.furthest  # m; 0 on ground covered before
        terms = {
            "reward_terminal": weights.terminal * success.astype(newly_covered.dtype),
            "reward_coverage": weights.coverage * newly_covered / step.tunnel.length,
            "reward_lateral": -weights.lateral * jnp.abs(place.lateral) / place.half_width,
            "reward_jerk": -weights.jerk * jerk(step.command, before.command),
        }
        return Verdict(success, success, terms)

    def shortest_way(self, state: State, tunnel: Tunnel, params: EnvParams) -> Float[Array, ""]:
        return params.goal_coverage * tunnel.length - state.station
