"""Gymnasium, many environments at once: `gymnasium.make_vec`, all three autoreset modes, NumPy out."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import error
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from subterra_jax.adapters import spaces
from subterra_jax.adapters.batched import Batch
from subterra_jax.adapters.infos import ended_infos, masked
from subterra_jax.adapters.report import Report
from subterra_jax.adapters.spaces import Observation, as_observation
from subterra_jax.adapters.streams import start_streams
from subterra_jax.adapters.views import make_view
from subterra_jax.tasks import make
from subterra_jax.tunnel.sources import Source


class SubterraVectorEnv(VectorEnv[Observation, np.ndarray, np.ndarray]):
    """A batch of environments in one compiled program, on JAX's default device.

    Environment i seeded with s + i does what a single `SubterraEnv` seeded with s + i does, up to rounding. Flags,
    timing and `info` are those of Gymnasium's own `SyncVectorEnv` in the same mode.

    Args:
        num_envs: How many.
        autoreset_mode: `NEXT_STEP` (the step after the last begins the next episode and ignores the action),
            `SAME_STEP` (the last step returns the next episode's first observation, and its own in
            `info["final_obs"]`), or `DISABLED` (the caller resets with `options={"reset_mask": ...}`).
        task: Id of the task.
        tunnel: As for `SubterraEnv`, as the rest.
        lining: As for `SubterraEnv`.
        flat: As for `SubterraEnv`.
        render_mode: As for `SubterraEnv`; `render` gives one picture for each environment.
        view: As for `SubterraEnv`.
        scene: As for `SubterraEnv`.
        **overrides: As for `subterra_jax.make`.
    """

    def __init__(
        self,
        num_envs: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
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
        self.num_envs, self.render_mode = num_envs, render_mode
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": 10, "autoreset_mode": self.autoreset_mode}
        self._view = make_view(view, scene)
        env, params = make(task, self._view.tunnel if tunnel is None else tunnel, lining, **overrides)
        self.batch = Batch(env, params, num_envs, self.autoreset_mode)
        self.fields = spaces.named_fields(env, params, flat)
        self.single_observation_space = spaces.observation_space(env, params, self.fields)
        self.single_action_space = spaces.action_space(env, params)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._pending = np.zeros(num_envs, np.bool_)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode in every environment, or in those that `options["reset_mask"]` names.

        Args:
            seed: An int seeds environment i with seed + i; a sequence seeds each with its own; where there is None,
                the environment goes on with the random numbers it has.
            options: `reset_mask`: a bool array `(num_envs,)`; the other environments stay as they are.

        Returns:
            Observations of all environments, and an empty info.
        """
        super().reset(seed=seed if isinstance(seed, int) else None)
        mask = self._reset_mask(options)
        streams = self._streams(seed, mask)
        self._pending = self._pending & ~mask
        self._obs = self.batch.reset(streams, mask)
        return as_observation(self._obs, self.fields), {}

    def step(self, actions: np.ndarray) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take one step of 0.1 s in every environment; see `autoreset_mode` for those that have finished.

        Returns:
            Observations to act on next, rewards (float64), terminated, truncated and info, all of `(num_envs, ...)`.
        """
        begun = self._pending
        obs, reward, terminated, truncated, told = self.advance(actions)
        done = terminated | truncated
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            info = {**masked(told.info, ~done), **ended_infos(told, done, self.fields)}
        else:
            info = masked(told.info, ~begun)
        return obs, reward.astype(np.float64), terminated, truncated, info

    def advance(self, actions: np.ndarray) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, Report]:
        """As `step`, with the batch's own report in place of info."""
        begun = self._pending
        if self.autoreset_mode == AutoresetMode.DISABLED and begun.any():
            raise error.ResetNeeded(f"environments {np.flatnonzero(begun).tolist()} have finished: reset them first")
        self._obs, told = self.batch.step(np.asarray(actions), begun)
        reward = np.where(begun, np.float32(0.0), told.reward)
        terminated, truncated = told.terminated & ~begun, told.truncated & ~begun
        if self.autoreset_mode != AutoresetMode.SAME_STEP:
            self._pending = terminated | truncated
        return as_observation(self._obs, self.fields), reward, terminated, truncated, told

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture of each environment, `(480, 480, 3)` uint8; None without `rgb_array`."""
        if self.render_mode is None:
            return None
        return tuple(self.picture(index) for index in range(self.num_envs))

    def picture(self, index: int) -> np.ndarray:
        """A picture of one environment, `(480, 480, 3)` uint8."""
        if self.batch.rows is None:
            raise error.ResetNeeded("reset() must come before render()")
        return self._view.picture(self.batch.env, self.batch.params, self.batch.state(index), self._obs[index])

    def close_extras(self, **kwargs: Any) -> None:
        """Release the renderer, if there is one."""
        self._view.close()

    def _reset_mask(self, options: dict[str, Any] | None) -> np.ndarray:
        """The mask that a caller gave, checked; everybody where there is none."""
        mask = (options or {}).get("reset_mask")
        if mask is None:
            return np.ones(self.num_envs, np.bool_)
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            raise TypeError(f"options['reset_mask'] must be a bool array, got {type(mask).__name__} {mask!r}")
        if mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(f"options['reset_mask'] must have shape ({self.num_envs},) and a True in it, got {mask!r}")
        if self.batch.rows is None and not mask.all():
            raise error.ResetNeeded("the first reset must be of all environments")
        return mask

    def _streams(self, seed: int | Sequence[int | None] | None, mask: np.ndarray) -> np.ndarray:
        """Streams for the next reset: newly seeded where a seed is given or none has begun, else those that go on."""
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
        if seeds is None:
            seeds = [None] * self.num_envs
        if len(seeds) != self.num_envs:
            raise ValueError(f"there must be one seed for each of the {self.num_envs} environments, got {len(seeds)}")
        running = self.batch.stream
        fresh = np.array([running is None or one is not None for one in seeds]) & mask
        streams = np.zeros((self.num_envs, 2), np.uint32) if running is None else running.copy()
        streams[fresh] = start_streams([one for one, new in zip(seeds, fresh, strict=True) if new], self.np_random)
        return streams
