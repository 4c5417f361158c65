"""Gymnasium, one B2 in MuJoCo's own engine: `gymnasium.make("Subterra/B2Traverse-v0")`."""

import os
import sys
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import error
from gymnasium.core import Env

if sys.platform == "linux" and "mujoco" not in sys.modules and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")  # MuJoCo reads it once, when it is imported

from subterra_jax.adapters import spaces
from subterra_jax.adapters.streams import start_streams, take_key
from subterra_jax.b2 import ids, missions
from subterra_jax.b2 import policy as gaits
from subterra_jax.b2.physics import Surroundings
from subterra_jax.b2.policy import WalkPolicy
from subterra_jax.b2.view import Camera
from subterra_jax.tunnel.plan import TunnelPlan


class B2Env(Env[np.ndarray, np.ndarray]):
    """One B2 that walks a tunnel on a frozen gait; action and observation are those of the planar task.

    `info` holds Python floats and bools, among them `station`, `fall` and `contact`.

    Args:
        task: Id of the task.
        tunnel: As for `missions.make`.
        lining: As for `missions.make`.
        scene: A built scene folder to walk in, instead of a tunnel.
        policy: The gait: its file or name, or `trot`.
        odometer: `legs`, the robot's own; or `drift`, the model of the planar tasks.
        render_mode: None or `rgb_array`.
        width: Of a picture, pixels.
        height: Of a picture, pixels.
        **overrides: As for `missions.make`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012  as Gymnasium declares it

    def __init__(
        self,
        task: str = ids.TRAVERSE,
        tunnel: TunnelPlan | str | Path | None = None,
        lining: str | None = None,
        *,
        scene: str | Path | None = None,
        policy: WalkPolicy | str | Path = gaits.RELEASED,
        odometer: Literal["legs", "drift"] = "legs",
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        **overrides: Any,
    ):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        self.render_mode, self._size = render_mode, (width, height)
        self._cpu = jax.local_devices(backend="cpu")[0]
        with jax.default_device(self._cpu):
            self.mission, self.params = missions.make(
                task, tunnel, lining, scene=scene, policy=policy, odometer=odometer, engine="mujoco", **overrides
            )
        self.observation_space = spaces.observation_space(self.mission, self.params, None)
        self.action_space = spaces.action_space(self.mission, self.params)
        self._reset, self._step = jax.jit(self.mission.reset), jax.jit(self.mission.step)
        self._around = jax.jit(self.mission.walk.surroundings)
        self._stream: np.ndarray | None = None
        self.state: Any = None
        self._camera: Camera | None = None

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
        """Take one step of 0.2 s: ten of the gait, fifty of physics; the action is clipped, a NaN read as 0."""
        if self.state is None:
            raise error.ResetNeeded("reset() must come before step()")
        action = np.asarray(action, np.float32)
        if action.shape != self.action_space.shape:
            raise ValueError(f"an action must have shape {self.action_space.shape}, got {action.shape}")
        with jax.default_device(self._cpu):
            told = self._step(self._key(), self.state, action, self.params)
        self.state = told[1]
        obs, reward, terminated, truncated, info = jax.device_get((told[0], *told[2:]))
        plain = {name: value.item() for name, value in info.items()}
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
        return self.camera().picture(jax.device_get(self.state.walk), around)

    def camera(self) -> Camera:
        """The camera, made when it is first asked for.

        Raises:
            PictureError: There is no OpenGL.
        """
        if self._camera is None:
            self._camera = Camera(self.mission.walk, self.params.walk, *self._size)
        return self._camera

    def around(self) -> Surroundings:
        """What is around the robot."""
        with jax.default_device(self._cpu):
            return jax.device_get(self._around(self.state.walk, self.params.walk))

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
