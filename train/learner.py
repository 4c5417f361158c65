"""One iteration of PPO as one pure function: an unroll, its advantages, and the epochs that learn from it."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

from train import devices, learning
from train.config import TrainConfig
from train.devices import Parts
from train.driver import Driver, Policy
from train.report import Report, report
from train.rollout import Drive, Rollout, begin, collect

_LOWEST_LEARNING_RATE = 1e-5
_LEARNING_RATE_STEP = 1.2


@struct.dataclass
class Student:
    """Weights, and the state of their optimiser."""

    weights: Any  # Of the network
    moments: Any  # state of Adam
    learning_rate: Float[Array, ""]  # follows the divergence between updates


@struct.dataclass
class Batch:
    """Experience to learn from: a rollout of some environments with advantages and value targets."""

    memory: Float[Array, "env cell"]  # memory of the network at the first step
    rollout: Rollout  # as stored
    advantage: Float[Array, "time env"]  # advantage of every action, in units of the reward scale
    target: Float[Array, "time env"]  # for the value function, in the same units

    def block(self, number: Array, width: int) -> "Batch":
        """Returns a block of `width` environments."""
        rest = learning.take_envs((self.rollout, self.advantage, self.target), number, width, 1)
        return Batch(learning.take_envs(self.memory, number, width, 0), *rest)


@struct.dataclass
class TrainState:
    """State of a run between two iterations."""

    student: Student  # weights, Adam's moments and the learning rate
    localiser: Any  # weights of the localiser and its optimiser's moments; None without one
    statistics: Any  # Of the observation, where it is normalised; else None
    return_statistics: learning.Statistics  # spread of the discounted return, by which rewards are divided
    discounted: Float[Array, "env"]  # discounted return of each episode so far, `(env,)`
    drive: Drive  # state of the environments
    key: PRNGKeyArray  # source of all later randomness
    iteration: Int[Array, ""]  # iterations done


class Learner(devices.Whole):
    """Training as two pure functions, `init` and `iterate`, for one environment and one config.

    Both may be jitted, and vmapped over seeds.

    Args:
        env: An environment, as `st.make` returns it.
        driver: What drives in it.
        config: Settings.
        split: Names of the axes along which environments are split; see `devices.Spread`.
        given: Weights to begin with; those that are None begin untrained.
        localiser: Learns the localiser of `--memory along`; None leaves it as it is given.
    """

    state_type = TrainState

    def __init__(
        self,
        env: Any,
        driver: Driver,
        config: TrainConfig,
        split: Parts = (),
        given: Policy | None = None,
        localiser: Any = None,
    ) -> None:
        self.config, self.split = config, split
        self.env, self.driver = env, driver
        self.given = Policy(None) if given is None else given
        self._localiser = localiser
        self._adam = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_adam(eps=1e-5))

    def init(self, key: PRNGKeyArray, params: Any) -> TrainState:
        """Makes an untrained network, and starts an episode in every environment."""
        key_weights, key_reset, key_rest, key_localiser = jax.random.split(key, 4)
        given = self.given
        weights = self.driver.init(key_weights) if given.network is None else _arrays(given.network)
        localiser = _arrays(given.localiser)
        if self._localiser is not None:
            localiser = self._localiser.init(key_localiser, localiser)
        statistics = self.driver.start_statistics()
        policy = Policy(weights, self._weights_of(localiser), _moments_of(statistics))
        student = Student(weights, self._adam.init(weights), jnp.float32(self.config.learning_rate))
        key_reset = devices.own_key(key_reset, self.split)
        return TrainState(
            student=student,
            localiser=localiser,
            statistics=statistics,
            return_statistics=learning.start_statistics(()),
            discounted=jnp.zeros(self.config.part_envs, jnp.float32),
            drive=begin(self.env, self.driver, policy, params, key_reset, self.config.part_envs),
            key=key_rest,
            iteration=jnp.int32(0),
        )

    def policy_of(self, state: TrainState) -> Policy:
        """Returns the policy that would drive next."""
        return Policy(state.student.weights, self._weights_of(state.localiser), _moments_of(state.statistics))

    def _weights_of(self, localiser: Any) -> Any:
        return localiser if self._localiser is None else localiser.weights

    def iterate(self, state: TrainState, params: Any) -> tuple[TrainState, Report]:
        """Drives one unroll and learns from it."""
        config, student = self.config, state.student
        key, key_drive, key_learn, key_localiser = jax.random.split(state.key, 4)
        policy = self.policy_of(state)
        own = devices.own_key(key_drive, self.split)
        drive, rollout, finished, terms = collect(
            self.env, self.driver, policy, params, state.drive, own, config.unroll
        )
        discounted, returns = learning.discounted_returns(
            state.discounted, rollout.reward, finished.done, config.discount
        )
        return_statistics = learning.update_statistics(state.return_statistics, returns, self.split)
        batch = self._batch(policy, state.drive, rollout, drive, return_statistics.std)
        learnt, losses = self._learn(student, batch, key_learn, state.iteration)
        localiser = state.localiser
        if self._localiser is not None:
            localiser, further = self._localiser.learn(localiser, policy, params, key_localiser, state.iteration)
            losses |= further
        statistics = state.statistics
        if statistics is not None:
            # Refreshed after learning, so that the probabilities compared while learning share one normalisation; the
            # first iteration only fills them: what it saw was not yet normalised.
            learnt = jax.tree.map(lambda new, old: jnp.where(state.iteration == 0, old, new), learnt, student)
            statistics = learning.update_statistics(statistics, self.driver.raw(rollout.inputs, policy), self.split)
        metrics = {
            **losses,
            **devices.mean_over_parts(terms, self.split),
            "learning_rate": learnt.learning_rate,
            "reward_mean": devices.mean_over_parts(jnp.mean(rollout.reward), self.split),
            "reward_scale": return_statistics.std,
            "explained_variance": devices.mean_over_parts(
                1.0 - jnp.var(batch.advantage) / (jnp.var(batch.target) + 1e-8), self.split
            ),
        }
        after = TrainState(
            student=learnt,
            localiser=localiser,
            statistics=statistics,
            return_statistics=return_statistics,
            discounted=discounted,
            drive=drive,
            key=key,
            iteration=state.iteration + 1,
        )
        return after, report(finished, metrics, policy)

    def _batch(self, policy: Policy, before: Drive, rollout: Rollout, after: Drive, scale: Array) -> Batch:
        """Computes advantages and value targets of an unroll that led from `before` to `after`."""
        last, _ = self.driver.answer(policy, self.driver.inputs(policy, after.kept), after.memory)
        advantage = learning.advantages(
            rollout.reward / scale,
            rollout.value,
            last.value,
            rollout.final_value,
            rollout.terminated,
            rollout.truncated,
            self.config.discount,
            self.config.gae_lambda,
        )
        return Batch(before.memory, rollout, advantage, advantage + rollout.value)

    def _learn(
        self, student: Student, batch: Batch, key: PRNGKeyArray, iteration: Array
    ) -> tuple[Student, dict[str, Array]]:
        """Learns from every minibatch of one iteration.

        A minibatch is a block of environments, which are alike, so that it is read where it lies; each epoch goes
        through the blocks in another order.
        """
        config = self.config
        left = 1.0 - (1.0 - config.last_rate) * iteration / config.iterations

        def minibatch(now: Student, number: Array) -> tuple[Student, dict[str, Array]]:
            block = batch.block(number, config.minibatch_envs)
            gradients, losses = devices.mean_over_parts(
                jax.grad(self._loss, has_aux=True)(now.weights, block), self.split
            )
            direction, moments = self._adam.update(gradients, now.moments)
            weights = optax.apply_updates(now.weights, jax.tree.map(lambda d: -left * now.learning_rate * d, direction))
            return Student(weights, moments, self._adapt_rate(now.learning_rate, losses["kl"])), losses

        keys = jax.random.split(key, config.epochs)
        order = jax.vmap(lambda key: jax.random.permutation(key, config.minibatches))(keys)
        student, losses = jax.lax.scan(minibatch, student, order.reshape(-1))
        return self._narrowed(student, iteration), jax.tree.map(jnp.mean, losses)

    def _narrowed(self, student: Student, iteration: Array) -> Student:
        """Returns the weights with standard deviations within their limit."""
        last = self.config.last_std
        if last is None:
            return student
        spread = self.driver.layout.shape.spread
        done = (iteration + 1) / self.config.iterations
        limit = np.log(spread) + done * np.log(np.minimum(last / spread, 1.0))
        log_std = jnp.minimum(student.weights["log_std"], limit)
        return dataclasses.replace(student, weights={**student.weights, "log_std": log_std})

    def _loss(self, weights: Any, batch: Batch) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
        """Computes the loss of one minibatch and its parts.

        Source: Schulman et al., Proximal Policy Optimization Algorithms, 2017, Eq. 9.
        """
        config, rollout = self.config, batch.rollout
        out = self.driver.unroll(weights, rollout.inputs, batch.memory, rollout.first)
        log_ratio = self.driver.log_prob(out, rollout.raw) - rollout.log_prob
        advantage = devices.normalised(batch.advantage, self.split)
        losses = {
            **learning.clipped_objective(log_ratio, advantage, config.clip),
            "value_loss": jnp.mean(jnp.square(out.value - batch.target)),
            "entropy": self.driver.entropy(out),
        }
        total = losses["policy_loss"] + config.value_weight * losses["value_loss"]
        total -= config.entropy_weight * losses["entropy"]
        if rollout.error.shape[-1]:
            losses["auxiliary_loss"] = learning.auxiliary_loss(out.error, rollout.error)
            total += config.auxiliary_weight * losses["auxiliary_loss"]
        return total, losses

    def _adapt_rate(self, learning_rate: Array, kl: Array) -> Array:
        """Lowers the learning rate a little if the policy moved too far; raises it if the policy barely moved."""
        config = self.config
        if config.target_kl == 0.0:
            return learning_rate
        factor = jnp.where(kl > 2.0 * config.target_kl, 1.0 / _LEARNING_RATE_STEP, 1.0)
        factor = jnp.where(kl < 0.5 * config.target_kl, _LEARNING_RATE_STEP, factor)
        return jnp.clip(learning_rate * factor, _LOWEST_LEARNING_RATE, config.learning_rate)


def _moments_of(statistics: Any) -> Any:
    return None if statistics is None else {"mean": statistics.mean, "std": statistics.std}


def _arrays(tree: Any) -> Any:
    return jax.tree.map(jnp.asarray, tree)
