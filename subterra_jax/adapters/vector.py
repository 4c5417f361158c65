"""Gymnasium, many environments at once: `gymnasium.make_vec`, all three autoreset modes, NumPy out.

Each environment of a batch has its own stream of keys and does what it would do alone: same seed, same episodes,
whatever its neighbours do. `AutoReset` shares one key and is quicker inside a graph.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import error
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from subterra_jax.adapters import packing
from subterra_jax.adapters.batch import Batch
from subterra_jax.adapters.choosing import read_choice
from subterra_jax.adapters.moments import Moment, check_moment, refuse_fork
from subterra_jax.adapters.packing import Fields, Observation, Report, as_observation, start_streams
from subterra_jax.adapters.views import view_for
from subterra_jax.parts.spatial_lidar import SENSORS
from subterra_jax.tasks import make
from subterra_jax.tunnel.sources import Source


def mask_info(info: Mapping[str, np.ndarray], mask: np.ndarray) -> dict[str, Any]:
    """Return the info of some environments as Gymnasium's vector environments do: arrays, and masks in `_name`.

    Entries of the others are 0; without any environment the result is empty.

    Args:
        info: Arrays `(n, ...)`; numbers of 32 bits become Python's own width, as when single environments are gathered.
        mask: Environments with entries, `(n,)`.
    """
    masked: dict[str, Any] = {}
    if mask.any():
        for name, values in info.items():
            wide = values.astype({"f": np.float64, "i": np.int64}.get(values.dtype.kind, values.dtype))
            wide[~mask] = 0
            masked[name], masked[f"_{name}"] = wide, mask.copy()
    return masked


def final_info(step: Report, done: np.ndarray, fields: Fields | None) -> dict[str, Any]:
    """Return `final_obs` and `final_info` of the episodes that ended in a step; empty if none did.

    Args:
        step: Report of the batch.
        done: Environments whose episode ended, `(n,)`.
        fields: Names of the parts of an observation, if it is a dict.
    """
    if not done.any():
        return {}
    final = np.full(len(done), None, dtype=object)
    for index in np.flatnonzero(done):
        final[index] = as_observation(np.array(step.obs[index]), fields)
    return {
        "final_obs": final,
        "_final_obs": done.copy(),
        "final_info": mask_info(step.info, done),
        "_final_info": done.copy(),
    }


class SubterraVectorEnv(VectorEnv[Observation, np.ndarray, np.ndarray]):
    """A batch of environments in one compiled program, on JAX's default device.

    Environment i seeded with s + i does what a single `SubterraEnv` seeded with s + i does, up to rounding. Flags,
    timing and `info` are those of Gymnasium's own `SyncVectorEnv` in the same mode.

    Args:
        num_envs: Number of environments.
        autoreset_mode: `NEXT_STEP` (the step after the last begins the next episode and ignores the action),
            `SAME_STEP` (the last step returns the next episode's first observation, and its own in
            `info["final_obs"]`), or `DISABLED` (the caller resets with `options={"reset_mask": ...}`).
        task: Id of the task.
        tunnel: As for `SubterraEnv`.
        lining: As for `SubterraEnv`.
        flat: As for `SubterraEnv`.
        render_mode: As for `SubterraEnv`; `render` returns one picture for each environment.
        view: As for `SubterraEnv`.
        scene: As for `SubterraEnv`.
        split: As for `subterra_jax.make`.
        **overrides: As for `subterra_jax.make`.
    """

    def __init__(
        self,
        num_envs: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        task: str = "Subterra/Traverse-v1",
        tunnel: Source | Sequence[Source] = None,
        lining: str | None = None,
        flat: bool = False,
        render_mode: str | None = None,
        view: str = "top",
        scene: str | Path | None = None,
        split: str | None = None,
        **overrides: Any,
    ):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        refuse_fork()
        self.num_envs, self.render_mode = num_envs, render_mode
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": 10, "autoreset_mode": self.autoreset_mode}
        self._view, tunnel = view_for(view, scene, task, tunnel, split, lining, overrides.get("sensor", SENSORS[0]))
        env, params = make(task, tunnel, lining, **overrides)
        self.batch = Batch(env, params, num_envs, self.autoreset_mode)
        self.fields = packing.named_fields(env, params, flat)
        self.single_observation_space = packing.observation_space(env, params, self.fields)
        self.single_action_space = packing.action_space(env, params)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._pending = np.zeros(num_envs, np.bool_)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode in every environment, or in those that `options["reset_mask"]` marks.

        Args:
            seed: An int seeds environment i with seed + i; a sequence holds one seed for each. With `None` an
                environment goes on with its stream.
            options: `reset_mask`: a bool array `(num_envs,)`; the other environments stay as they are. `goal` and
                `start` as for `SubterraEnv`, for these episodes alone; one number for all environments, or an array
                `(num_envs,)` in which NaN leaves what is drawn.

        Returns:
            Observations of all environments, and an empty info.

        Raises:
            OptionError: The task has no such thing, or a robot cannot stand there.
        """
        refuse_fork()
        mask = self._reset_mask(options)
        wishes = {name: wish for name, wish in (options or {}).items() if name != "reset_mask"}
        choice = read_choice(self.batch.env, self.batch.params, wishes, self.num_envs)
        super().reset(seed=seed if isinstance(seed, int) else None)
        self._obs = self.batch.reset(self._streams(seed, mask), mask, choice)
        self._pending = self._pending & ~mask
        return as_observation(self._obs, self.fields), {}

    def step(self, actions: np.ndarray) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take one step of 0.1 s in every environment; see `autoreset_mode` for those that have finished.

        Returns:
            Observations to act on next, rewards (float64), terminated, truncated and info, all of `(num_envs, ...)`.
        """
        begun = self._pending
        obs, reward, terminated, truncated, step = self.advance(actions)
        done = terminated | truncated
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            info = {**mask_info(step.info, ~done), **final_info(step, done, self.fields)}
        else:
            info = mask_info(step.info, ~begun)
        return obs, reward.astype(np.float64), terminated, truncated, info

    def advance(self, actions: np.ndarray) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, Report]:
        """Take one step; return the batch's own report in place of info."""
        begun = self._pending
        if self.autoreset_mode == AutoresetMode.DISABLED and begun.any():
            raise error.ResetNeeded(f"environments {np.flatnonzero(begun).tolist()} have finished: reset them first")
        self._obs, step = self.batch.step(np.asarray(actions), begun)
        reward = np.where(begun, np.float32(0.0), step.reward)
        terminated, truncated = step.terminated & ~begun, step.truncated & ~begun
        if self.autoreset_mode != AutoresetMode.SAME_STEP:
            self._pending = terminated | truncated
        return as_observation(self._obs, self.fields), reward, terminated, truncated, step

    def get_state(self) -> Moment:
        """Return all that changes, to be set again later; see `SubterraEnv.get_state`."""
        if (words := self.batch.words()) is None:
            raise error.ResetNeeded("reset() must come before get_state()")
        return Moment(self.batch.env.id, words, self._obs.copy(), self._pending.copy())

    def set_state(self, moment: Moment) -> Observation:
        """Go back to a moment; what follows has the same bits as it had then.

        Returns:
            The observations of that moment.

        Raises:
            MomentError: It belongs to another task, or to another number of environments.
        """
        n_obs = self.batch.env.observation_size(self.batch.params)
        check_moment(moment, self.batch.env.id, (self.num_envs, self.batch.n_words), (self.num_envs, n_obs))
        self.batch.set_words(moment.words, moment.obs)
        self._obs = moment.obs.copy()
        self._pending = np.zeros(self.num_envs, bool) if moment.pending is None else moment.pending.copy()
        return as_observation(self._obs, self.fields)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return a picture of each environment, `(480, 480, 3)` uint8; `None` without `rgb_array`."""
        if self.render_mode is None:
            return None
        return tuple(self.picture(index) for index in range(self.num_envs))

    def picture(self, index: int) -> np.ndarray:
        """Return a picture of one environment, `(480, 480, 3)` uint8."""
        if self.batch.rows is None:
            raise error.ResetNeeded("reset() must come before render()")
        return self._view.picture(self.batch.env, self.batch.params, self.batch.state(index), self._obs[index])

    def close_extras(self, **kwargs: Any) -> None:
        """Release the renderer, if there is one."""
        self._view.close()

    def _reset_mask(self, options: dict[str, Any] | None) -> np.ndarray:
        """Return the caller's mask, checked; all environments without one."""
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
        """Return streams for the next reset: newly seeded for a given seed or at first, else those that go on."""
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
