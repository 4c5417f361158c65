"""Gymnasium: one B2 in MuJoCo's own engine, as `Subterra/B2Traverse-v1` and `Subterra/B2Walk-v1`."""

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

from subterra_jax.adapters import packing
from subterra_jax.adapters.packing import Observation, start_streams, take_key
from subterra_jax.adapters.views import TunnelChoice
from subterra_jax.b2 import tasks
from subterra_jax.b2.engine import MujocoPhysics, walk_in_scene
from subterra_jax.b2.gait import RELEASED, WalkPolicy
from subterra_jax.b2.params import WalkParams, WalkState
from subterra_jax.b2.view import Camera
from subterra_jax.b2.walk import WalkEnv
from subterra_jax.host.task_ids import B2_TRAVERSE, WALK
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel_env import TunnelEnv


class SingleB2(Env[Observation, np.ndarray]):
    """One B2: a pure environment with a state of its own, on the CPU.

    `info` is that of the pure environment: Python floats and bools, and arrays. A subclass makes `env`, `params` and
    `walk`, and gives the state and params of the walking robot.

    Attributes:
        env: The pure environment.
        params: Its parameters.
        walk: The walking robot in it.
        state: Its state; `None` before the first reset.
    """

    env: Any
    params: Any
    walk: WalkEnv

    def __init__(self, tunnel: TunnelChoice, render_mode: str | None, width: int, height: int):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        self.render_mode, self._size = render_mode, (width, height)
        self._tunnel = tunnel
        self._cpu = jax.local_devices(backend="cpu")[0]
        self._stream: np.ndarray | None = None
        self._camera: Camera | None = None
        self.state: Any = None

    def _prepare(self) -> None:
        """Makes spaces and compiled functions from `env`, `params` and `walk`."""
        mission = isinstance(self.env, TunnelEnv)
        self._fields = packing.named_fields(self.env, self.params, flat=False) if mission else None
        self.observation_space = packing.observation_space(self.env, self.params, self._fields)
        self.action_space = packing.action_space(self.env, self.params)
        self._reset, self._step = jax.jit(self.env.reset), jax.jit(self.env.step)

    def walking(self) -> tuple[WalkState, WalkParams]:
        """Return the state and the parameters of the walking robot."""
        raise NotImplementedError

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins an episode; the same seed begins the same sequence of episodes.

        Raises:
            ValueError: There are options; a robot on legs takes none.
        """
        if options:
            raise ValueError(f"a reset of {self.env.id} takes no options, got {sorted(options)[0]!r}")
        super().reset(seed=seed)
        if seed is not None or self._stream is None:
            self._stream = start_streams([seed], self.np_random)[0]
        with jax.default_device(self._cpu):
            obs, self.state = self._reset(self._key(), self.params)
        return packing.as_observation(np.array(obs), self._fields), {}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Takes one step; the action is clipped, a NaN read as 0."""
        if self.state is None:
            raise error.ResetNeeded("reset() must come before step()")
        action = np.asarray(action, np.float32)
        if action.shape != self.action_space.shape:
            raise ValueError(f"an action must have shape {self.action_space.shape}, got {action.shape}")
        with jax.default_device(self._cpu):
            obs, self.state, *rest = self._step(self._key(), self.state, action, self.params)
        obs, reward, terminated, truncated, info = jax.device_get((obs, *rest))
        plain = {name: value if np.ndim(value) else value.item() for name, value in info.items()}
        return (
            packing.as_observation(np.array(obs), self._fields),
            float(reward),
            bool(terminated),
            bool(truncated),
            plain,
        )

    def render(self) -> np.ndarray | None:
        """Draws the last step, `(height, width, 3)` uint8; `None` without `rgb_array`.

        Raises:
            PictureError: There is no OpenGL.
        """
        if self.render_mode is None:
            return None
        if self.state is None:
            raise error.ResetNeeded("reset() must come before render()")
        state, params = jax.device_get(self.walking()[0]), self.walking()[1]
        qpos = np.array(state.body.qpos, np.float64)
        qpos[:3] += np.asarray(params.track.position[state.anchor], np.float64)
        return self.camera().draw(qpos)

    def camera(self) -> Camera:
        """Return the camera, made at the first call.

        Raises:
            PictureError: There is no OpenGL.
        """
        if self._camera is None:
            self._camera = Camera(self.walk, self.walking()[1], self._tunnel, *self._size)
        return self._camera

    def close(self) -> None:
        """Releases the renderer, if there is one."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def _key(self) -> jax.Array:
        """The next key of this environment's stream."""
        key, stream = take_key(jnp.asarray(self._stream))
        self._stream = np.asarray(stream)
        return key


class B2Env(SingleB2):
    """One B2 that walks a tunnel on a frozen gait; action and observation are those of the planar task.

    A step is 0.2 s: ten control periods of the gait, fifty steps of physics. `info` has `station`, `fall` and
    `contact` among others.

    Args:
        task: Id of the task.
        tunnel: As for `tasks.make_mission`.
        lining: As for `tasks.make_mission`.
        scene: A built scene folder to walk in, instead of a tunnel.
        policy: The gait: its file or name, or `trot`.
        odometer: `legs`, the robot's own; or `drift`, the model of the planar tasks.
        render_mode: `None` or `rgb_array`.
        width: Width of a picture, pixels.
        height: Height of a picture, pixels.
        **overrides: As for `tasks.make_mission`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012  as Gymnasium declares it

    def __init__(
        self,
        task: str = B2_TRAVERSE,
        tunnel: TunnelPlan | str | Path | None = None,
        lining: str | None = None,
        *,
        scene: str | Path | None = None,
        policy: WalkPolicy | str | Path = RELEASED,
        odometer: Literal["legs", "drift"] = "legs",
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        **overrides: Any,
    ):
        super().__init__(TunnelChoice(tunnel, lining), render_mode, width, height)
        with jax.default_device(self._cpu):
            self.env, self.params = tasks.make_mission(
                task, tunnel, lining, scene=scene, policy=policy, odometer=odometer, engine="mujoco", **overrides
            )
        self.walk = self.env.motion.walk
        self._prepare()

    def walking(self) -> tuple[WalkState, WalkParams]:
        """Return the state and the parameters of the walking robot."""
        return self.state.legs.walk, self.params.walk


class B2WalkEnv(SingleB2):
    """One B2 that learns to walk: twelve joint offsets fifty times a second, as in `subterra_jax.b2.walk.WalkEnv`.

    Args:
        task: Id of the task.
        tunnel: As for `tasks.make`.
        lining: As for `tasks.make`.
        scene: A built scene folder to walk in, instead of a tunnel.
        render_mode: `None` or `rgb_array`.
        width: Width of a picture, pixels.
        height: Height of a picture, pixels.
        **overrides: As for `tasks.make`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012  as Gymnasium declares it

    def __init__(
        self,
        task: str = WALK,
        tunnel: TunnelPlan | str | Path | None = None,
        lining: str | None = None,
        *,
        scene: str | Path | None = None,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        **overrides: Any,
    ):
        super().__init__(TunnelChoice(tunnel, lining), render_mode, width, height)
        with jax.default_device(self._cpu):
            self.env, self.params = tasks.make(task, tunnel, lining, scene=scene, physics=MujocoPhysics(), **overrides)
        if scene is not None:
            self.env = walk_in_scene(self.env, Path(scene), lining)
        self.walk = self.env
        self._prepare()

    def walking(self) -> tuple[WalkState, WalkParams]:
        """Return the state and the parameters of the walking robot."""
        return self.state, self.params
