"""Distillation: a student with memory learns to do what a teacher would, wherever the student's own driving leads."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

import subterra_jax as st
from subterra_jax.baselines.agent import Agent
from train import devices, learning
from train.learning import TrainState
from train.recurrent import drive as driving
from train.recurrent import lessons
from train.recurrent.config import DistillConfig, check_distill
from train.recurrent.drive import make_layout, require_goal
from train.recurrent.network import (
    RecurrentNetworks,
    Weights,
    estimation_loss,
    without_critic,
)
from train.report import Report, report

# Beyond this an action counts as wrong by its distance before the tanh, not by the square of it: who does not know
# whether the goal is passed then stops where that is as likely as not, and not where it has become certain.
_KNEE = 0.05
# Advice this near the end of the range is as good as the end, which no number before the tanh can reach. Compared after
# the tanh, a student at full speed would not feel that it ought to stop.
_END = 0.98
_STANDS = 0.05  # m/s


class DistillLearner(devices.Whole):
    """Distillation as two pure functions, `init` and `iterate`, for one environment, teacher and config.

    Args:
        env: An environment, as `st.make` returns it.
        params: Its parameters.
        config: Settings.
        teacher: The teacher.
        axes: Names of the axes along which `iterate` is vmapped.
        split: Names of the axes along which environments are split; see `devices.Spread`.
        begun: Weights of a policy to begin with.

    Raises:
        ConfigError: A setting makes no sense, or no such network can do this task.

    Source: Ross, Gordon, Bagnell, A Reduction of Imitation Learning and Structured Prediction to No-Regret Online
    Learning, 2011 (DAgger), with whole episodes driven by one of the two and a fresh rollout in place of the sum of
    all.
    """

    state_type = TrainState

    def __init__(
        self,
        env: Any,
        params: Any,
        config: DistillConfig,
        teacher: Agent,
        axes: devices.Parts = (),
        split: devices.Parts = (),
        begun: Mapping[str, Any] | None = None,
    ) -> None:
        self.config, self.axes, self.split, self.begun = check_distill(config), axes, split, begun or {}
        require_goal(env)
        self.env, self.teacher = st.batch.AutoReset(env, axes=axes), teacher
        self.networks = RecurrentNetworks(make_layout(env, params, config))
        self.optimizer = learning.clipped_adam(config, final_share=0.02)

    def init(self, key: PRNGKeyArray, params: Any) -> TrainState:
        """Makes an untrained network, and starts an episode in every environment."""
        key_weights, key_reset, key_rest = jax.random.split(key, 3)
        config, given = self.config, jax.tree.map(jnp.asarray, dict(self.begun))
        weights = {**self.networks.init(key_weights), **given}
        key_own, layout = devices.own_key(key_reset, self.split), self.networks.layout
        student = driving.begin(self.env, params, key_own, config.part_envs, layout)
        return TrainState(
            weights=weights,
            moments=self.optimizer.init(weights),
            drive=lessons.begin(self.env.env, self.teacher, params, student),
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
        progress = state.iteration / config.iterations
        taught = 1.0 - jnp.clip(progress / max(config.handover, 1e-6), 0.0, 1.0)
        after, rollout, finished, terms = lessons.collect(
            self.env,
            params,
            self.teacher,
            self.networks,
            state.weights,
            state.drive,
            devices.own_key(key_drive, self.split),
            config.unroll,
            taught,
        )
        (weights, moments), losses = self._learn_from(state, rollout, key_learn)
        metrics = {**jax.tree.map(jnp.mean, losses), **devices.mean_over_parts(terms, self.split)}
        learnt = TrainState(weights, moments, after, key, state.iteration + 1)
        return learnt, report(finished, metrics, self.policy_of(state))

    def _learn_from(
        self, state: TrainState, rollout: lessons.Advised, key: PRNGKeyArray
    ) -> tuple[tuple[dict[str, Weights], Any], dict[str, Array]]:
        begun = state.drive.student.hidden

        def minibatch(now: tuple[Any, Any], chosen: Array, _: None) -> tuple[Any, dict[str, Array]]:
            part = jax.tree.map(lambda x: x[:, chosen], rollout)
            gradients, losses = devices.mean_over_parts(
                jax.grad(self._imitation, has_aux=True)(now[0], begun[chosen], part), self.split
            )
            return learning.descend(self.optimizer, now, gradients), losses

        return learning.run_epochs(minibatch, (state.weights, state.moments), self.config, key, make_keys=None)

    def _imitation(
        self, weights: dict[str, Weights], begun: Float[Array, "env hidden"], rollout: lessons.Advised
    ) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
        """Sums the student's distance from the teacher and the loss of the estimation head."""
        config, networks = self.config, self.networks
        _, hidden = networks.remember(weights, rollout.features, begun, rollout.first)
        thought = networks.think(weights, hidden, rollout.ahead)
        apart = thought.parameters[..., : networks.n_action] - self._before_tanh(rollout.advice)
        losses = {
            "imitation_loss": jnp.mean(optax.huber_loss(apart, delta=_KNEE)) / _KNEE,
            "estimate_loss": jnp.mean(estimation_loss(thought.logits, rollout.error, config.bin_width)),
        }
        total = config.imitation_weight * losses["imitation_loss"] + config.estimate_weight * losses["estimate_loss"]
        return total, losses

    def _before_tanh(self, advice: Float[Array, "*batch action"]) -> Float[Array, "*batch action"]:
        """Returns the number before the tanh that makes such an action, or an equivalent one."""
        layout = self.networks.layout
        low, high = jnp.asarray(layout.action_low), jnp.asarray(layout.action_high)
        # Who is to stand is taught to back up, which the robot reads as standing: the step between driving and standing
        # then lies in the middle of what the network does, not at the end that it comes to last.
        stands = (advice[..., 0] < _STANDS)[..., None] & (jnp.arange(advice.shape[-1]) == 0)
        share = 2.0 * (jnp.where(stands, low, advice) - low) / (high - low) - 1.0
        return jnp.arctanh(jnp.clip(share, -_END, _END))
