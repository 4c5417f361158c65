"""One iteration of PPO with memory as one pure function, on a task that becomes harder while it is learnt."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

import subterra_jax as st
from train import devices, learning
from train.recurrent import drive as driving
from train.recurrent.config import RecurrentConfig, check_recurrent
from train.recurrent.drive import make_layout, require_goal
from train.recurrent.network import (
    RecurrentNetworks,
    Weights,
    estimation_loss,
    without_critic,
)
from train.report import Report, report


def nearer(params: Any, progress: Any, until: float) -> Any:
    """Brings goals nearer, to a third of their distance at first; the shift shrinks with the training.

    Args:
        params: The task.
        progress: Share of the training that is done.
        until: Share after which goals are as far away as the task has them.
    """
    share = jnp.clip(progress / max(until, 1e-6), 0.0, 1.0)
    goal = params.goal
    far = (1.0 + 2.0 * share) / 3.0
    high = jnp.maximum(goal.low, goal.high * far * far)
    # A stop is ten steps below 5 cm/s, which no random policy ever does: at first one slow step is enough.
    still_steps = jnp.maximum(1, jnp.floor(goal.still_steps * jnp.minimum(2.0 * share, 1.0))).astype(jnp.int32)
    still_speed = goal.still_speed + 0.15 * (1.0 - jnp.minimum(2.0 * share, 1.0))
    goal = goal.replace(low=goal.low * (0.3 + 0.7 * share), high=high, still_steps=still_steps, still_speed=still_speed)
    return params.replace(goal=goal)


@struct.dataclass
class TrainState:
    """State of a run between two iterations.

    Attributes:
        weights: Of the networks.
        moments: State of the optimiser.
        return_statistics: Spread of the discounted return, by which rewards are divided.
        discounted: Discounted return of each episode so far.
        drive: State of the environments.
        key: Source of all later randomness.
        iteration: Iterations done.
    """

    weights: dict[str, Weights]
    moments: Any
    return_statistics: learning.Statistics
    discounted: Float[Array, "env"]
    drive: driving.Drive
    key: PRNGKeyArray
    iteration: Int[Array, ""]


@struct.dataclass
class Lesson:
    """A rollout with its advantages, its value targets and the memory it began with."""

    hidden: Float[Array, "env hidden"]
    rollout: driving.Rollout
    advantage: Float[Array, "time env"]
    target: Float[Array, "time env"]


class RecurrentLearner(devices.Whole):
    """Training as two pure functions, `init` and `iterate`, for one environment and one config.

    Both may be jitted, and vmapped over seeds.

    Args:
        env: An environment, as `st.make` returns it.
        params: Its parameters.
        config: Settings.
        axes: Names of the axes along which `iterate` is vmapped.
        split: Names of the axes along which environments are split; see `devices.Spread`.
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
        axes: devices.Parts = (),
        split: devices.Parts = (),
        begun: Mapping[str, Any] | None = None,
    ) -> None:
        self.config, self.axes, self.split = check_recurrent(config), axes, split
        require_goal(env)
        self.env = st.batch.AutoReset(env, axes=axes)
        self.networks = RecurrentNetworks(make_layout(env, params, config))
        self.begun = begun or {}
        self.optimizer = learning.clipped_adam(config, final_share=0.1)

    def init(self, key: PRNGKeyArray, params: Any) -> TrainState:
        """Makes an untrained network, and starts an episode in every environment."""
        key_weights, key_reset, key_rest = jax.random.split(key, 3)
        weights, config = (
            {**self.networks.init(key_weights), **jax.tree.map(jnp.asarray, dict(self.begun))},
            self.config,
        )
        return TrainState(
            weights=weights,
            moments=self.optimizer.init(weights),
            return_statistics=learning.start_statistics(()),
            discounted=jnp.zeros(config.part_envs, jnp.float32),
            drive=driving.begin(
                self.env,
                nearer(params, 0.0, self.config.curriculum),
                devices.own_key(key_reset, self.split),
                config.part_envs,
                self.networks.layout,
            ),
            key=key_rest,
            iteration=jnp.int32(0),
        )

    def policy_of(self, state: TrainState) -> dict[str, Weights]:
        """Returns the policy that would drive next."""
        return without_critic(state.weights)

    def iterate(self, state: TrainState, params: Any) -> tuple[TrainState, Report]:
        """Drives one unroll and learns from it."""
        config = self.config
        key, key_drive, key_learn = jax.random.split(state.key, 3)
        task = nearer(params, state.iteration / config.iterations, config.curriculum)
        after, rollout, finished, terms = driving.collect(
            self.env,
            task,
            self.networks,
            state.weights,
            state.drive,
            devices.own_key(key_drive, self.split),
            config.unroll,
        )
        discounted, returns = learning.discounted_returns(
            state.discounted, rollout.reward, finished.done, config.discount
        )
        statistics = learning.update_statistics(state.return_statistics, returns, self.split)
        lesson = self._lesson(state, rollout, after, task, statistics.std)
        warm = (state.iteration >= config.warm_up * config.iterations) if self.begun else True
        (weights, moments), losses = self._learn(state, lesson, jnp.asarray(warm, jnp.float32), key_learn)
        metrics = {
            **jax.tree.map(jnp.mean, losses),
            **devices.mean_over_parts(terms, self.split),
            "reward_scale": statistics.std,
        }
        learnt = TrainState(weights, moments, statistics, discounted, after, key, state.iteration + 1)
        return learnt, report(finished, metrics, self.policy_of(state))

    def _lesson(
        self, before: TrainState, rollout: driving.Rollout, after: driving.Drive, params: Any, scale: Array
    ) -> Lesson:
        """Computes advantages and value targets; an episode cut by the clock goes on with the value it had."""
        value = self.networks.value(before.weights, rollout.truth)
        forward = driving.think(self.env, params, self.networks, before.weights, after)
        truth = driving.truth(self.env.env, params, after.env_state, forward.view, forward.thought.error)
        last = self.networks.value(before.weights, truth)
        advantage = learning.advantages(
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
        def minibatch(now: tuple[Any, Any], chosen: Array, key_now: PRNGKeyArray) -> tuple[Any, dict[str, Array]]:
            part = Lesson(
                lesson.hidden[chosen],
                *jax.tree.map(lambda x: x[:, chosen], (lesson.rollout, lesson.advantage, lesson.target)),
            )
            gradients, losses = devices.mean_over_parts(
                jax.grad(self._loss, has_aux=True)(now[0], part, warm, key_now), self.split
            )
            return learning.descend(self.optimizer, now, gradients), losses

        return learning.run_epochs(minibatch, (state.weights, state.moments), self.config, key)

    def _loss(
        self, weights: dict[str, Weights], lesson: Lesson, warm: Float[Array, ""], key: PRNGKeyArray
    ) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
        """Sums the clipped objective, the value loss and the loss of the estimation head."""
        config, rollout, networks = self.config, lesson.rollout, self.networks
        _, hidden = networks.remember(weights, rollout.features, lesson.hidden, rollout.first)
        thought = networks.think(weights, hidden, rollout.ahead)
        value = networks.value(weights, rollout.truth)
        log_ratio = networks.distribution.log_prob(thought.parameters, rollout.raw_action) - rollout.log_prob
        advantage = devices.normalised(lesson.advantage, self.split)
        clipped = learning.clipped_objective(log_ratio, advantage, config.clip)
        losses = {
            "policy_loss": clipped["policy_loss"],
            "value_loss": jnp.mean(jnp.square(value - lesson.target)),
            "entropy": jnp.mean(networks.distribution.entropy(thought.parameters, key)),
            "estimate_loss": jnp.mean(estimation_loss(thought.logits, rollout.error, config.bin_width)),
            "kl": clipped["kl"],
        }
        total = (
            warm * (losses["policy_loss"] - config.entropy_weight * losses["entropy"])
            + config.value_weight * losses["value_loss"]
            + config.estimate_weight * losses["estimate_loss"]
        )
        return total, losses
