"""The clipped objective of PPO and its epochs of minibatches."""

from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from train.config import PPOConfig
from train.devices import parts
from train.feedforward import frames, normalize
from train.feedforward.networks import Networks, Weights
from train.feedforward.rollout import Rollout

_LOWEST_LEARNING_RATE = 1e-5
_LEARNING_RATE_STEP = 1.2


@struct.dataclass
class Student:
    """What gradient steps change.

    Attributes:
        weights: Under `policy` and `value`.
        moments: State of Adam.
        learning_rate: Follows the divergence between updates.
    """

    weights: dict[str, Weights]
    moments: Any
    learning_rate: Float[Array, ""]


@struct.dataclass
class Lesson:
    """A rollout with what is to be learnt from it.

    Attributes:
        first_stack: Frame stack at the first step, from which the others are rebuilt.
        rollout: As stored.
        advantage: Of every action, in units of the reward scale.
        target: For the value function, in the same units.
    """

    first_stack: Float[Array, "env frames obs"]
    rollout: Rollout
    advantage: Float[Array, "time env"]
    target: Float[Array, "time env"]

    def of(self, chosen: Array) -> "Lesson":
        """The same for some of the environments."""
        parts = jax.tree.map(lambda x: x[:, chosen], (self.rollout, self.advantage, self.target))
        return Lesson(self.first_stack[chosen], *parts)


def optimizer(config: PPOConfig) -> optax.GradientTransformation:
    """Clipped Adam; the learning rate is applied outside, since it changes while learning."""
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_adam(eps=1e-5))


def loss(
    weights: dict[str, Weights],
    networks: Networks,
    statistics: normalize.Statistics,
    lesson: Lesson,
    key: PRNGKeyArray,
    config: PPOConfig,
    split: parts.Parts = (),
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Loss of one minibatch and its parts.

    Source: Schulman et al., Proximal Policy Optimization Algorithms, 2017, Eq. 7 and 9.
    """
    rollout = lesson.rollout
    stack = frames.rebuild(lesson.first_stack, rollout.observation, rollout.age)
    parameters = networks.parameters(weights["policy"], statistics, stack)
    value = networks.value(weights["value"], statistics, stack)

    log_ratio = networks.distribution.log_prob(parameters, rollout.raw_action) - rollout.log_prob
    ratio = jnp.exp(log_ratio)
    advantage = parts.normalised(lesson.advantage, split)
    clipped = jnp.clip(ratio, 1.0 - config.clip, 1.0 + config.clip)
    policy_loss = -jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage))
    value_loss = jnp.mean(jnp.square(value - lesson.target))
    entropy = jnp.mean(networks.distribution.entropy(parameters, key))
    losses = {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "entropy": entropy,
        # Never negative, and of lower variance than the mean of -log_ratio: http://joschu.net/blog/kl-approx.html
        "kl": jnp.mean(ratio - 1.0 - log_ratio),
        "clipped": jnp.mean(jnp.abs(ratio - 1.0) > config.clip),
    }
    return policy_loss + config.value_weight * value_loss - config.entropy_weight * entropy, losses


def learn(
    student: Student,
    networks: Networks,
    statistics: normalize.Statistics,
    lesson: Lesson,
    key: PRNGKeyArray,
    config: PPOConfig,
    split: parts.Parts = (),
) -> tuple[Student, dict[str, Float[Array, ""]]]:
    """Every epoch and minibatch of one iteration.

    Returns:
        The student afterwards, and the parts of the loss averaged over all minibatches.
    """
    adam = optimizer(config)

    def minibatch(now: Student, chosen_and_key: tuple[Array, PRNGKeyArray]) -> tuple[Student, dict[str, Array]]:
        chosen, key_now = chosen_and_key
        gradients, losses = parts.mean(
            jax.grad(loss, has_aux=True)(now.weights, networks, statistics, lesson.of(chosen), key_now, config, split),
            split,
        )
        direction, moments = adam.update(gradients, now.moments)
        weights = optax.apply_updates(now.weights, jax.tree.map(lambda d: -now.learning_rate * d, direction))
        return Student(weights, moments, _follow(now.learning_rate, losses["kl"], config)), losses

    def epoch(now: Student, key_now: PRNGKeyArray) -> tuple[Student, dict[str, Array]]:
        key_order, key_loss = jax.random.split(key_now)
        order = jax.random.permutation(key_order, config.part_envs).reshape(config.minibatches, config.minibatch_envs)
        return jax.lax.scan(minibatch, now, (order, jax.random.split(key_loss, config.minibatches)))

    student, losses = jax.lax.scan(epoch, student, jax.random.split(key, config.epochs))
    return student, jax.tree.map(jnp.mean, losses)


def _follow(learning_rate: Array, kl: Array, config: PPOConfig) -> Array:
    """The learning rate a little lower where the policy moved too far, higher again where it barely moved."""
    if config.target_kl == 0.0:
        return learning_rate
    factor = jnp.where(kl > 2.0 * config.target_kl, 1.0 / _LEARNING_RATE_STEP, 1.0)
    factor = jnp.where(kl < 0.5 * config.target_kl, _LEARNING_RATE_STEP, factor)
    return jnp.clip(learning_rate * factor, _LOWEST_LEARNING_RATE, config.learning_rate)
