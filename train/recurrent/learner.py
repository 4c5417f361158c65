"""One iteration of PPO with memory as one pure function."""

from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

import subterra_jax as st
from train import gae, normalize
from train.recurrent import drive as driving
from train.recurrent.config import RecurrentConfig, check
from train.recurrent.network import RecurrentLayout, RecurrentNetworks, Weights


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


class RecurrentLearner:
    """The two pure functions of training, `init` and `iterate`, for one environment and one config.

    Raises:
        ConfigError: A setting makes no sense.
    """

    def __init__(self, env: Any, params: Any, config: RecurrentConfig) -> None:
        self.config = check(config)
        self.env = st.batch.AutoReset(env)
        self.networks = RecurrentNetworks(make_layout(env, params, config))
        rate = optax.cosine_decay_schedule(
            config.learning_rate, config.iterations * config.epochs * config.minibatches, alpha=0.1
        )
        self.optimizer = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(rate, eps=1e-5))

    def init(self, key: PRNGKeyArray, params: Any) -> TrainState:
        """An untrained network and every environment at the start of an episode."""
        key_weights, key_reset, key_rest = jax.random.split(key, 3)
        weights, config = self.networks.init(key_weights), self.config
        return TrainState(
            weights=weights,
            moments=self.optimizer.init(weights),
            return_statistics=normalize.init(()),
            discounted=jnp.zeros(config.n_envs, jnp.float32),
            drive=driving.begin(self.env, self.nearer(params, 0.0), key_reset, config.n_envs, config.hidden),
            key=key_rest,
            iteration=jnp.int32(0),
        )

    def nearer(self, params: Any, progress: Any) -> Any:
        """The task with goals as far away as is fit after a share of the training: a third of them at first."""
        share = jnp.clip(progress / max(self.config.detour, 1e-6), 0.0, 1.0)
        goal = params.goal
        far = (1.0 + 2.0 * share) / 3.0
        high = jnp.maximum(goal.low, goal.high * far * far)
        # A stop is ten steps below 5 cm/s, which no random policy ever does: at first one slow step is enough.
        still_steps = jnp.maximum(1, jnp.floor(goal.still_steps * jnp.minimum(2.0 * share, 1.0))).astype(jnp.int32)
        still_speed = goal.still_speed + 0.15 * (1.0 - jnp.minimum(2.0 * share, 1.0))
        goal = goal.replace(
            low=goal.low * (0.3 + 0.7 * share), high=high, still_steps=still_steps, still_speed=still_speed
        )
        return params.replace(goal=goal)

    def iterate(self, state: TrainState, params: Any) -> tuple[TrainState, dict[str, Float[Array, ""]]]:
        """Drives one unroll and learns from it."""
        config = self.config
        key, key_drive, key_learn = jax.random.split(state.key, 3)
        task = self.nearer(params, state.iteration / config.iterations)
        after, rollout, sums = driving.collect(
            self.env, task, self.networks, state.weights, state.drive, key_drive, config.unroll
        )
        done = rollout.terminated | rollout.truncated
        discounted, returns = normalize.discounted_returns(state.discounted, rollout.reward, done, config.discount)
        statistics = normalize.update(state.return_statistics, returns)
        lesson = self._lesson(state, rollout, after, task, statistics.std)
        (weights, moments), parts = self._learn(state, lesson, key_learn)
        metrics = {**jax.tree.map(jnp.mean, parts), **sums, "reward_scale": statistics.std}
        return (
            TrainState(weights, moments, statistics, discounted, after, key, state.iteration + 1),
            metrics,
        )

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
        self, state: TrainState, lesson: Lesson, key: PRNGKeyArray
    ) -> tuple[tuple[dict[str, Weights], Any], dict[str, Array]]:
        config = self.config

        def minibatch(now: tuple[Any, Any], chosen_and_key: tuple[Array, PRNGKeyArray]) -> tuple[Any, dict[str, Array]]:
            weights, moments = now
            chosen, key_now = chosen_and_key
            part = Lesson(
                lesson.hidden[chosen],
                *jax.tree.map(lambda x: x[:, chosen], (lesson.rollout, lesson.advantage, lesson.target)),
            )
            gradients, parts = jax.grad(self._loss, has_aux=True)(weights, part, key_now)
            updates, moments = self.optimizer.update(gradients, moments)
            return (optax.apply_updates(weights, updates), moments), parts

        def epoch(now: tuple[Any, Any], key_now: PRNGKeyArray) -> tuple[Any, dict[str, Array]]:
            key_order, key_loss = jax.random.split(key_now)
            order = jax.random.permutation(key_order, config.n_envs).reshape(config.minibatches, -1)
            return jax.lax.scan(minibatch, now, (order, jax.random.split(key_loss, config.minibatches)))

        return jax.lax.scan(epoch, (state.weights, state.moments), jax.random.split(key, config.epochs))

    def _loss(
        self, weights: dict[str, Weights], lesson: Lesson, key: PRNGKeyArray
    ) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
        """Clipped objective, value, and what the estimation heads got wrong."""
        config, rollout, networks = self.config, lesson.rollout, self.networks
        _, hidden = networks.remember(weights, rollout.features, lesson.hidden, rollout.first)
        thought = networks.think(weights, hidden, rollout.ahead)
        value = networks.value(weights, rollout.truth)
        log_ratio = networks.distribution.log_prob(thought.parameters, rollout.raw_action) - rollout.log_prob
        ratio = jnp.exp(log_ratio)
        advantage = (lesson.advantage - jnp.mean(lesson.advantage)) / (jnp.std(lesson.advantage) + 1e-8)
        clipped = jnp.clip(ratio, 1.0 - config.clip, 1.0 + config.clip)
        parts = {
            "policy_loss": -jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage)),
            "value_loss": jnp.mean(jnp.square(value - lesson.target)),
            "entropy": jnp.mean(networks.distribution.entropy(thought.parameters, key)),
            "estimate_loss": jnp.mean(self._missed(thought.logits, rollout.error)),
            "phase_loss": jnp.mean(jnp.square(thought.phase - rollout.phase)),
            "kl": jnp.mean(ratio - 1.0 - log_ratio),
        }
        total = (
            parts["policy_loss"]
            + config.value_weight * parts["value_loss"]
            - config.entropy_weight * parts["entropy"]
            + config.estimate_weight * parts["estimate_loss"]
            + config.phase_weight * parts["phase_loss"]
        )
        return total, parts

    def _missed(self, logits: Float[Array, "*batch bins"], error: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Cross entropy with the truth shared between its two nearest bins."""
        bins, width = self.config.bins, self.config.bin_width
        place = jnp.clip(error / width + 0.5 * (bins - 1), 0.0, bins - 1.001)
        lower = jnp.floor(place).astype(jnp.int32)
        share = (place - lower)[..., None]
        log_share = jax.nn.log_softmax(logits)
        low = jnp.take_along_axis(log_share, lower[..., None], axis=-1)
        high = jnp.take_along_axis(log_share, lower[..., None] + 1, axis=-1)
        return -((1.0 - share) * low + share * high)[..., 0]


_SLACK = 0.25


def make_layout(env: Any, params: Any, config: RecurrentConfig) -> RecurrentLayout:
    """The network that `config` asks for on this environment; nothing is compiled for it."""
    bounds = env.action_space(params)
    observation = jax.ShapeDtypeStruct((1, env.observation_size(params)), jnp.float32)
    batch = st.batch.AutoReset(env)
    shapes = jax.eval_shape(lambda obs: _shapes(env, batch, params, obs), observation)
    return RecurrentLayout(
        n_features=shapes[0].shape[-1],
        n_truth=shapes[1].shape[-1],
        # To stand must not lie at the end of a tanh; the environment reads a speed below 0 as 0.
        action_low=(float(bounds.low[0]) - _SLACK * float(bounds.high[0]), float(bounds.low[1])),
        action_high=tuple(float(bound) for bound in bounds.high[:2]),
        hidden=config.hidden,
        bins=config.bins,
        bin_width=config.bin_width,
        init_std=config.init_std,
        min_std=config.min_std,
    )


def _shapes(env: Any, batch: Any, params: Any, observation: Array) -> tuple[Array, Array]:
    from train.recurrent import senses

    _, state = batch.reset(jax.random.key(0), params, 1)
    view = driving.look(env, params, observation, senses.start((1,)))
    return view.features, driving.truth(env, params, state, view, jnp.zeros(1))
