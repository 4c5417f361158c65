"""One iteration of PPO as one pure function: an unroll, its advantages, and the epochs that learn from it."""

from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

import subterra_jax as st
from subterra_jax.policies import senses
from train import devices, learning
from train.config import PPOConfig, check
from train.devices import Parts
from train.feedforward.networks import Layout, Networks, Policy, Weights
from train.feedforward.rollout import Drive, Rollout, begin, collect, rebuild_stacks
from train.learning import Statistics
from train.report import Report, report

_LOWEST_LEARNING_RATE = 1e-5
_LEARNING_RATE_STEP = 1.2


@struct.dataclass
class Student:
    """Weights, and the state of their optimiser.

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
    """A rollout with its advantages and value targets.

    Attributes:
        first_stack: Frame stack at the first step, from which the others are rebuilt.
        rollout: As stored.
        advantage: Advantage of every action, in units of the reward scale.
        target: For the value function, in the same units.
    """

    first_stack: Float[Array, "env frames obs"]
    rollout: Rollout
    advantage: Float[Array, "time env"]
    target: Float[Array, "time env"]

    def of(self, chosen: Array) -> "Lesson":
        """Returns the lesson of some of the environments."""
        parts = jax.tree.map(lambda x: x[:, chosen], (self.rollout, self.advantage, self.target))
        return Lesson(self.first_stack[chosen], *parts)


def optimizer(config: PPOConfig) -> optax.GradientTransformation:
    """Returns clipped Adam; the learning rate is applied outside, since it changes while learning."""
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_adam(eps=1e-5))


def loss(
    weights: dict[str, Weights],
    networks: Networks,
    statistics: Statistics,
    lesson: Lesson,
    key: PRNGKeyArray,
    config: PPOConfig,
    split: Parts = (),
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Computes the loss of one minibatch and its parts.

    Source: Schulman et al., Proximal Policy Optimization Algorithms, 2017, Eq. 9.
    """
    rollout = lesson.rollout
    stack = rebuild_stacks(lesson.first_stack, rollout.observation, rollout.age)
    parameters = networks.parameters(weights["policy"], statistics, stack)
    value = networks.value(weights["value"], statistics, stack)

    log_ratio = networks.distribution.log_prob(parameters, rollout.raw_action) - rollout.log_prob
    advantage = devices.normalised(lesson.advantage, split)
    losses = {
        **learning.clipped_objective(log_ratio, advantage, config.clip),
        "value_loss": jnp.mean(jnp.square(value - lesson.target)),
        "entropy": jnp.mean(networks.distribution.entropy(parameters, key)),
    }
    total = losses["policy_loss"] + config.value_weight * losses["value_loss"]
    return total - config.entropy_weight * losses["entropy"], losses


def learn(
    student: Student,
    networks: Networks,
    statistics: Statistics,
    lesson: Lesson,
    key: PRNGKeyArray,
    config: PPOConfig,
    split: Parts = (),
) -> tuple[Student, dict[str, Float[Array, ""]]]:
    """Learns from every minibatch of one iteration.

    Returns:
        The student afterwards, and the parts of the loss averaged over all minibatches.
    """
    adam = optimizer(config)

    def minibatch(now: Student, chosen: Array, key_now: PRNGKeyArray) -> tuple[Student, dict[str, Array]]:
        gradients, losses = devices.mean_over_parts(
            jax.grad(loss, has_aux=True)(now.weights, networks, statistics, lesson.of(chosen), key_now, config, split),
            split,
        )
        direction, moments = adam.update(gradients, now.moments)
        weights = optax.apply_updates(now.weights, jax.tree.map(lambda d: -now.learning_rate * d, direction))
        return Student(weights, moments, _adapt_rate(now.learning_rate, losses["kl"], config)), losses

    student, losses = learning.run_epochs(minibatch, student, config, key)
    return student, jax.tree.map(jnp.mean, losses)


def _adapt_rate(learning_rate: Array, kl: Array, config: PPOConfig) -> Array:
    """Lowers the learning rate a little if the policy moved too far; raises it if the policy barely moved."""
    if config.target_kl == 0.0:
        return learning_rate
    factor = jnp.where(kl > 2.0 * config.target_kl, 1.0 / _LEARNING_RATE_STEP, 1.0)
    factor = jnp.where(kl < 0.5 * config.target_kl, _LEARNING_RATE_STEP, factor)
    return jnp.clip(learning_rate * factor, _LOWEST_LEARNING_RATE, config.learning_rate)


@struct.dataclass
class TrainState:
    """State of a run between two iterations.

    Attributes:
        student: Weights, Adam's moments and the learning rate.
        statistics: Normalisation of observations.
        return_statistics: Spread of the discounted return, by which rewards are divided.
        discounted: Discounted return of each episode so far, `(env,)`.
        drive: State of the environments.
        key: Source of all later randomness.
        iteration: Iterations done.
    """

    student: Student
    statistics: learning.Statistics
    return_statistics: learning.Statistics
    discounted: Float[Array, "env"]
    drive: Drive
    key: PRNGKeyArray
    iteration: Int[Array, ""]


