"""PPO of rejax, unchanged; `pip install 'gymnax<1' rejax`.

Gymnax asks for other releases of Gymnasium than the rest of the house: an environment of its own, or `--no-deps`.
"""

from typing import Any

import jax
import jax.numpy as jnp
import rejax
from watch import Act, Watch

from subterra_jax.adapters.gymnax import SubterraGymnax5


def train(watch: Watch, steps: int, seed: int) -> None:
    """Trains until the watch says enough."""
    env = SubterraGymnax5(watch.task, **watch.options)
    trainer = rejax.PPO.create(
        env=env,
        env_params=env.default_params,
        num_envs=128,
        num_steps=64,
        num_minibatches=8,
        num_epochs=4,
        learning_rate=1e-3,
        gamma=0.98,
        max_grad_norm=0.5,
        ent_coef=1e-3,
        normalize_observations=True,
        normalize_rewards=True,
        reward_normalization_discount=0.98,
        total_timesteps=8_192,  # of one call; the next one goes on from its state
        eval_freq=8_192,
        skip_initial_evaluation=True,
    )
    trainer = trainer.replace(eval_callback=lambda trainer, state, key: ())
    low, high = env.action_space().low, env.action_space().high

    def act(state: Any, obs: jax.Array) -> jax.Array:
        actor, rms = state
        obs = trainer.normalize_obs(rms, obs)
        mean = trainer.actor.apply(actor, obs[None], method=_mean)[0]
        return jnp.clip(mean, low, high)

    def _mean(actor: Any, obs: jax.Array) -> jax.Array:
        return actor._action_dist(obs).mode()

    go_on = jax.jit(lambda state: trainer.train(train_state=state)[0])
    state = trainer.init_state(jax.random.PRNGKey(seed))
    while state.global_step < steps:
        state = go_on(state)
        if watch(int(state.global_step), Act(act, (state.actor_ts.params, state.obs_rms_state))):
            break
