"""Gymnax 1.0's interface: `reset(key, params)` and `step(key, state, action, params)`, which resets by itself.

Gymnax need not be installed; its wrappers run on this environment.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax.env import Box, Info
from subterra_jax.state import EnvParams, State
from subterra_jax.tasks import make
from subterra_jax.tunnel_env import TunnelEnv


class SubterraGymnax:
    """One environment with Gymnax's methods; hashable, so that Gymnax's wrappers may jit over it.

    Args:
        task: Id of the task.
        **options: As for `subterra_jax.make`.
    """

    def __init__(self, task: str = "Subterra/Traverse-v0", **options: Any):
        self.env: TunnelEnv
        self.env, self._params = make(task, **options)

    @property
    def default_params(self) -> EnvParams:
        """Params of the task as it was made."""
        return self._params

    @property
    def name(self) -> str:
        """Id of the task."""
        return self.env.id

    @property
    def num_actions(self) -> int:
        """Numbers in one action."""
        return self.env.action_size

    def action_space(self, params: EnvParams | None = None) -> Box:
        """Bounds of an action."""
        return self.env.action_space(self._or_default(params))

    def observation_space(self, params: EnvParams | None = None) -> Box:
        """Bounds of an observation."""
        return self.env.observation_space(self._or_default(params))

    @partial(jax.jit, static_argnums=0)
    def reset(self, key: PRNGKeyArray, params: EnvParams | None = None) -> tuple[Float[Array, "n_obs"], State]:
        """Begin an episode."""
        return self.env.reset(key, self._or_default(params))

    @partial(jax.jit, static_argnums=0)
    def step(
        self, key: PRNGKeyArray, state: State, action: Float[Array, "n_action"], params: EnvParams | None = None
    ) -> tuple[Float[Array, "n_obs"], State, Float[Array, ""], Bool[Array, ""], Bool[Array, ""], Info]:
        """Take one step; after the end of an episode, observation and state are those of a freshly drawn next one.

        Returns:
            Observation, state, reward, terminated, truncated and info. In info, `final_observation` is the step's own
            observation, and `done` whether the episode ended.
        """
        params = self._or_default(params)
        step_key, reset_key = jax.random.split(key)
        stepped_obs, stepped, reward, terminated, truncated, info = self.env.step(step_key, state, action, params)
        begun_obs, begun = self.env.reset(reset_key, params)
        done = terminated | truncated
        obs, state = jax.tree.map(
            lambda new, old: jnp.where(done, new, old), (begun_obs, begun), (stepped_obs, stepped)
        )
        return obs, state, reward, terminated, truncated, {**info, "final_observation": stepped_obs, "done": done}

    def _or_default(self, params: EnvParams | None) -> EnvParams:
        return self._params if params is None else params