class Learner(devices.Whole):
    """Training as two pure functions, `init` and `iterate`, for one environment and one config.

    Both may be jitted, and vmapped over seeds.

    Args:
        env: A navigation environment, as `st.make` returns it.
        params: Its parameters.
        config: Settings.
        axes: Names of the axes along which `iterate` is vmapped.
        split: Names of the axes along which environments are split; see `devices.Spread`.

    Raises:
        ConfigError: A setting makes no sense.
    """

    state_type = TrainState

    def __init__(
        self, env: Any, params: Any, config: PPOConfig, axes: devices.Parts = (), split: devices.Parts = ()
    ) -> None:
        self.config, self.axes, self.split = check(config), axes, split
        self.env = st.batch.AutoReset(env, axes=axes)
        self.networks = Networks(make_layout(env, params, config))

    def init(self, key: PRNGKeyArray, params: Any) -> TrainState:
        """Makes an untrained network, and starts an episode in every environment."""
        key_weights, key_reset, key_rest = jax.random.split(key, 3)
        weights = self.networks.init(key_weights)
        return TrainState(
            student=Student(
                weights=weights,
                moments=optimizer(self.config).init(weights),
                learning_rate=jnp.float32(self.config.learning_rate),
            ),
            statistics=learning.start_statistics((self.networks.layout.n_observation,)),
            return_statistics=learning.start_statistics(()),
            discounted=jnp.zeros(self.config.part_envs, jnp.float32),
            drive=begin(
                self.env, params, devices.own_key(key_reset, self.split), self.config.part_envs, self.config.frames
            ),
            key=key_rest,
            iteration=jnp.int32(0),
        )

    def policy_of(self, state: TrainState) -> Policy:
        """Returns the policy that would drive next."""
        return Policy(state.student.weights["policy"], state.statistics)

    def iterate(self, state: TrainState, params: Any) -> tuple[TrainState, Report]:
        """Drives one unroll and learns from it."""
        config, student = self.config, state.student
        key, key_drive, key_learn = jax.random.split(state.key, 3)
        drive, rollout, finished, terms = collect(
            self.env,
            params,
            self.networks,
            student.weights,
            state.statistics,
            state.drive,
            devices.own_key(key_drive, self.split),
            config.unroll,
            self.axes,
        )
        discounted, returns = learning.discounted_returns(
            state.discounted, rollout.reward, finished.done, config.discount
        )
        return_statistics = learning.update_statistics(state.return_statistics, returns, self.split)
        lesson = self._lesson(state, rollout, drive, return_statistics.std)
        learnt, losses = learn(student, self.networks, state.statistics, lesson, key_learn, config, self.split)
        # The first iteration only fills the statistics: what it saw was not yet normalised.
        learnt = jax.tree.map(lambda new, old: jnp.where(state.iteration == 0, old, new), learnt, student)

        metrics = {
            **losses,
            **devices.mean_over_parts(terms, self.split),
            "learning_rate": learnt.learning_rate,
            "reward_scale": return_statistics.std,
            "explained_variance": devices.mean_over_parts(
                1.0 - jnp.var(lesson.advantage) / (jnp.var(lesson.target) + 1e-8), self.split
            ),
        }
        after = TrainState(
            student=learnt,
            # Refreshed after learning, so that the probabilities compared while learning share one normalisation.
            statistics=learning.update_statistics(state.statistics, rollout.observation, self.split),
            return_statistics=return_statistics,
            discounted=discounted,
            drive=drive,
            key=key,
            iteration=state.iteration + 1,
        )
        return after, report(finished, metrics, self.policy_of(state))

    def _lesson(self, before: TrainState, rollout: Rollout, after: Drive, scale: Float[Array, ""]) -> Lesson:
        """Computes advantages and value targets of an unroll that led from `before` to `after`."""
        value_weights, first_stack = before.student.weights["value"], before.drive.stack
        stack = rebuild_stacks(first_stack, rollout.observation, rollout.age)
        value = self.networks.value(value_weights, before.statistics, stack)
        advantage = learning.advantages(
            rollout.reward / scale,
            value,
            self.networks.value(value_weights, before.statistics, after.stack),
            rollout.final_value,
            rollout.terminated,
            rollout.truncated,
            self.config.discount,
            self.config.gae_lambda,
        )
        return Lesson(first_stack, rollout, advantage, advantage + value)


def make_layout(env: Any, params: Any, config: PPOConfig) -> Layout:
    """Returns the layout that `config` asks for on this environment; compiles nothing."""
    bounds = env.action_space(params)
    images = env.images(params) if hasattr(env, "images") else {}  # robots on legs and steering alone have none
    image = images.get("scan")
    patched = image is not None and not any(n % senses.PATCH for n in image)
    return Layout(
        n_observation=env.observation_size(params),
        action_low=tuple(float(bound) for bound in bounds.low),
        action_high=tuple(float(bound) for bound in bounds.high),
        frames=config.frames,
        hidden=tuple(config.hidden),
        init_std=config.init_std,
        min_std=config.min_std,
        image=image if patched else None,
        image_at=env.fields(params)["scan"].start if patched else 0,
    )
