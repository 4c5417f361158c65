"""Compiled reset and step of a batch in which each environment has its own stream of keys."""

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import error
from gymnasium.vector import AutoresetMode
from jaxtyping import Array, Bool, Float

from subterra_jax.adapters import packing
from subterra_jax.adapters.choosing import check_clear, reset_chosen
from subterra_jax.adapters.packing import Report, pack, take_key, unpacker
from subterra_jax.rules import Choice
from subterra_jax.state import EnvParams
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
        self.rows: Rows | None = None
        self._prepare()

    def _prepare(self) -> None:
        """Make what cannot be pickled."""
        self._state, self._report = packing.report_shapes(self.env, self.params)
        self._read = unpacker(self._report)
        self._unpack = unpacker((jax.ShapeDtypeStruct((2,), np.uint32), self._state))

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what `_prepare` makes."""
        return {name: value for name, value in self.__dict__.items() if name not in ("_read", "_unpack")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make it anew."""
        self.__dict__.update(state)
        self._prepare()

    def reset(self, stream: np.ndarray, mask: np.ndarray, choice: Choice | None = None) -> np.ndarray:
        """Begin an episode in the environments of a mask; the others stay as they are.

        Args:
            stream: Streams to draw from, `(n_envs, 2)`.
            mask: Environments to reset, `(n_envs,)`; all of them the first time.
            choice: Chosen starts and goals, arrays `(n_envs,)`.

        Returns:
            Observations of all environments, `(n_envs, n_obs)`.

        Raises:
            OptionError: A robot would not stand clear; all environments are then as before.
        """
        others = self._empty() if self.rows is None else self.rows
        rows, clear = _reset(self.env, mask, stream, others, self.params, choice)
        if choice is not None:
            check_clear(clear, choice)
        self.rows = rows
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
            after, _ = _reset(self.env, pending, before.stream, after, self.params)
        elif self.mode == AutoresetMode.SAME_STEP and (done := step.terminated | step.truncated).any():
            after, _ = _reset(self.env, done, after.stream, after, self.params)
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

    def words(self) -> np.ndarray | None:
        """Return streams and states of all environments, `(n_envs, n_words)`; `None` before the first reset."""
        return None if self.rows is None else np.asarray(_pack_rows(self.rows))

    def set_words(self, words: np.ndarray, obs: np.ndarray) -> None:
        """Go back to the streams and states of `words`, with their observations."""
        stream, state = self._unpack(words)
        self.rows = jax.tree.map(jnp.asarray, Rows(stream, state, obs))

    @property
    def n_words(self) -> int:
        """Words of one environment."""
        return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(self._state)) + 2

    def state(self, index: int) -> Any:
        """Return the state of one environment on the host; `None` before the first reset."""
        return jax.tree.map(lambda leaf: np.asarray(leaf[index]), self.rows.state) if self.rows else None


@partial(jax.jit, static_argnums=0)
def _reset(
    env: TunnelEnv, mask: Bool[Array, "n"], stream: Array, others: Rows, params: EnvParams, choice: Choice | None = None
) -> tuple[Rows, Bool[Array, "n"] | None]:
    """Reset the rows of a mask from their streams; take the other rows from `others`.

    A reset costs a scan, and few environments finish in one step: so a few at a time are gathered and reset. With a
    choice the second result tells which robots stand clear.
    """
    n_envs = mask.shape[0]
    n_few = max(1, n_envs // 32)
    Carry = tuple[Array, Rows, Any]

    def some(carry: Carry) -> Carry:
        left, rows, clear = carry
        (index,) = jnp.nonzero(left, size=n_few, fill_value=n_envs)
        key, after = jax.vmap(take_key)(jnp.take(stream, index, axis=0, mode="clip"))
        if choice is None:
            obs, state = jax.vmap(env.reset, (0, None))(key, params)
        else:
            own = Choice(*(jnp.take(jnp.asarray(values), index, mode="clip") for values in choice))
            obs, state, stands = jax.vmap(partial(reset_chosen, env), (0, None, 0))(key, params, own)
            clear = clear.at[index].set(stands, mode="drop")
        rows = jax.tree.map(lambda old, new: old.at[index].set(new, mode="drop"), rows, Rows(after, state, obs))
        return left.at[index].set(False, mode="drop"), rows, clear

    clear = None if choice is None else jnp.ones(n_envs, bool)
    return jax.lax.while_loop(lambda carry: jnp.any(carry[0]), some, (mask, others, clear))[1:]


@jax.jit
def _pack_rows(rows: Rows) -> Array:
    return jax.vmap(pack)((rows.stream, rows.state))


@partial(jax.jit, static_argnums=0)
def _step(env: TunnelEnv, before: Rows, action: Float[Array, "n n_action"], params: EnvParams) -> tuple[Rows, Array]:
    key, stream = jax.vmap(take_key)(before.stream)
    words, state = jax.vmap(partial(packing.step_and_pack, env), (0, 0, 0, None))(key, before.state, action, params)
    return Rows(stream, state, unpacker(packing.report_shapes(env, params)[1])(words).obs), words
