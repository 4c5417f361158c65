"""PPO of rejax, unchanged.

Gymnax asks for another Gymnasium than the rest of the house. So both go to a folder of their own, put on `PYTHONPATH`:
`pip install --no-deps -t rejax-site rejax 'gymnax<1' distrax tfp-nightly chex dm-tree toolz wrapt gast decorator`.
"""

from typing import Any

import jax
import jax.numpy as jnp
import rejax
from gymnax.environments.spaces import Box
from watch import Act, Watch, eased, features

from subterra_jax.adapters.gymnax import SubterraGymnax5


class Seen(SubterraGymnax5):
    """Shows features in place of observations, and eases actions."""

    def __init__(self, task: str, **options: Any) -> None:
        super().__init__(task, **options)
        self.look, bounds = features(self.env, self.default_params), self.env.action_space(self.default_params)
        self.bounds = bounds.low, bounds.high

    def observation_space(self, params: Any = None) -> Box:
        """Bounds of the features."""
        n = jax.eval_shape(self.look, jax.ShapeDtypeStruct(super().observation_space(params).shape, jnp.float32))
        return Box(-jnp.inf, jnp.inf, n.shape)

    def action_space(self, params: Any = None) -> Box:
        """Bounds of eased actions."""
        return Box(-1.0, 1.0, (2,))

    def reset(self, key: jax.Array, params: Any = None) -> Any:
        """Begins an episode."""
        obs, state = super().reset(key, params)
        return self.look(obs), state

    def step(self, key: jax.Array, state: Any, action: jax.Array, params: Any = None) -> Any:
        """Drives one control period."""
        obs, *rest = super().step(key, state, eased(action, *self.bounds), params)
        return self.look(obs), *rest


def train(watch: Watch, steps: int, seed: int) -> None:
    """Trains until the watch says enough."""
    env = Seen(watch.task, **watch.options)
    trainer = rejax.PPO.create(
        env=env,
        env_params=env.default_params,
        num_envs=128,
        num_steps=64,
        num_minibatches=8,
        num_epochs=4,
        learning_rate=1e-3,
        gamma=0.997,
        max_grad_norm=0.5,
        ent_coef=1e-3,
        normalize_observations=True,
        normalize_rewards=True,
        reward_normalization_discount=0.997,
        total_timesteps=8_192,  # of one call; the next one goes on from its state
        eval_freq=8_192,
        skip_initial_evaluation=True,
    )
    trainer = trainer.replace(eval_callback=lambda trainer, state, key: ())

    def act(state: Any, obs: jax.Array) -> jax.Array:
        actor, rms = state
        obs = trainer.normalize_obs(rms, env.look(obs))
        mean = trainer.actor.apply(actor, obs[None], method=_mean)[0]
        return eased(mean, *env.bounds)

    def _mean(actor: Any, obs: jax.Array) -> jax.Array:
        return actor._action_dist(obs).mode()

    go_on = jax.jit(lambda state: trainer.train(train_state=state)[0])
    state = trainer.init_state(jax.random.PRNGKey(seed))
    while state.global_step < steps:
        state = go_on(state)
        if watch(int(state.global_step), Act(act, (state.actor_ts.params, state.obs_rms_state))):
            break
