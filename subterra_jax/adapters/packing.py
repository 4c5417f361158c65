"""Observations, states and reports between JAX and Gymnasium: streams of keys, and packed words.

Passing many small arrays between host and device would cost more than a step itself, so a pytree travels as one array.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray, UInt32

_WORD = 0xFFFFFFFF
Fields = dict[str, tuple[slice, tuple[int, ...]]]  # place in the vector, and shape, of each part of an observation
Observation = np.ndarray | dict[str, np.ndarray]


def pack(tree: Any) -> UInt32[Array, "n_words"]:
    """Join the leaves of a pytree into one array of words, their bits unchanged, a bool as 0 or 1."""

    def words(leaf: Array) -> Array:
        _check_kind(leaf.dtype)
        return leaf.astype(jnp.uint32) if leaf.dtype == jnp.bool_ else jax.lax.bitcast_convert_type(leaf, jnp.uint32)

    return jnp.concatenate([words(jnp.asarray(leaf)).reshape(-1) for leaf in jax.tree.leaves(tree)])


def unpacker(example: Any) -> Callable[[Any], Any]:
    """Return the inverse of `pack`.

    Args:
        example: A pytree of arrays, or of shapes and dtypes, like those that were packed.

    Returns:
        Words `(..., n_words)` to a pytree whose leaves have those leading axes; of JAX arrays inside a graph, of NumPy
        arrays outside.

    Raises:
        TypeError: A leaf is neither bool nor 32 bits wide.
    """
    leaves, structure = jax.tree.flatten(example)
    kinds = [_check_kind(np.dtype(leaf.dtype)) for leaf in leaves]
    shapes = [tuple(leaf.shape) for leaf in leaves]
    ends = np.cumsum([math.prod(shape) for shape in shapes]).tolist()

    def values(words: Any, kind: np.dtype) -> Any:
        if kind == np.bool_:
            return words != 0
        return words.view(kind) if isinstance(words, np.ndarray) else jax.lax.bitcast_convert_type(words, kind)

    def unpack(words: Any) -> Any:
        parts = [words[..., start:end] for start, end in zip([0, *ends], ends, strict=False)]
        made = zip(parts, kinds, shapes, strict=True)
        leaves = [values(part, kind).reshape((*part.shape[:-1], *shape)) for part, kind, shape in made]
        return jax.tree.unflatten(structure, leaves)

    return unpack


def _check_kind(kind: np.dtype) -> np.dtype:
    if kind != np.bool_ and kind.itemsize != 4:
        raise TypeError(f"only bools and 32-bit numbers can be packed, got {kind}")
    return kind


def start_streams(seeds: Sequence[int | None], fallback: np.random.Generator) -> UInt32[np.ndarray, "n 2"]:
    """Begin streams at seeds.

    A stream is the two words of a Threefry key. Each reset and each step takes one key and leaves the next, so that an
    environment does the same alone and among others.

    Args:
        seeds: Seed of each stream, from 0 to 2⁶⁴ - 1; `None` draws one from `fallback`.
        fallback: Source of the seeds that are `None`.

    Raises:
        ValueError: A seed is out of range.
    """
    chosen = [int(fallback.integers(2**63)) if seed is None else int(seed) for seed in seeds]
    for seed in chosen:
        if not 0 <= seed < 2**64:
            raise ValueError(f"a seed must be from 0 to 2**64 - 1, got {seed}")
    return np.array([[seed >> 32, seed & _WORD] for seed in chosen], np.uint32).reshape(-1, 2)


def take_key(stream: UInt32[Array, "2"]) -> tuple[PRNGKeyArray, UInt32[Array, "2"]]:
    """Return the next key of a stream, and the stream after it."""
    now, rest = jax.random.split(jax.random.wrap_key_data(stream, impl="threefry2x32"))
    return now, jax.random.key_data(rest)


class Report(NamedTuple):
    """Result of one step, or of a batch of steps."""

    obs: Any  # observation, `(..., n_obs)`
    reward: Any  # reward, `(...)`
    terminated: Any  # whether the episode ended before the horizon, `(...)`
    truncated: Any  # whether it ended at the horizon, `(...)`
    info: dict[str, Any]  # the environment's own `info`


def python_reader(example: Report) -> Callable[[np.ndarray], Report]:
    """Return a reader of one step's words as Python's own floats, ints and bools; `example` as for `unpacker`."""
    unpack = unpacker(example)

    def read(words: np.ndarray) -> Report:
        obs, reward, terminated, truncated, info = unpack(words)
        plain = {name: values if values.ndim else values.item() for name, values in info.items()}
        return Report(obs, reward.item(), terminated.item(), truncated.item(), plain)

    return read


def as_observation(vector: np.ndarray, fields: Fields | None) -> Observation:
    """Bring vectors `(..., n_obs)` into the form of the space; the parts of a dict are views."""
    if fields is None:
        return vector
    return {name: vector[..., at].reshape(*vector.shape[:-1], *shape) for name, (at, shape) in fields.items()}
