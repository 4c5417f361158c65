"""Modes of JAX for a while, and what two runs must have in common."""

import contextlib
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
import pytest

from subterra_jax import native

NEEDS_KERNELS = pytest.mark.skipif(not native.supported(), reason="numba is not installed, or this is no CPU")


@contextlib.contextmanager
def mode(**settings: Any) -> Iterator[None]:
    """JAX with other settings, for a while."""
    before = {name: getattr(jax.config, name) for name in settings}
    for name, value in settings.items():
        jax.config.update(name, value)
    try:
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)


def wide() -> Any:
    return mode(jax_enable_x64=True)


def strict() -> Any:
    return mode(jax_numpy_dtype_promotion="strict", jax_numpy_rank_promotion="raise")


def assert_same(one: Any, other: Any) -> None:
    for (path, a), b in zip(jax.tree_util.tree_flatten_with_path(one)[0], jax.tree.leaves(other), strict=True):
        assert a.dtype == b.dtype or "action" in str(path), path
        np.testing.assert_array_equal(a, b, err_msg=jax.tree_util.keystr(path))
