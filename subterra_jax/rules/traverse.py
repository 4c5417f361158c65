"""T0, the paper's task: cover nine tenths of the tunnel without touching it."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array

from subterra_jax import reward
from subterra_jax.rules.rule import Rule, Step, Verdict
from subterra_jax.state import EnvParams, ResetNoise
from subterra_jax.tunnel import Tunnel


@dataclasses.dataclass(frozen=True)
class Traverse(Rule):
    """Success is coverage."""

    def begin(self, noise: ResetNoise, tunnel: Tunnel, params: EnvParams) -> tuple[Array, Array, None]:
        """Always the same station, facing forward."""
        del noise, tunnel
        return jnp.asarray(params.start.station, jnp.float32), jnp.zeros(()), None

    def judge(self, step: Step, params: EnvParams) -> Verdict:
        """Coverage reached, the paper's reward."""
        assert isinstance(params.reward, reward.RewardParams)
        coverage = jnp.clip(step.furthest / step.tunnel.length, 0.0, 1.0)
        success = (coverage >= params.goal_coverage) & ~step.contact
        terms = reward.reward_terms(
            success=success,
            newly_covered=step.furthest - step.before.furthest,
            length=step.tunnel.length,
            lateral=step.place.lateral,
            half_width=step.place.half_width,
            command=step.command,
            previous=step.before.command,
            params=params.reward,
        )
        return Verdict(success, success, terms, None, {})
