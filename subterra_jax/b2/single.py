"""What every Gymnasium environment of one B2 in MuJoCo's own engine does."""

import os
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import error
from gymnasium.core import Env

if sys.platform == "linux" and "mujoco" not in sys.modules and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")  # MuJoCo reads it once, when it is imported

from subterra_jax.adapters import packing
from subterra_jax.adapters.packing import start_streams, take_key
from subterra_jax.b2.params import Surroundings, WalkParams, WalkState
from subterra_jax.b2.view import Camera
from subterra_jax.b2.walk import WalkEnv


class SingleB2(Env[np.ndarray, np.ndarray]):
    """One B2: a pure environment with a state of its own, on the CPU.

    `info` holds what the pure one tells: Python floats and bools, arrays where it is more than a number. Who inherits
    makes `env`, `params` and `walk`, and says where the walking robot is.

    Attributes:
        env: The pure environment.
        params: Its parameters.
        walk: The walking part of it.
        state: What changes; None before the first reset.
    """

    env: Any
    params: Any
    walk: WalkEnv

    def __init__(self, render_mode: str | None, width: int, height: int):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        self.render_mode, self._size = render_mode, (width, height)
        self._cpu = jax.local_devices(backend="cpu")[0]
        self._stream: np.ndarray | None = None
        self._camera: Camera | None = None
        self.state: Any = None

    def _ready(self) -> None:
        """Spaces and compiled functions, once `env`, `params` and `walk` are there."""
        self.observation_space = packing.observation_space(self.env, self.params, None)
        self.action_space = packing.action_space(self.env, self.params)
        self._reset, self._step = jax.jit(self.env.reset), jax.jit(self.env.step)
        self._around = jax.jit(self.walk.surroundings)

    def walking(self) -> tuple[WalkState, WalkParams]:
        """State and parameters of the walking part."""
        raise NotImplementedError

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; the same seed begins the same sequence of episodes. There are no options."""
        super().reset(seed=seed)
        if seed is not None or self._stream is None:
            self._stream = start_streams([seed], self.np_random)[0]
        with jax.default_device(self._cpu):
            obs, self.state = self._reset(self._key(), self.params)
        return np.array(obs), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Take one step; the action is clipped, a NaN read as 0."""
        if self.state is None:
            raise error.ResetNeeded("reset() must come before step()")
        action = np.asarray(action, np.float32)
        if action.shape != self.action_space.shape:
            raise ValueError(f"an action must have shape {self.action_space.shape}, got {action.shape}")
        with jax.default_device(self._cpu):
            told = self._step(self._key(), self.state, action, self.params)
        self.state = told[1]
        obs, reward, terminated, truncated, info = jax.device_get((told[0], *told[2:]))
        plain = {name: value if np.ndim(value) else value.item() for name, value in info.items()}
        return np.array(obs), float(reward), bool(terminated), bool(truncated), plain

    def render(self) -> np.ndarray | None:
        """A picture of the last step, `(height, width, 3)` uint8; None without `rgb_array`.

        Raises:
            PictureError: There is no OpenGL.
        """
        if self.render_mode is None:
            return None
        if self.state is None:
            raise error.ResetNeeded("reset() must come before render()")
        around = self.around()
        return self.camera().picture(jax.device_get(self.walking()[0]), around)

    def camera(self) -> Camera:
        """The camera, made when it is first asked for.

        Raises:
            PictureError: There is no OpenGL.
        """
        if self._camera is None:
            self._camera = Camera(self.walk, self.walking()[1], *self._size)
        return self._camera

    def around(self) -> Surroundings:
        """What is around the robot."""
        with jax.default_device(self._cpu):
            return jax.device_get(self._around(*self.walking()))

    def close(self) -> None:
        """Release the renderer, if there is one."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def _key(self) -> jax.Array:
        """The next key of this environment's stream."""
        key, stream = take_key(jnp.asarray(self._stream))
        self._stream = np.asarray(stream)
        return key
