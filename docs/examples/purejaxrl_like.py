"""PPO in the manner of purejaxrl: one jitted function of a whole update over Gymnax's five values.

An end at the horizon is bootstrapped from the observation of the episode's own last state.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from flax.training.train_state import TrainState
from watch import Act, Watch, features

from subterra_jax.adapters.gymnax import SubterraGymnax5

N_ENVS, N_STEPS, N_EPOCHS, N_MINIBATCHES = 128, 64, 4, 8
LEARNING_RATE, DISCOUNT, GAE_LAMBDA, CLIP, ENTROPY = 1e-3, 0.997, 0.95, 0.2, 1e-3
REWARD_SCALE = 0.1  # returns are of order 10 to 100


class ActorCritic(nn.Module):
    """Mean, log of the standard deviation and value from the features of one observation."""

    n_actions: int

    @nn.compact
    def __call__(self, seen: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Returns mean and log of the standard deviation in units of half the range, and the value."""
        towers = []
        for n, gain in ((self.n_actions, 0.01), (1, 1.0)):
            hidden = seen
            for _ in range(2):
                hidden = nn.tanh(nn.Dense(64, kernel_init=nn.initializers.orthogonal(2.0**0.5))(hidden))
            towers.append(nn.Dense(n, kernel_init=nn.initializers.orthogonal(gain))(hidden))
        log_std = self.param("log_std", nn.initializers.constant(-0.5), (self.n_actions,))
        return towers[0], log_std, towers[1][..., 0]


class Transition(NamedTuple):
    """One step of every environment; `value_after` belongs to the step's own next state."""

    obs: jax.Array
    action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    value_after: jax.Array
    reward: jax.Array
    done: jax.Array
    discount: jax.Array


def log_prob(mean: jax.Array, log_std: jax.Array, action: jax.Array) -> jax.Array:
    """Returns the log density of a diagonal normal distribution."""
    z = (action - mean) / jnp.exp(log_std)
    return jnp.sum(-0.5 * z**2 - log_std - 0.5 * jnp.log(2.0 * jnp.pi), axis=-1)


def train(watch: Watch, steps: int, seed: int) -> None:
    """Trains until the watch says enough."""
    env = SubterraGymnax5(watch.task, **watch.options)
    params = env.default_params
    low, high = env.action_space(params).low, env.action_space(params).high
    look = features(env.env, params)
    network: Any = ActorCritic(env.num_actions)

    def command(action: jax.Array) -> jax.Array:
        return low + 0.5 * (jnp.clip(action, -1.0, 1.0) + 1.0) * (high - low)

    def act(weights: Any, obs: jax.Array) -> jax.Array:
        return command(network.apply(weights, look(obs))[0])

    def step(carry: Any, key: jax.Array) -> tuple[Any, Transition]:
        learner, obs, state = carry
        action_key, step_key = jax.random.split(key)
        mean, log_std, value = network.apply(learner.params, obs)
        action = mean + jnp.exp(log_std) * jax.random.normal(action_key, mean.shape)
        following, state, reward, done, info = jax.vmap(env.step, (0, 0, 0, None))(
            jax.random.split(step_key, N_ENVS), state, command(action), params
        )
        following, final = jax.vmap(look)(following), jax.vmap(look)(info["final_observation"])
        after = network.apply(learner.params, final)[2]
        taken = log_prob(mean, log_std, action)
        row = Transition(obs, action, taken, value, after, REWARD_SCALE * reward, done, info["discount"])
        return (learner, following, state), row

    def advantages(rows: Transition) -> jax.Array:
        def one(after: jax.Array, row: Transition) -> tuple[jax.Array, jax.Array]:
            delta = row.reward + DISCOUNT * row.discount * row.value_after - row.value
            advantage = delta + DISCOUNT * GAE_LAMBDA * (1.0 - row.done) * after
            return advantage, advantage

        return jax.lax.scan(one, jnp.zeros(N_ENVS), rows, reverse=True)[1]

    def loss(weights: Any, rows: Transition, advantage: jax.Array, target: jax.Array) -> jax.Array:
        mean, log_std, value = network.apply(weights, rows.obs)
        ratio = jnp.exp(log_prob(mean, log_std, rows.action) - rows.log_prob)
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        gain = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1.0 - CLIP, 1.0 + CLIP) * advantage).mean()
        return -gain + 0.5 * jnp.mean((value - target) ** 2) - ENTROPY * jnp.sum(log_std)

    def epoch(learner: TrainState, batch: Any, key: jax.Array) -> TrainState:
        order = jax.random.permutation(key, N_ENVS * N_STEPS)
        flat = jax.tree.map(lambda leaf: leaf.reshape(N_ENVS * N_STEPS, *leaf.shape[2:])[order], batch)
        parts = jax.tree.map(lambda leaf: leaf.reshape(N_MINIBATCHES, -1, *leaf.shape[1:]), flat)

        def minibatch(learner: TrainState, part: Any) -> tuple[TrainState, None]:
            return learner.apply_gradients(grads=jax.grad(loss)(learner.params, *part)), None

        return jax.lax.scan(minibatch, learner, parts)[0]

    @jax.jit
    def update(learner: TrainState, obs: jax.Array, state: Any, key: jax.Array) -> tuple[TrainState, jax.Array, Any]:
        drive_key, learn_key = jax.random.split(key)
        (_, obs, state), rows = jax.lax.scan(step, (learner, obs, state), jax.random.split(drive_key, N_STEPS))
        advantage = advantages(rows)
        batch = rows, advantage, advantage + rows.value
        for epoch_key in jax.random.split(learn_key, N_EPOCHS):
            learner = epoch(learner, batch, epoch_key)
        return learner, obs, state

    weights_key, reset_key, key = jax.random.split(jax.random.key(seed), 3)
    adam = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(LEARNING_RATE, eps=1e-5))
    obs, state = jax.jit(jax.vmap(env.reset, (0, None)))(jax.random.split(reset_key, N_ENVS), params)
    obs = jax.vmap(look)(obs)
    learner = TrainState.create(apply_fn=network.apply, params=network.init(weights_key, obs), tx=adam)
    for count in range(1, steps // (N_ENVS * N_STEPS) + 1):
        learner, obs, state = update(learner, obs, state, jax.random.fold_in(key, count))
        if watch(count * N_ENVS * N_STEPS, Act(act, learner.params)):
            break
