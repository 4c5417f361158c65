"""Gymnasium, one environment: no GL, no GPU, a step in some 50 µs of one core."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from gymnasium import error
from gymnasium.core import Env

from subterra_jax.adapters import report, spaces
from subterra_jax.adapters.one_kernel import compile_as_one_kernel
from subterra_jax.adapters.packing import pack, unpacker
from subterra_jax.adapters.spaces import Observation, as_observation
from subterra_jax.adapters.streams import start_streams, take_key
from subterra_jax.adapters.views import make_view
from subterra_jax.tasks import make
from subterra_jax.tunnel.sources import Source


class SubterraEnv(Env[Observation, np.ndarray]):
    """One environment as a `gymnasium.Env`; `info` holds Python floats, ints and bools.

    The observation is the bare vector for the paper's task; a task that adds to it gives a dict of its named parts.

    Args:
        task: Id of the task.
        tunnel: As for `subterra_jax.make`. None is the tunnel of the scene where one is given, else the packaged one.
        lining: As for `subterra_jax.make`.
        flat: Give the bare vector for every task.
        render_mode: None or `rgb_array`.
        view: What `render` shows: `top`, the plan from above, drawn without GL; or `mujoco`, the scene as a camera
            behind the robot sees it.
        scene: Folder that `scene.build` wrote, or one of its MJCF files; `view="mujoco"` needs it, `top` does not.
        **overrides: As for `subterra_jax.make`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  as Gymnasium declares it

    def __init__(
        self,
        task: str = "Subterra/Traverse-v0",
        tunnel: Source | Sequence[Source] = None,
        lining: str | None = None,
        flat: bool = False,
        render_mode: str | None = None,
        view: str = "top",
        scene: str | Path | None = None,
        **overrides: Any,
    ):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        self.render_mode = render_mode
        self._view = make_view(view, scene)
        env, params = make(task, self._view.tunnel if tunnel is None else tunnel, lining, **overrides)
        self._env, self._params = env, params
        self._fields = spaces.named_fields(env, params, flat)
        self.observation_space = spaces.observation_space(env, params, self._fields)
        self.action_space = spaces.action_space(env, params)
        self._stream: np.ndarray | None = None
        self._packed: Any = None
        self._compile()

    def _compile(self) -> None:
        """Reset and step as functions of two flat arrays: the stream with the state, and the action."""
        env, params = self._env, self._params
        state, told = report.shapes(env, params)
        stream = jax.ShapeDtypeStruct((2,), np.uint32)
        packed = jax.eval_shape(pack, (stream, state))
        self._unpack, self._read = unpacker((stream, state)), report.python_reader(told)
        unpack = self._unpack

        def reset(stream: jax.Array) -> tuple[jax.Array, jax.Array]:
            key, stream = take_key(stream)
            obs, state = env.reset(key, params)
            return pack((stream, state)), obs

        def step(packed: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
            stream, state = unpack(packed)
            key, stream = take_key(stream)
            words, state = report.step_and_pack(env, key, state, action, params)
            return pack((stream, state)), words

        self._reset = compile_as_one_kernel(reset, stream)
        self._step = compile_as_one_kernel(step, packed, jax.ShapeDtypeStruct((env.action_size,), np.float32))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; the same seed begins the same sequence of episodes. There are no options."""
        super().reset(seed=seed)
        if seed is not None or self._packed is None:
            stream = start_streams([seed], self.np_random)[0]
        else:
            stream = np.asarray(self._packed)[:2]
        self._packed, obs = self._reset(stream)
        self._obs = np.array(obs)
        return as_observation(self._obs, self._fields), {}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take one step of 0.1 s; the action is clipped to its space, a NaN read as 0."""
        if self._packed is None:
            raise error.ResetNeeded("reset() must come before step()")
        action = np.asarray(action, np.float32)
        if action.shape != (self._env.action_size,):
            raise ValueError(f"an action must have shape {(self._env.action_size,)}, got {action.shape}")
        self._packed, words = self._step(self._packed, action)
        self._obs, reward, terminated, truncated, info = self._read(np.array(words))
        return as_observation(self._obs, self._fields), reward, terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """A picture of the last step, `(480, 480, 3)` uint8; None without `rgb_array`."""
        if self.render_mode is None:
            return None
        if self._packed is None:
            raise error.ResetNeeded("reset() must come before render()")
        _, state = self._unpack(np.asarray(self._packed))
        return self._view.picture(self._env, self._params, state, self._obs)

    def close(self) -> None:
        """Release the renderer, if there is one."""
        self._view.close()
