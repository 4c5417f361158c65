"""Gymnasium, many environments at once: `gymnasium.make_vec`, all three autoreset modes, NumPy out.

Each environment of a batch has its own stream of keys and does what it would do alone: same seed, same episodes,
whatever its neighbours do. `AutoReset` shares one key and is quicker inside a graph.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import error
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Array, Bool, Float

from subterra_jax.adapters import packing
from subterra_jax.adapters.packing import Observation, Report, as_observation, start_streams, take_key, unpacker
from subterra_jax.adapters.views import make_view
from subterra_jax.state import EnvParams
from subterra_jax.tasks import make
from subterra_jax.tunnel.sources import Source
from subterra_jax.tunnel_env import TunnelEnv


class Rows(NamedTuple):
    """Streams, states and observations of all environments.

    Attributes:
        stream: Streams of keys, `(n, 2)` uint32.
        state: States.
        obs: Observations, `(n, n_obs)`.
    """

    stream: Any
    state: Any
    obs: Any


class Batch:
    """Compiled reset and step of `n_envs` environments.

    Args:
        env: The environment.
        params: Params of all environments.
        n_envs: Number of environments.
        mode: Time at which finished environments begin again.
    """

    def __init__(self, env: TunnelEnv, params: EnvParams, n_envs: int, mode: AutoresetMode):
        if n_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {n_envs}")
        self.env, self.params, self.n_envs, self.mode = env, params, n_envs, mode
        self._state, self._report = packing.report_shapes(env, params)
        self._read = unpacker(self._report)
        self.rows: Rows | None = None

    def reset(self, stream: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Begin an episode in the environments of a mask; the others stay as they are.

        Args:
            stream: Streams to draw from, `(n_envs, 2)`.
            mask: Environments to reset, `(n_envs,)`; all of them the first time.

        Returns:
            Observations of all environments, `(n_envs, n_obs)`.
        """
        others = self._empty() if self.rows is None else self.rows
        self.rows = _reset(self.env, mask, stream, others, self.params)
        return np.array(self.rows.obs)

    def step(self, action: np.ndarray, pending: np.ndarray) -> tuple[np.ndarray, Report]:
        """Step all environments.

        Args:
            action: Actions, `(n_envs, n_action)`.
            pending: Environments whose last step ended an episode, `(n_envs,)`; used by `NEXT_STEP` only.

        Returns:
            Observations to act on next, `(n_envs, n_obs)`, and the report of the steps, whose own observation is from
            before any reset. The report of an environment that is reset instead of stepping is meaningless.
        """
        if action.shape != (self.n_envs, self.env.action_size):
            raise ValueError(f"actions must have shape {(self.n_envs, self.env.action_size)}, got {action.shape}")
        if (before := self.rows) is None:
            raise error.ResetNeeded("reset() must come before step()")
        after, words = _step(self.env, before, action.astype(np.float32), self.params)
        step = self._read(np.asarray(words))
        if self.mode == AutoresetMode.NEXT_STEP and pending.any():
            after = _reset(self.env, pending, before.stream, after, self.params)
        elif self.mode == AutoresetMode.SAME_STEP and (done := step.terminated | step.truncated).any():
            after = _reset(self.env, done, after.stream, after, self.params)
        self.rows = after
        return np.array(after.obs), step

    def _empty(self) -> Rows:
        """Return rows of zeros for the first reset to fill."""
        zeros = lambda leaf: jnp.zeros((self.n_envs, *leaf.shape), leaf.dtype)  # noqa: E731
        return jax.tree.map(zeros, Rows(jax.ShapeDtypeStruct((2,), np.uint32), self._state, self._report.obs))

    @property
    def stream(self) -> np.ndarray | None:
        """Present streams; `None` before the first reset."""
        return None if self.rows is None else np.asarray(self.rows.stream)

    def state(self, index: int) -> Any:
        """Return the state of one environment on the host; `None` before the first reset."""
        return jax.tree.map(lambda leaf: np.asarray(leaf[index]), self.rows.state) if self.rows else None


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
    key, stream = jax.vmap(take_key)(before.stream)
    words, state = jax.vmap(partial(packing.step_and_pack, env), (0, 0, 0, None))(key, before.state, action, params)
    return Rows(stream, state, unpacker(packing.report_shapes(env, params)[1])(words).obs), words


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


def final_info(step: Report, done: np.ndarray, fields: Mapping[str, slice] | None) -> dict[str, Any]:
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
        self.fields = packing.named_fields(env, params, flat)
        self.single_observation_space = packing.observation_space(env, params, self.fields)
        self.single_action_space = packing.action_space(env, params)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._pending = np.zeros(num_envs, np.bool_)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode in every environment, or in those that `options["reset_mask"]` names.

        Args:
            seed: An int seeds environment i with seed + i; a sequence holds one seed for each. With `None` an
                environment goes on with its stream.
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
