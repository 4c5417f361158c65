"""Parts of learning that every learner shares: statistics, advantages, and epochs of minibatches.

Of Brax, its networks, distribution and running statistics are used. Importing them loads MuJoCo, which prints to stdout
the plugins that it did not find. Commands keep stdout for their own answers (`--json` is one line), so the import
happens with stdout closed. Brax's own PPO trainer is not used: it calls `jax.device_put_replicated`, which jax 0.10 no
longer has.
"""

import contextlib
import io
from collections.abc import Callable
from typing import Any, TypeAlias

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from subterra_jax.host.errors import MissingLibraryError
from subterra_jax.policies import senses
from train import devices

try:
    with contextlib.redirect_stdout(io.StringIO()):
        from brax.training.acme import running_statistics
        from brax.training.distribution import NormalTanhDistribution
        from brax.training.networks import MLP
except ImportError as missing:
    raise MissingLibraryError(__name__, "brax", "train") from missing

__all__ = [
    "MLP",
    "NormalTanhDistribution",
    "Statistics",
    "TrainState",
    "advantages",
    "clipped_adam",
    "clipped_objective",
    "descend",
    "discounted_returns",
    "glance",
    "normalize",
    "run_epochs",
    "split_keys",
    "start_statistics",
    "update_statistics",
]

Statistics: TypeAlias = running_statistics.RunningStatisticsState
# A reading that has not moved yet, such as odometry at a start, would otherwise be divided by nothing.
_STD_MIN = 1e-3
_LARGEST = 10.0
_PATCH_WIDTH, _GLANCE_WIDTH = 32, 64


@struct.dataclass
class TrainState:
    """State of a run between two iterations, of a learner that needs nothing else.

    Attributes:
        weights: Of the networks.
        moments: State of the optimiser.
        drive: State of the environments.
        key: Source of all later randomness.
        iteration: Iterations done.
    """

    weights: Any
    moments: Any
    drive: Any
    key: PRNGKeyArray
    iteration: Int[Array, ""]


def start_statistics(shape: tuple[int, ...]) -> Statistics:
    """Returns statistics of no data yet: mean 0, standard deviation 1."""
    statistics = running_statistics.init_state(jnp.zeros(shape, jnp.float32))
    # Brax starts with Python numbers, which would compile everything twice.
    return jax.tree.map(jnp.asarray, statistics)


def update_statistics(statistics: Statistics, batch: Float[Array, "..."], split: devices.Parts = ()) -> Statistics:
    """Adds a batch of all parts to the statistics; its leading axes are all batch axes."""
    return running_statistics.update(statistics, batch, std_min_value=_STD_MIN, pmap_axis_name=split or None)


def normalize(observation: Float[Array, "*batch obs"], statistics: Statistics) -> Float[Array, "*batch obs"]:
    """Returns the observation in standard deviations from its mean, clipped to ± 10."""
    return running_statistics.normalize(observation, statistics, max_abs_value=_LARGEST)


def glance(
    image: Float[Array, "*batch pixels"], shape: tuple[int, int], number: Any = jnp.float32
) -> Float[Array, "*batch 64"]:
    """Returns what a network sees of an image: first patch by patch, then as a whole. To be called in its `__call__`.

    Args:
        image: Ranges over 30 m, row by row.
        shape: Rows and columns, multiples of 4.
        number: Type that the layers compute with.
    """
    tiles = senses.patches(image, shape).astype(number)
    tiles = nn.swish(nn.Dense(_PATCH_WIDTH, name="patch", dtype=number)(tiles))
    tiles = tiles.reshape(*tiles.shape[:-2], -1)
    return nn.swish(nn.Dense(_GLANCE_WIDTH, name="glance", dtype=number)(tiles))


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
    """Computes PPO's clipped policy loss, the divergence from the old policy, and the share of clipped samples.

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


def clipped_adam(config: Any, final_share: float) -> optax.GradientTransformation:
    """Returns Adam with clipped gradients; its learning rate falls to a share of itself along a cosine."""
    updates = config.iterations * config.epochs * config.minibatches
    rate = optax.cosine_decay_schedule(config.learning_rate, updates, alpha=final_share)
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(rate, eps=1e-5))


def descend(optimizer: optax.GradientTransformation, learnt: tuple[Any, Any], gradients: Any) -> tuple[Any, Any]:
    """Takes one gradient step; `learnt` and the result are weights and the optimiser's moments."""
    weights, moments = learnt
    updates, moments = optimizer.update(gradients, moments)
    return optax.apply_updates(weights, updates), moments


def split_keys(key: PRNGKeyArray, shape: tuple[int, ...]) -> Array:
    """Returns one key for each of `shape[0]` minibatches."""
    return jax.random.split(key, shape[0])


def run_epochs(
    step: Callable[[Any, Array, Any], tuple[Any, Any]],
    start: Any,
    config: Any,
    key: PRNGKeyArray,
    make_keys: Callable[[PRNGKeyArray, tuple[int, ...]], Array] | None = split_keys,
) -> tuple[Any, Any]:
    """Takes a step for every minibatch of every epoch of one iteration.

    Args:
        step: From weights and moments, the minibatch's environments `(n,)` and its keys, to weights and moments
            afterwards, and scalars.
        start: Weights and moments before.
        config: A `TrainConfig`.
        key: Of the order of the environments, and of `make_keys`.
        make_keys: From a key and `(minibatches, n)` to keys whose first axis is minibatches; None: steps draw nothing.

    Returns:
        Weights and moments afterwards, and the scalars `(epochs, minibatches, …)`.
    """

    def epoch(now: Any, key_now: PRNGKeyArray) -> tuple[Any, Any]:
        key_order, key_steps = (key_now, key_now) if make_keys is None else jax.random.split(key_now)
        order = jax.random.permutation(key_order, config.part_envs).reshape(config.minibatches, config.minibatch_envs)
        keys = None if make_keys is None else make_keys(key_steps, order.shape)
        return jax.lax.scan(lambda so_far, given: step(so_far, *given), now, (order, keys))

    return jax.lax.scan(epoch, start, jax.random.split(key, config.epochs))
