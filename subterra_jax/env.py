"""The contract of an environment on one page, and the bounds of its spaces; `tunnel_env` has the tunnel's."""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

Batch = tuple[int, ...]
Info = dict[str, Any]
Stepped = tuple[Any, Float[Array, ""], Bool[Array, ""], Bool[Array, ""], Info]


@dataclasses.dataclass(frozen=True)
class Box:
    """Bounds of a space: `low` and `high` are float32 arrays of one shape."""

    low: np.ndarray
    high: np.ndarray

    @property
    def shape(self) -> tuple[int, ...]:
        return self.low.shape

    @property
    def dtype(self) -> Any:
        return self.low.dtype

    def sample(self, key: PRNGKeyArray) -> Float[Array, "*shape"]:
        """Draw an element: uniform between bounds, exponential beyond a single one, normal where there are none."""
        return _sample(key, self.low, self.high)

    def contains(self, x: Any) -> Bool[Array, ""]:
        """Tell whether an array has the shape of the space and every number lies within bounds; False for a NaN."""
        if jnp.shape(x) != self.shape:
            return jnp.zeros((), bool)
        return jnp.all((x >= self.low) & (x <= self.high))


@jax.jit
def _sample(key: PRNGKeyArray, low: Float[Array, "*shape"], high: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    has_low, has_high = jnp.isfinite(low), jnp.isfinite(high)
    low, high = jnp.where(has_low, low, 0.0), jnp.where(has_high, high, 0.0)
    keys = jax.random.split(key, 3)
    inside = low + jax.random.uniform(keys[0], low.shape, jnp.float32) * (high - low)
    tail = jax.random.exponential(keys[1], low.shape, jnp.float32)
    bell = jax.random.normal(keys[2], low.shape, jnp.float32)
    open_ended = jnp.where(has_low, low + tail, jnp.where(has_high, high - tail, bell))
    return jnp.where(has_low & has_high, jnp.clip(inside, low, high), open_ended)


class Env(Protocol):
    """Contract of an environment with batches, adapters, evaluation, training, recorder and viewer.

    All functions are pure and jittable; batches come by `vmap`. `reset` and `step` are made of the others:

        reset:  draw_reset ─► begin ─► draw_step ─► observe
        step:   draw_step ─► advance ─► observe
    """

    @property
    def id(self) -> str:
        """Gymnasium id."""

    def draw_reset(self, key: PRNGKeyArray, batch: Batch, params: Any) -> Any:
        """Draw the random numbers of a batch of resets; row i does not depend on the size of the batch."""

    def draw_step(self, key: PRNGKeyArray, batch: Batch, params: Any) -> Any:
        """Draw the random numbers of one step of a batch; row i does not depend on the size of the batch."""

    def begin(self, draws: Any, params: Any) -> Any:
        """Make the state at the start of an episode."""

    def advance(self, state: Any, action: Float[Array, n_action], noise: Any, params: Any) -> Stepped:
        """Take one step but its observation: state, reward, terminated, truncated, info."""

    def observe(self, state: Any, noise: Any, params: Any, needed: Any = True) -> Float[Array, n_obs]:
        """Observe a state; where `needed` is false, the observation may be anything."""

    def skips_unneeded(self, params: Any) -> bool:
        """Tell whether a batch of observations costs little for those that nobody wants."""

    def observation_space(self, params: Any) -> Box:
        """Return the bounds of an observation."""

    def action_space(self, params: Any) -> Box:
        """Return the bounds of an action."""
