"""Gymnasium, many environments at once: `gymnasium.make_vec`, all three autoreset modes, NumPy out.

Each environment of a batch has its own stream of keys and does what it would do alone: same seed, same episodes,
whatever its neighbours do. `AutoReset` shares one key and is quicker inside a graph.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import error
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Array, Bool, Float

from subterra_jax.adapters.kernel import (
    Fields,
    Observation,
    Report,
    as_observation,
    pack,
    start_streams,
    take_key,
)
from subterra_jax.adapters.task import Door, open_task, refuse_fork
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel_env import TunnelEnv


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
    """Return `final_obs` and `final_info` of the episodes that ended in a step, `done` `(n,)`; empty if none did."""
    if not done.any():
        return {}
    final = np.full(len(done), None, dtype=object)
    for index in np.flatnonzero(done):
        final[index] = as_observation(np.array(step.obs[index]), fields)
    ended = {"final_obs": final, "final_info": mask_info(step.info, done)}
    return {**ended, "_final_obs": done.copy(), "_final_info": done.copy()}


class Rows(NamedTuple):
    """Streams `(n, 2)`, states and observations `(n, n_obs)` of all environments."""

    stream: Any
    state: Any
    obs: Any


class SubterraVectorEnv(Door, VectorEnv[Observation, np.ndarray, np.ndarray]):
    """A batch of environments in one compiled program, on JAX's default device.

    Environment i seeded with s + i does what a single `SubterraEnv` seeded with s + i does, up to rounding. Flags,
    timing and `info` are those of Gymnasium's own `SyncVectorEnv` in the same mode.

    Args:
        num_envs: Number of environments.
        autoreset_mode: `NEXT_STEP` (the step after the last begins the next episode and ignores the action),
            `SAME_STEP` (the last step returns the next episode's first observation, and its own in
            `info["final_obs"]`), or `DISABLED` (the caller resets with `options={"reset_mask": ...}`).
        task: Id of the task.
        flat: As for `SubterraEnv`.
        render_mode: As for `SubterraEnv`; `render` returns one picture for each environment.
        view: As for `SubterraEnv`.
        **options: As for `SubterraEnv`.
    """

    def __init__(
        self,
        num_envs: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        task: str = "Subterra/Traverse-v1",
        *,
        flat: bool = False,
        render_mode: str | None = None,
        view: str = "top",
        **options: Any,
    ):
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        self.task, self.view = open_task(task, flat, render_mode, view, options)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": 10, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space, self.single_action_space = self.task.observation_space, self.task.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._rows: Rows | None = None
        self._pending: np.ndarray = np.zeros(num_envs, np.bool_)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode in every environment, or in those that `options["reset_mask"]` marks.

        Args:
            seed: An int seeds environment i with seed + i; a sequence holds one seed for each. With `None` an
                environment goes on with its stream.
            options: `reset_mask`: a bool array `(num_envs,)`; the other environments stay as they are.

        Returns:
            Observations of all environments, and an empty info.

        Raises:
            ValueError: There is another option, or the mask has another shape.
        """
        refuse_fork()
        mask = self._reset_mask(options or {})
        super().reset(seed=seed if isinstance(seed, int) else None)
        others = self._empty() if self._rows is None else self._rows
        rows = _reset(self.task_env, mask, self._streams(seed, mask), others, self.task_params)
        self._rows, self._obs, self._pending = rows, np.array(rows.obs), self._pending & ~mask
        return as_observation(self._obs, self.task.fields), {}

    def step(self, actions: np.ndarray) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take one step of 0.1 s in every environment; see `autoreset_mode` for those that have finished.

        Returns:
            Observations to act on next, rewards (float64), terminated, truncated and info, all of `(num_envs, ...)`.
        """
        pending = self._pending
        obs, reward, terminated, truncated, step = self.advance(actions)
        done = terminated | truncated
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            info = {**mask_info(step.info, ~done), **final_info(step, done, self.task.fields)}
        else:
            info = mask_info(step.info, ~pending)
        return obs, reward.astype(np.float64), terminated, truncated, info

    def advance(self, actions: np.ndarray) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, Report]:
        """Take one step; return the batch's own report in place of info.

        The report's observation is from before any reset; that of an environment that is reset instead of stepping
        means nothing.
        """
        pending, mode = self._pending, self.autoreset_mode
        if mode == AutoresetMode.DISABLED and pending.any():
            raise error.ResetNeeded(f"environments {np.flatnonzero(pending).tolist()} have finished: reset them first")
        action, env, params = np.asarray(actions), self.task_env, self.task_params
        if action.shape != self.action_space.shape:
            raise ValueError(f"actions must have shape {self.action_space.shape}, got {action.shape}")
        if (before := self._rows) is None:
            raise error.ResetNeeded("reset() must come before step()")
        rows, words = _step(env, before, action.astype(np.float32), params)
        step: Report = self.task.read(np.asarray(words))
        reward = np.where(pending, np.float32(0.0), step.reward)
        terminated, truncated = step.terminated & ~pending, step.truncated & ~pending
        done = terminated | truncated
        if mode == AutoresetMode.NEXT_STEP and pending.any():
            rows = _reset(env, pending, before.stream, rows, params)
        elif mode == AutoresetMode.SAME_STEP and done.any():
            rows = _reset(env, done, rows.stream, rows, params)
        if mode != AutoresetMode.SAME_STEP:
            self._pending = done
        self._rows, self._obs = rows, np.array(rows.obs)
        return as_observation(self._obs, self.task.fields), reward, terminated, truncated, step

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return a picture of each environment, `(480, 480, 3)` uint8; `None` without `rgb_array`."""
        if self.render_mode is None:
            return None
        obs, states = self._last("render"), jax.device_get(self._rows.state if self._rows else None)
        own = (jax.tree.map(lambda leaf, i=i: leaf[i], states) for i in range(self.num_envs))
        return tuple(self.view.picture(self.task_env, self.task_params, *each) for each in zip(own, obs, strict=True))

    def close_extras(self, **kwargs: Any) -> None:
        self.view.close()

    def _empty(self) -> Rows:
        zeros = lambda leaf: jnp.zeros((self.num_envs, *leaf.shape), leaf.dtype)  # noqa: E731
        return jax.tree.map(zeros, Rows(jax.ShapeDtypeStruct((2,), np.uint32), self.task.state, self.task.report.obs))

    def _reset_mask(self, options: dict[str, Any]) -> np.ndarray:
        """Return the caller's mask, checked; all environments without one."""
        if unknown := sorted(set(options) - {"reset_mask"}):
            raise ValueError(f"no option {unknown[0]!r} in a reset of a batch; there is 'reset_mask'")
        mask = options.get("reset_mask")
        if mask is None:
            return np.ones(self.num_envs, np.bool_)
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            raise TypeError(f"options['reset_mask'] must be a bool array, got {type(mask).__name__} {mask!r}")
        if mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(f"options['reset_mask'] must have shape ({self.num_envs},) and a True in it, got {mask!r}")
        if self._rows is None and not mask.all():
            raise error.ResetNeeded("the first reset must be of all environments")
        return mask

    def _streams(self, seed: int | Sequence[int | None] | None, mask: np.ndarray) -> np.ndarray:
        """Return streams for the next reset: newly seeded for a given seed or at first, else those that go on."""
        n = self.num_envs
        seeds = [seed + i for i in range(n)] if isinstance(seed, int) else [None] * n if seed is None else seed
        if len(seeds) != n:
            raise ValueError(f"there must be one seed for each of the {n} environments, got {len(seeds)}")
        fresh = np.array([self._rows is None or one is not None for one in seeds]) & mask
        streams = np.zeros((n, 2), np.uint32) if self._rows is None else np.array(self._rows.stream)
        streams[fresh] = start_streams([one for one, new in zip(seeds, fresh, strict=True) if new], self.np_random)
        return streams


