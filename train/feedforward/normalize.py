"""Running statistics: observations to zero mean and unit variance, rewards divided by the spread of the return."""

from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from train.brax_parts import running_statistics

Statistics: TypeAlias = running_statistics.RunningStatisticsState
# A reading that has not moved yet, like odometry at a start, would otherwise be divided by nothing.
_STD_MIN = 1e-3
_LARGEST = 10.0


def init(shape: tuple[int, ...]) -> Statistics:
    """Statistics of nothing yet: mean 0, standard deviation 1."""
    statistics = running_statistics.init_state(jnp.zeros(shape, jnp.float32))
    return jax.tree.map(
        jnp.asarray, statistics
    )  # Brax starts with Python numbers, which would compile everything twice


def update(statistics: Statistics, batch: Float[Array, "..."], parts: tuple[str, ...] = ()) -> Statistics:
    """The statistics after one more batch, whose leading axes are all batch axes, of all parts."""
    return running_statistics.update(statistics, batch, std_min_value=_STD_MIN, pmap_axis_name=parts or None)


def normalize(observation: Float[Array, "*batch obs"], statistics: Statistics) -> Float[Array, "*batch obs"]:
    """The observation in standard deviations from its mean, clipped to ± 10."""
    return running_statistics.normalize(observation, statistics, max_abs_value=_LARGEST)


def discounted_returns(
    so_far: Float[Array, "env"],
    reward: Float[Array, "time env"],
    done: Bool[Array, "time env"],
    discount: float,
) -> tuple[Float[Array, "env"], Float[Array, "time env"]]:
    """Discounted sum of the rewards of an episode up to every step.

    Rewards are divided by the standard deviation of this sum, so that returns are of order 1 whatever the task pays.

    Args:
        so_far: The sum before the first step; 0 where an episode begins there.
        reward: Reward of every step.
        done: Whether the step was its episode's last.
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
