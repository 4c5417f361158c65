"""Generalised advantage estimation with the two ends of an episode kept apart."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def advantages(
    reward: Float[Array, "time *env"],
    value: Float[Array, "time *env"],
    last_value: Float[Array, "*env"],
    final_value: Float[Array, "time *env"],
    terminated: Bool[Array, "time *env"],
    truncated: Bool[Array, "time *env"],
    discount: float,
    gae_lambda: float,
) -> Float[Array, "time *env"]:
    """Advantages of the actions of a rollout; add `value` to get the targets of the value function.

    After a termination nothing more can be earned, so the next value is 0. After a truncation the episode would have
    gone on, so the next value is that of its final observation, not of the first observation of the episode that
    follows. A step that is both counts as terminated. No advantage reaches across the end of an episode.

    Args:
        reward: Reward of every step.
        value: Value of the observation acted upon.
        last_value: Value of the observation after the last step of the rollout.
        final_value: Value of the final observation of an episode; read only where `truncated`.
        terminated: Whether the step ended the episode for good.
        truncated: Whether the step ended the episode by the clock.
        discount: Per step.
        gae_lambda: Mix of one-step (0) and n-step (1) returns.

    Source: Schulman et al., High-Dimensional Continuous Control Using Generalized Advantage Estimation, 2016, Eq. 16.
    """
    next_value = jnp.concatenate([value[1:], last_value[None]], axis=0)
    next_value = jnp.where(truncated, final_value, next_value)
    next_value = jnp.where(terminated, 0.0, next_value)
    delta = reward + discount * next_value - value
    carry_on = discount * gae_lambda * (1.0 - (terminated | truncated))

    def backwards(later: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        delta_now, carry_on_now = now
        advantage = delta_now + carry_on_now * later
        return advantage, advantage

    _, result = jax.lax.scan(backwards, jnp.zeros_like(last_value), (delta, carry_on), reverse=True)
    return result
