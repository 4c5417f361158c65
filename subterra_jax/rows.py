"""A function of one row that, batched by any number of `vmap`s, becomes one call of a kernel for many rows.

And derivatives of what kernels compute, which JAX cannot see through.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero


def rowwise(single: Callable[..., Any], many: Callable[..., Any]) -> Callable[..., Any]:
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
    def batch(axis_size: int, batched: Any, shared: Any, *row: Any) -> tuple[Any, Any]:
        if any(jax.tree.leaves(batched[0])):
            return _all_batched(jax.vmap(single, in_axes=axes(batched))(shared, *row))
        return _all_batched(rows(shared, *spread(row, batched[1:], axis_size)))

    @rows.def_vmap
    def more(axis_size: int, batched: Any, shared: Any, *row: Any) -> tuple[Any, Any]:
        if any(jax.tree.leaves(batched[0])):
            apart = jax.vmap(single, in_axes=(None, *[0] * len(row)))
            return _all_batched(jax.vmap(apart, in_axes=axes(batched))(shared, *row))
        flat = rows(shared, *(part.reshape(-1, *part.shape[2:]) for part in spread(row, batched[1:], axis_size)))
        return _all_batched(jax.tree.map(lambda part: part.reshape(axis_size, -1, *part.shape[1:]), flat))

    return one


def _all_batched(out: Any) -> tuple[Any, Any]:
    return out, jax.tree.map(lambda _: True, out)


def axes_of(*trees: Any) -> frozenset[str]:
    """Axes of a `jax.shard_map` along which any array of some pytrees varies; none outside of one."""
    kinds = [jax.typeof(leaf) for leaf in jax.tree.leaves(trees)]
    # JAX 0.9 has it as `vma`.
    return frozenset().union(*(kind.vma if hasattr(kind, "vma") else kind.manual_axis_type.varying for kind in kinds))


def vary_like(tree: Any, *others: Any) -> Any:
    """Declare that every array varies along the axes of a `jax.shard_map` along which it or the others do."""
    needed = axes_of(tree, *others)
    if not needed:
        return tree

    def one(leaf: Any) -> Any:
        missing = tuple(needed - axes_of(leaf))
        return jax.lax.pcast(leaf, missing, to="varying") if missing else leaf

    return jax.tree.map(one, tree)


def slope_along(function: Callable[..., jax.Array], primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> jax.Array:
    """Derivative of a function along tangents of which some are symbolic zeros, as `custom_jvp` hands them over.

    An argument that does not move at all is held, so that nothing is computed for it.
    """
    still = [all(isinstance(leaf, SymbolicZero) for leaf in jax.tree.leaves(tangent)) for tangent in tangents]
    if all(still):
        return jnp.zeros_like(jax.eval_shape(function, *primals))
    moving = [i for i, holds in enumerate(still) if not holds]

    def of_moving(*values: Any) -> jax.Array:
        every = list(primals)
        for i, value in zip(moving, values, strict=True):
            every[i] = value
        return function(*every)

    moves = [jax.tree.map(_instantiate, primals[i], tangents[i]) for i in moving]
    return jax.jvp(of_moving, tuple(primals[i] for i in moving), tuple(moves))[1]


def _instantiate(primal: Any, tangent: Any) -> Any:
    if not isinstance(tangent, SymbolicZero):
        return tangent
    if not jnp.issubdtype(jnp.result_type(primal), jnp.floating):
        return np.zeros(jnp.shape(primal), jax.dtypes.float0)
    return jnp.zeros_like(primal)


def axes(batched: Any) -> tuple[Any, ...]:
    """`in_axes` that say which leaves are batched, as `custom_vmap` tells its rule."""
    return tuple(jax.tree.map(lambda is_batched: 0 if is_batched else None, batched))


def spread(row: tuple[Any, ...], batched: Any, axis_size: int) -> list[jax.Array]:
    """Arrays of which some have a batch axis, all with one of `axis_size`."""
    return [
        jnp.asarray(part) if is_batched else jnp.broadcast_to(part, (axis_size, *jnp.shape(part)))
        for part, is_batched in zip(row, batched, strict=True)
    ]


def for_some(
    mask: jax.Array, function: Callable[[Callable[[Any], Any]], Any], others: Any, axes: tuple[str, ...] = ()
) -> Any:
    """Compute rows where a mask says so, and take the others as they are.

    Few are marked in the usual step: then a 32nd of the rows is computed, and all of them in the rare one with more.

    Args:
        mask: Rows to compute, `(n,)`.
        function: Computes rows; it gets a function that takes those to be computed out of any pytree `(n, ...)`.
        others: All rows as they are.
        axes: Axes along which batches are vmapped themselves; they then agree on what is computed.
    """
    n = mask.shape[0]
    n_few = max(1, n // 32)

    def few() -> Any:
        (index,) = jnp.nonzero(mask, size=n_few, fill_value=n)
        some = function(lambda tree: jax.tree.map(lambda leaf: leaf.at[index].get(mode="clip"), tree))
        return jax.tree.map(lambda old, new: old.at[index].set(new, mode="drop"), others, some)

    def everybody() -> Any:
        pick = lambda old, new: jnp.where(mask.reshape(-1, *[1] * (old.ndim - 1)), new, old)  # noqa: E731
        return jax.tree.map(pick, others, function(lambda tree: tree))

    n_marked = jnp.sum(mask)
    if axes:
        n_marked = jax.lax.pmax(n_marked, axes)
    return jax.lax.switch(
        jnp.where(n_marked == 0, 0, jnp.where(n_marked <= n_few, 1, 2)), [lambda: others, few, everybody]
    )
