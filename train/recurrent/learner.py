"""One iteration of PPO with memory as one pure function."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

import subterra_jax as st
from train import gae
from train.devices import parts
from train.feedforward import normalize
from train.recurrent import curriculum
from train.recurrent import drive as driving
from train.recurrent.config import RecurrentConfig, check
from train.recurrent.estimation import missed
from train.recurrent.layout import make_layout, require_goal
from train.recurrent.network import RecurrentNetworks, Weights, without_critic
from train.run.report import Report, report


@struct.dataclass
class TrainState:
    """Everything that one iteration hands to the next.

    Attributes:
        weights: Of the networks.
        moments: State of the optimiser.
        return_statistics: Spread of the discounted return, by which rewards are divided.
        discounted: Discounted return of each episode so far.
        drive: Where the environments are.
        key: For everything random from here on.
        iteration: Iterations done.
    """

    weights: dict[str, Weights]
    moments: Any
    return_statistics: normalize.Statistics
    discounted: Float[Array, "env"]
    drive: driving.Drive
    key: PRNGKeyArray
    iteration: Int[Array, ""]


@struct.dataclass
class Lesson:
    """A rollout with what is to be learnt from it."""

    hidden: Float[Array, "env hidden"]
    rollout: driving.Rollout
    advantage: Float[Array, "time env"]
    target: Float[Array, "time env"]


class RecurrentLearner(parts.Whole):
    """The two pure functions of training, `init` and `iterate`, for one environment and one config.

    Both may be jitted, and vmapped over seeds.

    Args:
        env: An environment, as `st.make` returns it.
        params: Its parameters.
        config: Settings.
        axes: Names of the axes along which `iterate` is vmapped.
        split: Names of the axes along which environments are split; see `spread.py`.
        begun: Weights of a policy to begin with.

    Raises:
        ConfigError: A setting makes no sense, or the task has no goal to drive to and stop at.
    """

    state_type = TrainState

    def __init__(
        self,
        env: Any,
        params: Any,
        config: RecurrentConfig,
        axes: parts.Parts = (),
        split: parts.Parts = (),
        begun: Mapping[str, Any] | None = None,
    ) -> None:
        self.config, self.axes, self.split = check(config), axes, split
        require_goal(env)
        self.env = st.batch.AutoReset(env, axes=axes)
        self.networks = RecurrentNetworks(make_layout(env, params, config))
        self.begun = begun or {}
        rate = optax.cosine_decay_schedule(
            config.learning_rate, config.iterations * config.epochs * config.minibatches, alpha=0.1
        )
        self.optimizer = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(rate, eps=1e-5))

    def init(self, key: PRNGKeyArray, params: Any) -> TrainState:
        """An untrained network and every environment at the start of an episode."""
        key_weights, key_reset, key_rest = jax.random.split(key, 3)
        weights, config = (
            {**self.networks.init(key_weights), **jax.tree.map(jnp.asarray, dict(self.begun))},
            self.config,
        )
        return TrainState(
            weights=weights,
            moments=self.optimizer.init(weights),
            return_statistics=normalize.init(()),
            discounted=jnp.zeros(config.part_envs, jnp.float32),
            drive=driving.begin(
                self.env,
                curriculum.nearer(params, 0.0, self.config.curriculum),
                parts.own_key(key_reset, self.split),
                config.part_envs,
                self.networks.layout,
            ),
            key=key_rest,
            iteration=jnp.int32(0),
        )

    def policy_of(self, state: TrainState) -> dict[str, Weights]:
        """The policy that would drive next."""
        return without_critic(state.weights)

    def iterate(self, state: TrainState, params: Any) -> tuple[TrainState, Report]:
        """Drives one unroll and learns from it."""
        config = self.config
        key, key_drive, key_learn = jax.random.split(state.key, 3)
        task = curriculum.nearer(params, state.iteration / config.iterations, config.curriculum)
        after, rollout, finished, terms = driving.collect(
            self.env,
            task,
            self.networks,
            state.weights,
            state.drive,
            parts.own_key(key_drive, self.split),
            config.unroll,
        )
        discounted, returns = normalize.discounted_returns(
            state.discounted, rollout.reward, finished.done, config.discount
        )
        statistics = normalize.update(state.return_statistics, returns, self.split)
        lesson = self._lesson(state, rollout, after, task, statistics.std)
        warm = (state.iteration >= config.warm_up * config.iterations) if self.begun else True
        (weights, moments), losses = self._learn(state, lesson, jnp.asarray(warm, jnp.float32), key_learn)
        metrics = {**jax.tree.map(jnp.mean, losses), **parts.mean(terms, self.split), "reward_scale": statistics.std}
        learnt = TrainState(weights, moments, statistics, discounted, after, key, state.iteration + 1)
        return learnt, report(finished, metrics, self.policy_of(state))

    def _lesson(
        self, before: TrainState, rollout: driving.Rollout, after: driving.Drive, params: Any, scale: Array
    ) -> Lesson:
        """Advantages and value targets; an episode cut by the clock goes on with the value it had."""
        value = self.networks.value(before.weights, rollout.truth)
        view = driving.look(self.env.env, params, after.observation, after.reckoning)
        hidden, _ = self.networks.remember(before.weights, view.features[None], after.hidden, after.first[None])
        thought = self.networks.think(before.weights, hidden, view.ahead)
        last = self.networks.value(
            before.weights, driving.truth(self.env.env, params, after.env_state, view, thought.error)
        )
        advantage = gae.advantages(
            rollout.reward / scale,
            value,
            last,
            value,
            rollout.terminated,
            rollout.truncated,
            self.config.discount,
            self.config.gae_lambda,
        )
        return Lesson(before.drive.hidden, rollout, advantage, advantage + value)

    def _learn(
        self, state: TrainState, lesson: Lesson, warm: Float[Array, ""], key: PRNGKeyArray
    ) -> tuple[tuple[dict[str, Weights], Any], dict[str, Array]]:
        config = self.config

        def minibatch(now: tuple[Any, Any], chosen_and_key: tuple[Array, PRNGKeyArray]) -> tuple[Any, dict[str, Array]]:
            weights, moments = now
            chosen, key_now = chosen_and_key
            part = Lesson(
                lesson.hidden[chosen],
                *jax.tree.map(lambda x: x[:, chosen], (lesson.rollout, lesson.advantage, lesson.target)),
            )
            gradients, losses = parts.mean(jax.grad(self._loss, has_aux=True)(weights, part, warm, key_now), self.split)
            updates, moments = self.optimizer.update(gradients, moments)
            return (optax.apply_updates(weights, updates), moments), losses

        def epoch(now: tuple[Any, Any], key_now: PRNGKeyArray) -> tuple[Any, dict[str, Array]]:
            key_order, key_loss = jax.random.split(key_now)
            order = jax.random.permutation(key_order, config.part_envs).reshape(config.minibatches, -1)
            return jax.lax.scan(minibatch, now, (order, jax.random.split(key_loss, config.minibatches)))

        return jax.lax.scan(epoch, (state.weights, state.moments), jax.random.split(key, config.epochs))

    def _loss(
        self, weights: dict[str, Weights], lesson: Lesson, warm: Float[Array, ""], key: PRNGKeyArray
    ) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
        """Clipped objective, value, and what the estimation heads got wrong."""
        config, rollout, networks = self.config, lesson.rollout, self.networks
        _, hidden = networks.remember(weights, rollout.features, lesson.hidden, rollout.first)
        thought = networks.think(weights, hidden, rollout.ahead)
        value = networks.value(weights, rollout.truth)
        log_ratio = networks.distribution.log_prob(thought.parameters, rollout.raw_action) - rollout.log_prob
        ratio = jnp.exp(log_ratio)
        advantage = parts.normalised(lesson.advantage, self.split)
        clipped = jnp.clip(ratio, 1.0 - config.clip, 1.0 + config.clip)
        losses = {
            "policy_loss": -jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage)),
            "value_loss": jnp.mean(jnp.square(value - lesson.target)),
            "entropy": jnp.mean(networks.distribution.entropy(thought.parameters, key)),
            "estimate_loss": jnp.mean(missed(thought.logits, rollout.error, config.bin_width)),
            "kl": jnp.mean(ratio - 1.0 - log_ratio),
        }
        total = (
            warm * (losses["policy_loss"] - config.entropy_weight * losses["entropy"])
            + config.value_weight * losses["value_loss"]
            + config.estimate_weight * losses["estimate_loss"]
        )
        return total, losses
