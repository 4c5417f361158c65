"""Gymnax: `reset(key, params)` and a `step(key, state, action, params)` that resets by itself.

Gymnax 1.0 returns six values from a step, earlier releases five: `SubterraGymnax` and `SubterraGymnax5`. Gymnax need
not be installed; where the caller has imported it, spaces are of its own class, so that its wrappers accept them.
"""

import dataclasses
import sys
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.env import Box
from subterra_jax.state import EnvParams, State
from subterra_jax.tasks import make
from subterra_jax.tunnel_env import TunnelEnv


@partial(jax.tree_util.register_dataclass, data_fields=["tunnel", "horizon", "parts"], meta_fields=["goal_kind"])
@dataclasses.dataclass(frozen=True)
class GymnaxParams(EnvParams):
    """Params of a task that answer to Gymnax's own name for the horizon too."""

    @property
    def max_steps_in_episode(self) -> Any:
        return self.horizon

    def replace(self, **updates: Any) -> "GymnaxParams":
        """Return a copy with other fields; `max_steps_in_episode` is the horizon.

        Raises:
            ValueError: There is no such field.
        """
        if "max_steps_in_episode" in updates:
            updates["horizon"] = jnp.asarray(updates.pop("max_steps_in_episode"), jnp.int32)
        return super().replace(**updates)


class SubterraGymnax:
    """One environment with Gymnax 1.0's methods; hashable, so that Gymnax's wrappers may jit over it.

    Args:
        task: Id of the task.
        **options: As for `subterra_jax.make`.

    Attributes:
        default_params: Params of the task as it was made.
        name: Id of the task.
        num_actions: Numbers in one action.
    """

    def __init__(self, task: str = "Subterra/Traverse-v1", **options: Any):
        self.env: TunnelEnv
        self.env, params = make(task, **options)
        self.default_params = GymnaxParams(params.tunnel, params.horizon, params.parts, params.goal_kind)
        self.name, self.num_actions = self.env.id, self.env.action_size

    def action_space(self, params: EnvParams | None = None) -> Any:
        """Bounds of an action; `sample(key)` draws one. Params may be no argument of a function under trace."""
        with jax.ensure_compile_time_eval():  # loops ask for it inside of a jitted function
            return _in_gymnax(self.env.action_space(params or self.default_params))

    def observation_space(self, params: EnvParams | None = None) -> Any:
        """Bounds of an observation; params as for `action_space`."""
        with jax.ensure_compile_time_eval():
            return _in_gymnax(self.env.observation_space(params or self.default_params))

    @partial(jax.jit, static_argnums=0)
    def reset(self, key: PRNGKeyArray, params: EnvParams | None = None) -> tuple[Float[Array, "n_obs"], State]:
        return self.env.reset(key, params or self.default_params)

    @partial(jax.jit, static_argnums=0)
    def step(
        self, key: PRNGKeyArray, state: State, action: Float[Array, "n_action"], params: EnvParams | None = None
    ) -> tuple[Any, ...]:
        """Take one step; after the end of an episode, observation and state are those of a freshly drawn next one.

        Returns:
            Observation, state, reward, terminated, truncated and info. In info, `final_observation` is the step's own
            observation, and `done` tells whether the episode ended.
        """
        params = params or self.default_params
        step_key, reset_key = jax.random.split(key)
        own, after, reward, terminated, truncated, info = self.env.step(step_key, state, action, params)
        fresh, done = self.env.reset(reset_key, params), terminated | truncated
        obs, state = jax.tree.map(lambda new, old: jnp.where(done, new, old), fresh, (own, after))
        return obs, state, reward, terminated, truncated, {**info, "final_observation": own, "done": done}


class SubterraGymnax5(SubterraGymnax):
    """One environment with the methods of Gymnax before 1.0, for purejaxrl, rejax, stoix and loops like theirs.

    Args:
        task: Id of the task.
        **options: As for `subterra_jax.make`.
    """

    @partial(jax.jit, static_argnums=0)
    def step(
        self, key: PRNGKeyArray, state: State, action: Float[Array, "n_action"], params: EnvParams | None = None
    ) -> tuple[Any, ...]:
        """Take one step; after the end of an episode, observation and state are those of a freshly drawn next one.

        Returns:
            Observation, state, reward, done and info. `done` holds at the horizon too; `info["truncated"]` tells the
            two apart, `info["discount"]` is 0 after an end before the horizon and else 1, and
            `info["final_observation"]` is the step's own observation.
        """
        obs, state, reward, terminated, truncated, info = super().step(key, state, action, params)
        flags = {"terminated": terminated, "truncated": truncated, "discount": 1.0 - terminated}
        return obs, state, reward, info["done"], {**info, **flags}


def _in_gymnax(box: Box) -> Any:
    """Return a space of Gymnax's own class if Gymnax is imported, else the space itself; both draw and hold alike."""
    spaces = sys.modules.get("gymnax.environments.spaces")
    if spaces is None:
        return box
    space = spaces.Box(box.low, box.high, box.shape, box.dtype)
    # Gymnax's own draw would be NaN where there is no bound.
    space.sample, space.contains = box.sample, box.contains
    return space
