"""Gymnasium, one environment: no GL, no GPU, a step in some 50 µs of one core."""

from typing import Any

import numpy as np
from gymnasium.core import Env

from subterra_jax.adapters.kernel import Observation, as_observation, start_streams
from subterra_jax.adapters.task import Door, Task, open_task, refuse_fork
from subterra_jax.pictures.views import View
from subterra_jax.state import State


class SubterraEnv(Door, Env[Observation, np.ndarray]):
    """One environment as a `gymnasium.Env`; `info` holds Python floats, ints and bools.

    The observation is a plain vector for the paper's task, and a dict of named parts for a task that adds to it.

    Args:
        task: Id of the task.
        flat: Return a plain vector for every task.
        render_mode: `None` or `rgb_array`.
        view: Picture of `render`: `top`, the plan from above, drawn without GL; or `mujoco`, the bore of the tunnel
            from a camera behind the robot.
        **options: As for `subterra_jax.make`: `tunnel`, `lining`, `split`, `sensor` and so on.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  as Gymnasium declares it
    _packed: Any = None  # stream and state

    def __init__(
        self,
        task: str = "Subterra/Traverse-v1",
        *,
        flat: bool = False,
        render_mode: str | None = None,
        view: str = "top",
        **options: Any,
    ):
        self._adopt(*open_task(task, flat, render_mode, view, options), render_mode)

    def _adopt(self, task: Task, view: View, render_mode: str | None) -> None:
        self.task, self.view, self.render_mode = task, view, render_mode
        self.observation_space, self.action_space = task.observation_space, task.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; the same seed begins the same sequence of episodes.

        Args:
            seed: Seed of the sequence; `None` goes on with it.
            options: None, or empty.

        Raises:
            ValueError: There are options.
        """
        refuse_fork()
        if options:
            raise ValueError(f"a reset of {self.task_env.id} takes no options, got {sorted(options)[0]!r}")
        super().reset(seed=seed)
        fresh = seed is not None or self._packed is None
        stream = start_streams([seed], self.np_random)[0] if fresh else np.asarray(self._packed)[:2]
        packed, obs = self.task.programs.reset(stream)
        self._packed, self._obs = packed, np.array(obs)
        return as_observation(self._obs, self.task.fields), {}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take one step of 0.1 s; the action is clipped to its space, a NaN counts as 0."""
        self._last("step")
        action, task = np.asarray(action, np.float32), self.task
        if action.shape != task.action_space.shape:
            raise ValueError(f"an action must have shape {task.action_space.shape}, got {action.shape}")
        self._packed, words = task.programs.step(self._packed, action)
        self._obs, reward, terminated, truncated, info = task.programs.read(np.array(words))
        return as_observation(self._obs, task.fields), reward, terminated, truncated, info

    @property
    def state(self) -> State | None:
        """Present state, on the host; `None` before the first reset."""
        return None if self._packed is None else self.task.unpack(np.asarray(self._packed))[1]

    def render(self) -> np.ndarray | None:
        """Return a picture of the last step, `(height, width, 3)` uint8; `None` without `rgb_array`.

        Raises:
            PictureError: There is no OpenGL, which `top` does not need.
        """
        if self.render_mode is None:
            return None
        return self.view.picture(self.task_env, self.task_params, self.state, self._last("render"))

    def close(self) -> None:
        self.view.close()
