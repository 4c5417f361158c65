"""Gymnasium adapter: one environment in plain CPU Gymnasium."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.core import Env
from gymnasium.envs import registration
from jax.flatten_util import ravel_pytree

from subterra_jax.drawing import top_down, wall_points
from subterra_jax.plan import TunnelPlan
from subterra_jax.tasks import TASKS, make
from subterra_jax.tunnel import Tunnel


class SubterraEnv(Env[np.ndarray, np.ndarray]):
    """One environment as a `gymnasium.Env`; `info` holds Python floats and bools.

    Args:
        task: Id of the task.
        tunnel: As for `subterra_jax.make`.
        lining: As for `subterra_jax.make`.
        render_mode: None or `rgb_array`: a picture from above.
        **overrides: As for `subterra_jax.make`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  as Gymnasium declares it

    def __init__(
        self,
        task: str = "Subterra/Traverse-v0",
        tunnel: Tunnel | TunnelPlan | str | Path | None = None,
        lining: str = "pockets",
        render_mode: str | None = None,
        **overrides: Any,
    ):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        self.render_mode = render_mode
        self._env, self._params = make(task, tunnel, lining, **overrides)
        observation, action = self._env.observation_space(self._params), self._env.action_space(self._params)
        self.observation_space = spaces.Box(observation.low, observation.high, dtype=np.float32)
        self.action_space = spaces.Box(action.low, action.high, dtype=np.float32)
        self._walls: np.ndarray | None = None
        self._compile()

    def _compile(self) -> None:
        """Jit reset and step as functions of few flat arrays: passing a pytree would cost more than the step itself."""
        env, params = self._env, self._params
        _, example = jax.eval_shape(env.reset, jax.random.key(0), params)
        _, self._unpack = ravel_pytree(jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), example))
        unpack, n_obs = self._unpack, env.observation_size(params)
        out = jax.eval_shape(env.step, jax.random.key(0), example, jax.ShapeDtypeStruct((2,), jnp.float32), params)
        self._info_names = sorted(out[5])
        self._info_is_bool = [out[5][name].dtype == jnp.bool_ for name in self._info_names]
        self._n_obs = n_obs

        @jax.jit
        def reset(seed: jax.Array) -> tuple[jax.Array, ...]:
            first, rest = jax.random.split(jax.random.key(seed))
            obs, state = env.reset(first, params)
            return jax.random.key_data(rest), ravel_pytree(state)[0], obs

        @jax.jit
        def step(key_data: jax.Array, packed: jax.Array, action: jax.Array) -> tuple[jax.Array, ...]:
            now, rest = jax.random.split(jax.random.wrap_key_data(key_data))
            obs, state, reward, terminated, truncated, info = env.step(now, unpack(packed), action, params)
            values = [reward, terminated, truncated, *(info[name] for name in self._info_names)]
            told = jnp.concatenate([obs, jnp.stack([jnp.asarray(value, jnp.float32) for value in values])])
            return jax.random.key_data(rest), ravel_pytree(state)[0], told

        self._reset, self._step = reset, step

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; the same seed begins the same sequence of episodes. There are no options."""
        super().reset(seed=seed)
        self._key, self._state, obs = self._reset(np.uint32(self.np_random.integers(2**32)))
        self._obs = np.array(obs)
        return self._obs, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Take one step of 0.1 s; the action is clipped to its space, a NaN read as 0."""
        self._key, self._state, told = self._step(self._key, self._state, np.asarray(action, np.float32))
        row = np.array(told)
        self._obs = row[: self._n_obs]
        reward, terminated, truncated, *values = row[self._n_obs :].tolist()
        info = {
            name: bool(value) if is_bool else value
            for name, value, is_bool in zip(self._info_names, values, self._info_is_bool, strict=True)
        }
        return self._obs, reward, bool(terminated), bool(truncated), info

    def render(self) -> np.ndarray | None:
        """The robot, its beams and the walls from above, `(480, 480, 3)` uint8; None without `rgb_array`."""
        if self.render_mode is None:
            return None
        if self._walls is None:
            self._walls = wall_points(self._params.tunnel)
        state = self._unpack(self._state)
        n_beams = self._params.lidar.n_beams
        return top_down(
            self._walls,
            np.asarray(state.position, np.float64),
            float(state.heading),
            float(self._params.vehicle.radius),
            self._obs[:n_beams],
        )


def register() -> None:
    """Make every task known to Gymnasium under its id; doing so again changes nothing."""
    for task in TASKS:
        if task not in registration.registry:
            registration.register(id=task, entry_point="subterra_jax.gym:SubterraEnv", kwargs={"task": task})
