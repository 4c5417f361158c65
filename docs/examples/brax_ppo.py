"""PPO of Brax, unchanged; `pip install 'subterra-jax[brax]'`."""

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import State, Wrapper
from brax.training.agents.ppo import train as ppo
from watch import Act, Watch, eased, features

from subterra_jax.adapters.brax import SubterraBraxEnv, jax_for_brax, wrap


class _Enough(Exception):
    """The goal is reached."""


class Look(Wrapper):
    """Shows features in place of observations, and eases actions."""

    def __init__(self, env: Any, look: Any) -> None:
        super().__init__(env)
        self.look = look

    @property
    def observation_size(self) -> int:
        """Numbers in one observation."""
        return jax.eval_shape(self.look, jax.ShapeDtypeStruct((self.env.observation_size,), jnp.float32)).shape[0]

    def reset(self, rng: jax.Array) -> State:
        """Begins an episode."""
        state = self.env.reset(rng)
        return state.replace(obs=self.look(state.obs))

    def step(self, state: State, action: jax.Array) -> State:
        """Drives one control period."""
        state = self.env.step(state, eased(action, *self.unwrapped.action_bounds))
        return state.replace(obs=self.look(state.obs))


def train(watch: Watch, steps: int, seed: int) -> None:
    """Trains until the watch says enough."""
    env = SubterraBraxEnv(watch.task, **watch.options)
    (low, high), see = env.action_bounds, features(env.env, env.params)
    act: Any = None

    def look(now: int, make_policy: Any, weights: Any) -> None:
        nonlocal act
        if act is None:

            def act(weights: Any, obs: jax.Array) -> jax.Array:
                action, _ = make_policy(weights, deterministic=True)(see(obs), jax.random.key(0))
                return eased(action, low, high)

        if now and watch(now, Act(act, weights)):
            raise _Enough

    try:
        with jax_for_brax():
            ppo.train(
                environment=Look(env, see),
                wrap_env_fn=wrap,
                episode_length=env.episode_length,
                num_timesteps=steps,
                num_envs=128,
                unroll_length=32,
                batch_size=32,
                num_minibatches=8,
                num_updates_per_batch=4,
                learning_rate=1e-3,
                entropy_cost=1e-3,
                discounting=0.997,
                gae_lambda=0.95,
                clipping_epsilon=0.2,
                max_grad_norm=0.5,
                normalize_observations=True,
                seed=seed,
                num_evals=max(2, steps // 8_192 + 1),
                run_evals=False,
                policy_params_fn=look,
            )
    except _Enough:
        pass
