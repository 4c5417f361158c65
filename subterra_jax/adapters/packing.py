"""Any pytree of 32-bit numbers as one array of words: passing many small arrays would cost more than a step itself."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, UInt32


def pack(tree: Any) -> UInt32[Array, "n_words"]:
    """The leaves of a pytree one after another, their bits unchanged, a bool as 0 or 1."""
    return jnp.concatenate([_words(jnp.asarray(leaf)).reshape(-1) for leaf in jax.tree.leaves(tree)])


def unpacker(example: Any) -> Callable[[Any], Any]:
    """The inverse of `pack`.

    Args:
        example: A pytree of arrays, or of shapes and dtypes, like those that were packed.

    Returns:
        Words `(..., n_words)` to a pytree whose leaves have those leading axes; of JAX arrays inside a graph, of NumPy
        arrays outside.

    Raises:
        TypeError: A leaf is neither bool nor 32 bits wide.
    """
    leaves, structure = jax.tree.flatten(example)
    kinds = [_checked(np.dtype(leaf.dtype)) for leaf in leaves]
    shapes = [tuple(leaf.shape) for leaf in leaves]
    ends = np.cumsum([math.prod(shape) for shape in shapes]).tolist()

    def unpack(words: Any) -> Any:
        parts = [words[..., start:end] for start, end in zip([0, *ends], ends, strict=False)]
        return jax.tree.unflatten(
            structure,
            [
                _values(part, kind).reshape((*part.shape[:-1], *shape))
                for part, kind, shape in zip(parts, kinds, shapes, strict=True)
            ],
        )

    return unpack


def _words(leaf: Array) -> Array:
    _checked(leaf.dtype)
    return leaf.astype(jnp.uint32) if leaf.dtype == jnp.bool_ else jax.lax.bitcast_convert_type(leaf, jnp.uint32)


def _values(words: Any, kind: np.dtype) -> Any:
    if kind == np.bool_:
        return words != 0
    return words.view(kind) if isinstance(words, np.ndarray) else jax.lax.bitcast_convert_type(words, kind)


def _checked(kind: np.dtype) -> np.dtype:
    if kind != np.bool_ and kind.itemsize != 4:
        raise TypeError(f"only bools and 32-bit numbers can be packed, got {kind}")
    return kind
