"""Environments split into parts, on one device or on many: what the parts have to tell each other while they learn.

`parts` names the axes along which a learner is split (see `spread.py`); with none of them everything here is the
identity, so that a learner reads the same either way.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

T = TypeVar("T")
Parts = tuple[str, ...]


class Whole:
    """What a learner that is not split has in place of `place`, `share` and `gather` of `Spread`."""

    def place(self, state: T) -> T:
        """A state that was read from a checkpoint, on the device."""
        return jax.tree.map(jnp.asarray, state)

    def share(self, tree: T) -> T:
        """What all parts read, as it is."""
        return tree

    def gather(self, state: T) -> T:
        """The state itself."""
        return state


def mean(tree: T, parts: Parts) -> T:
    """Mean over all parts of every leaf, which are of one size."""
    return jax.lax.pmean(tree, parts) if parts else tree


def own_key(key: PRNGKeyArray, parts: Parts) -> PRNGKeyArray:
    """A key for what each part draws by itself; it depends on the number of the part, not on the device it is on."""
    return jax.random.fold_in(key, jax.lax.axis_index(parts)) if parts else key


def normalised(values: Float[Array, "..."], parts: Parts) -> Float[Array, "..."]:
    """Values less their mean over all parts, over their standard deviation."""
    centre = mean(jnp.mean(values), parts)
    spread = jnp.sqrt(mean(jnp.mean(jnp.square(values - centre)), parts))
    return (values - centre) / (spread + 1e-8)
