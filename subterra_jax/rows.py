"""A function of one row that, batched by any number of `vmap`s, becomes one call of a kernel for many rows."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap


def rowwise(single: Callable[..., jax.Array], many: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """A function that computes one row by itself and a batch of rows by a kernel.

    Args:
        single: Function of something shared and of the arrays of one row.
        many: The same of something shared and of the arrays of many rows, the rows as their first axis.

    Returns:
        `single`, but for `vmap`, under which it is `many` of all rows, those of all batch axes in one. Where what is
        shared is batched itself, `many` cannot serve it, and it is `vmap` of `single`.
    """
    one, rows = custom_vmap(single), custom_vmap(many)

    @one.def_vmap
    def batch(axis_size: int, batched: Any, shared: Any, *row: Any) -> tuple[jax.Array, bool]:
        if any(jax.tree.leaves(batched[0])):
            return jax.vmap(single, in_axes=axes(batched))(shared, *row), True
        return rows(shared, *spread(row, batched[1:], axis_size)), True

    @rows.def_vmap
    def more(axis_size: int, batched: Any, shared: Any, *row: Any) -> tuple[jax.Array, bool]:
        if any(jax.tree.leaves(batched[0])):
            apart = jax.vmap(single, in_axes=(None, *[0] * len(row)))
            return jax.vmap(apart, in_axes=axes(batched))(shared, *row), True
        flat = rows(shared, *(part.reshape(-1, *part.shape[2:]) for part in spread(row, batched[1:], axis_size)))
        return flat.reshape(axis_size, -1, *flat.shape[1:]), True

    return one


def axes(batched: Any) -> tuple[Any, ...]:
    """`in_axes` that say which leaves are batched, as `custom_vmap` tells its rule."""
    return tuple(jax.tree.map(lambda is_batched: 0 if is_batched else None, batched))


def spread(row: tuple[Any, ...], batched: Any, axis_size: int) -> list[jax.Array]:
    """Arrays of which some have a batch axis, all with one of `axis_size`."""
    return [
        part if is_batched else jnp.broadcast_to(part, (axis_size, *jnp.shape(part)))
        for part, is_batched in zip(row, batched, strict=True)
    ]
