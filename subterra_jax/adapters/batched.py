"""A batch of environments on the device, each with its own stream of keys: what the vector adapters share.

Environment i of a batch does what it would do alone: same seed, same episodes, whatever its neighbours do. `AutoReset`
shares one key and is the quicker choice inside a graph; here each row can be seeded and reset by itself.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import error
from gymnasium.vector import AutoresetMode
from jaxtyping import Array, Bool, Float

from subterra_jax.adapters import report
from subterra_jax.adapters.packing import unpacker
from subterra_jax.adapters.report import Report
from subterra_jax.adapters.streams import take_key
from subterra_jax.env import TunnelEnv
from subterra_jax.state import EnvParams


class Rows(NamedTuple):
    """All environments.

    Attributes:
        stream: Their streams of keys, `(n, 2)` uint32.
        state: Their states.
        obs: Their observations, `(n, n_obs)`.
    """

    stream: Any
    state: Any
    obs: Any


class Batch:
    """Reset and step of `n_envs` environments, compiled.

    Args:
        env: The environment.
        params: Its params, shared by all.
        n_envs: How many.
        mode: When finished environments begin anew.
    """

    def __init__(self, env: TunnelEnv, params: EnvParams, n_envs: int, mode: AutoresetMode):
        if n_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {n_envs}")
        self.env, self.params, self.n_envs, self.mode = env, params, n_envs, mode
        self._state, self._report = report.shapes(env, params)
        self._read = unpacker(self._report)
        self.rows: Rows | None = None

    def reset(self, stream: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Begin an episode where `mask` says; the others stay as they are.

        Args:
            stream: Streams to draw from, `(n_envs, 2)`.
            mask: Which environments, `(n_envs,)`; all of them the first time.

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
            pending: Environments whose last step ended an episode, `(n_envs,)`; only `NEXT_STEP` looks at it.

        Returns:
            Observations to act on next, `(n_envs, n_obs)`, and the report of the steps taken, whose own observation is
            that from before any reset. In an environment that begins anew instead of stepping, it means nothing.
        """
        if action.shape != (self.n_envs, self.env.action_size):
            raise ValueError(f"actions must have shape {(self.n_envs, self.env.action_size)}, got {action.shape}")
        if (before := self.rows) is None:
            raise error.ResetNeeded("reset() must come before step()")
        after, words = _step(self.env, before, action.astype(np.float32), self.params)
        told = self._read(np.asarray(words))
        if self.mode == AutoresetMode.NEXT_STEP and pending.any():
            after = _reset(self.env, pending, before.stream, after, self.params)
        elif self.mode == AutoresetMode.SAME_STEP and (done := told.terminated | told.truncated).any():
            after = _reset(self.env, done, after.stream, after, self.params)
        self.rows = after
        return np.array(after.obs), told

    def _empty(self) -> Rows:
        """Rows of zeros, for the first reset to fill."""
        zeros = lambda leaf: jnp.zeros((self.n_envs, *leaf.shape), leaf.dtype)  # noqa: E731
        return jax.tree.map(zeros, Rows(jax.ShapeDtypeStruct((2,), np.uint32), self._state, self._report.obs))

    @property
    def stream(self) -> np.ndarray | None:
        """The streams as they stand; None before the first reset."""
        return None if self.rows is None else np.asarray(self.rows.stream)

    def state(self, index: int) -> Any:
        """State of one environment, on the host."""
        return jax.tree.map(lambda leaf: np.asarray(leaf[index]), self.rows.state) if self.rows else None


@partial(jax.jit, static_argnums=0)
def _reset(env: TunnelEnv, mask: Bool[Array, "n"], stream: Array, others: Rows, params: EnvParams) -> Rows:
    """Rows that are reset where `mask` says, from their streams, and taken from `others` elsewhere.

    A reset costs a scan, and in the usual step few environments finish: a few at a time are gathered and reset.
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
    words, state = jax.vmap(partial(report.step_and_pack, env), (0, 0, 0, None))(key, before.state, action, params)
    return Rows(stream, state, unpacker(report.shapes(env, params)[1])(words).obs), words
