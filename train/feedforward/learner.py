"""One iteration of PPO as one pure function: an unroll, its advantages, and the epochs that learn from it."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

import subterra_jax as st
from train import gae
from train.config import PPOConfig, check
from train.devices import parts
from train.feedforward import frames, normalize, update
from train.feedforward.networks import Layout, Networks, Policy
from train.feedforward.rollout import Drive, Rollout, begin, collect
from train.run.report import Report, report


@struct.dataclass
class TrainState:
    """Everything that one iteration hands to the next.

    Attributes:
        student: Weights, Adam's moments and the learning rate.
        statistics: Normalisation of observations.
        return_statistics: Spread of the discounted return, by which rewards are divided.
        discounted: Discounted return of each episode so far, `(env,)`.
        drive: Where the environments are.
        key: For everything random from here on.
        iteration: Iterations done.
    """

    student: update.Student
    statistics: normalize.Statistics
    return_statistics: normalize.Statistics
    discounted: Float[Array, "env"]
    drive: Drive
    key: PRNGKeyArray
    iteration: Int[Array, ""]


class Learner(parts.Whole):
    """The two pure functions of training, `init` and `iterate`, for one environment and one config.

    Both may be jitted, and vmapped over seeds.

    Args:
        env: A navigation environment, as `st.make` returns it.
        params: Its parameters.
        config: Settings.
        axes: Names of the axes along which `iterate` is vmapped.
        split: Names of the axes along which environments are split; see `spread.py`.

    Raises:
        ConfigError: A setting makes no sense.
    """

    state_type = TrainState

    def __init__(
        self, env: Any, params: Any, config: PPOConfig, axes: parts.Parts = (), split: parts.Parts = ()
    ) -> None:
        self.config, self.axes, self.split = check(config), axes, split
        self.env = st.batch.AutoReset(env, axes=axes)
        self.networks = Networks(make_layout(env, params, config))

    def init(self, key: PRNGKeyArray, params: Any) -> TrainState:
        """An untrained network and every environment at the start of an episode."""
        key_weights, key_reset, key_rest = jax.random.split(key, 3)
        weights = self.networks.init(key_weights)
        return TrainState(
            student=update.Student(
                weights=weights,
                moments=update.optimizer(self.config).init(weights),
                learning_rate=jnp.float32(self.config.learning_rate),
            ),
            statistics=normalize.init((self.networks.layout.n_observation,)),
            return_statistics=normalize.init(()),
            discounted=jnp.zeros(self.config.part_envs, jnp.float32),
            drive=begin(
                self.env, params, parts.own_key(key_reset, self.split), self.config.part_envs, self.config.frames
            ),
            key=key_rest,
            iteration=jnp.int32(0),
        )

    def policy_of(self, state: TrainState) -> Policy:
        """The policy that would drive next."""
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
            parts.own_key(key_drive, self.split),
            config.unroll,
            self.axes,
        )
        discounted, returns = normalize.discounted_returns(
            state.discounted, rollout.reward, finished.done, config.discount
        )
        return_statistics = normalize.update(state.return_statistics, returns, self.split)
        lesson = self._lesson(state, rollout, drive, return_statistics.std)
        learnt, losses = update.learn(student, self.networks, state.statistics, lesson, key_learn, config, self.split)
        # The first iteration only fills the statistics: what it saw was not yet normalised.
        learnt = jax.tree.map(lambda new, old: jnp.where(state.iteration == 0, old, new), learnt, student)

        metrics = {
            **losses,
            **parts.mean(terms, self.split),
            "learning_rate": learnt.learning_rate,
            "reward_scale": return_statistics.std,
            "explained_variance": parts.mean(
                1.0 - jnp.var(lesson.advantage) / (jnp.var(lesson.target) + 1e-8), self.split
            ),
        }
        after = TrainState(
            student=learnt,
            # Refreshed after learning, so that the probabilities compared while learning share one normalisation.
            statistics=normalize.update(state.statistics, rollout.observation, self.split),
            return_statistics=return_statistics,
            discounted=discounted,
            drive=drive,
            key=key,
            iteration=state.iteration + 1,
        )
        return after, report(finished, metrics, self.policy_of(state))

    def _lesson(self, before: TrainState, rollout: Rollout, after: Drive, scale: Float[Array, ""]) -> update.Lesson:
        """Advantages and value targets of an unroll that led from `before` to `after`."""
        value_weights, first_stack = before.student.weights["value"], before.drive.stack
        stack = frames.rebuild(first_stack, rollout.observation, rollout.age)
        value = self.networks.value(value_weights, before.statistics, stack)
        advantage = gae.advantages(
            rollout.reward / scale,
            value,
            self.networks.value(value_weights, before.statistics, after.stack),
            rollout.final_value,
            rollout.terminated,
            rollout.truncated,
            self.config.discount,
            self.config.gae_lambda,
        )
        return update.Lesson(first_stack, rollout, advantage, advantage + value)


def make_layout(env: Any, params: Any, config: PPOConfig) -> Layout:
    """The network that `config` asks for on this environment; nothing is compiled for it."""
    bounds = env.action_space(params)
    return Layout(
        n_observation=env.observation_size(params),
        action_low=tuple(float(bound) for bound in bounds.low),
        action_high=tuple(float(bound) for bound in bounds.high),
        frames=config.frames,
        hidden=tuple(config.hidden),
        init_std=config.init_std,
        min_std=config.min_std,
    )