@partial(jax.jit, static_argnums=0)
def _reset(env: TunnelEnv, mask: Bool[Array, "n"], stream: Array, others: Rows, params: EnvParams) -> Rows:
    """Reset the rows of a mask from their streams; take the other rows from `others`.

    A reset costs a scan, and few environments finish in one step: so a few at a time are gathered and reset.
    """
    n_envs = mask.shape[0]
    n_few = max(1, n_envs // 32)

    def some(carry: tuple[Array, Rows]) -> tuple[Array, Rows]:
        left, rows = carry
        (index,) = jnp.nonzero(left, size=n_few, fill_value=n_envs)
        key, after = jax.vmap(take_key)(jnp.take(stream, index, axis=0, mode="clip"))
        obs, state = jax.vmap(env.reset, (0, None))(key, params)
        rows = jax.tree.map(lambda old, new: old.at[index].set(new, mode="drop"), rows, Rows(after, state, obs))
        return left.at[index].set(False, mode="drop"), rows

    return jax.lax.while_loop(lambda carry: jnp.any(carry[0]), some, (mask, others))[1]


@partial(jax.jit, static_argnums=0)
def _step(env: TunnelEnv, before: Rows, action: Float[Array, "n n_action"], params: EnvParams) -> tuple[Rows, Array]:
    def one(stream: Array, state: State, action: Array) -> tuple[Rows, Array]:
        key, stream = take_key(stream)
        obs, state, reward, terminated, truncated, info = env.step(key, state, action, params)
        return Rows(stream, state, obs), pack(Report(obs, reward, terminated, truncated, info))

    return jax.vmap(one)(before.stream, before.state, action)
