"""Parts of learning: running statistics, advantages, PPO's objective, and epochs of minibatches."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from train import devices

# A reading that has not moved yet, such as odometry at a start, would otherwise be divided by nothing.
_STD_MIN = 1e-3
_LARGEST = 10.0


@struct.dataclass
class Statistics:
    """Running mean and standard deviation."""

    count: Float[Array, ""]  # numbers seen
    mean: Float[Array, "*n"]  # their mean
    square: Float[Array, "*n"]  # sum of squares of their distances from it

    @property
    def std(self) -> Float[Array, "*n"]:
        """Standard deviation, at least 0.001; 1 before any number."""
        spread = jnp.sqrt(self.square / jnp.maximum(self.count, 1.0))
        return jnp.where(self.count > 0.0, jnp.maximum(spread, _STD_MIN), 1.0)


def start_statistics(shape: tuple[int, ...]) -> Statistics:
    """Returns statistics of no data yet: mean 0, standard deviation 1."""
    return Statistics(jnp.zeros(()), jnp.zeros(shape), jnp.zeros(shape))


def update_statistics(statistics: Statistics, batch: Float[Array, "..."], split: devices.Parts = ()) -> Statistics:
    """Adds a batch of all parts to the statistics; its leading axes are all batch axes.

    Source: Chan et al., Updating Formulae and a Pairwise Algorithm for Computing Sample Variances, 1979.
    """
    axes = tuple(range(batch.ndim - statistics.mean.ndim))
    n_parts = jax.lax.psum(1.0, split) if split else 1.0
    n = n_parts * batch.size / max(statistics.mean.size, 1)
    mean = devices.mean_over_parts(jnp.mean(batch, axis=axes), split)
    square = n * devices.mean_over_parts(jnp.mean(jnp.square(batch - mean), axis=axes), split)
    total, apart = statistics.count + n, mean - statistics.mean
    return Statistics(
        count=total,
        mean=statistics.mean + apart * n / total,
        square=statistics.square + square + jnp.square(apart) * statistics.count * n / total,
    )


def normalize(observation: Float[Array, "*batch obs"], mean: Array, std: Array) -> Float[Array, "*batch obs"]:
    """Returns the observation in standard deviations from its mean, clipped to ± 10."""
    return jnp.clip((observation - mean) / std, -_LARGEST, _LARGEST)


def discounted_returns(
    so_far: Float[Array, "env"],
    reward: Float[Array, "time env"],
    done: Bool[Array, "time env"],
    discount: float,
) -> tuple[Float[Array, "env"], Float[Array, "time env"]]:
    """Sums the discounted rewards of an episode up to every step.

    Rewards are divided by the standard deviation of this sum, so that returns are of order 1 in every task.

    Args:
        so_far: The sum before the first step; 0 where an episode begins there.
        reward: Reward of every step.
        done: The step was its episode's last.
        discount: Per step.

    Returns:
        The sum to go on with after the rollout, and the sum at every step.

    Source: Engstrom et al., Implementation Matters in Deep Policy Gradients, 2020, Sec. 2 (reward scaling).
    """

    def forwards(total: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        reward_now, done_now = now
        total = discount * total + reward_now
        return jnp.where(done_now, 0.0, total), total

    return jax.lax.scan(forwards, so_far, (reward, done))


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
    """Estimates the advantages of a rollout's actions; plus `value`, they are the targets of the value function.

    After a termination nothing more can be earned, so the next value is 0. After a truncation the episode would have
    gone on, so the next value is that of its final observation, not of the first observation of the episode that
    follows. A step that is both counts as terminated. No advantage reaches across the end of an episode.

    Args:
        reward: Reward of every step.
        value: Value of the observation acted upon.
        last_value: Value of the observation after the last step of the rollout.
        final_value: Value of the final observation of an episode; read only where `truncated`.
        terminated: The step ended the episode for good.
        truncated: The step ended the episode by the clock.
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


def clipped_objective(
    log_ratio: Float[Array, "*batch"], advantage: Float[Array, "*batch"], clip: float
) -> dict[str, Float[Array, ""]]:
    """Computes PPO's clipped policy loss, the divergence from the old policy, and the fraction of clipped samples.

    Args:
        log_ratio: New less old log density of the actions.
        advantage: Of the actions, normalised.
        clip: Half-width of the trust region of the probability ratio.

    Source: Schulman et al., Proximal Policy Optimization Algorithms, 2017, Eq. 7.
    """
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - clip, 1.0 + clip)
    return {
        "policy_loss": -jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage)),
        # Never negative, and of lower variance than the mean of -log_ratio: http://joschu.net/blog/kl-approx.html
        "kl": jnp.mean(ratio - 1.0 - log_ratio),
        "clipped": jnp.mean(jnp.abs(ratio - 1.0) > clip),
    }


def auxiliary_loss(estimate: Float[Array, "*batch 2"], error: Float[Array, "*batch 1"]) -> Float[Array, ""]:
    """Returns the mean negative log likelihood of an error under a Laplace distribution about its estimate.

    Args:
        estimate: Error estimated, m, and log of its scale, m.
        error: True error, m.
    """
    log_scale = jnp.clip(estimate[..., 1], -4.0, 5.0)
    return jnp.mean(jnp.abs(error[..., 0] - estimate[..., 0]) * jnp.exp(-log_scale) + log_scale)


def take_envs(tree: Any, block: Array, width: int, axis: int) -> Any:
    """Returns a block of `width` environments of every leaf."""
    return jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, block * width, width, axis), tree)
