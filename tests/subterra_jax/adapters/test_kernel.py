"""Packing keeps every bit, and what is compiled as one kernel computes what it would have computed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from subterra_jax.adapters.kernel import compile_as_one_kernel, pack, start_streams


def test_a_leaf_of_another_width_is_refused():
    with pytest.raises(TypeError, match="float16"):
        pack({"half": jnp.zeros(2, jnp.float16)})


def test_a_function_of_many_operations_becomes_one_call_with_the_same_result():
    def many(x):
        key = jax.random.wrap_key_data(jnp.array([0, 7], jnp.uint32))
        noisy = x + jax.random.normal(key, x.shape)
        return jnp.cumsum(jnp.sin(noisy)), jnp.min(jnp.abs(noisy), keepdims=True)

    x = np.linspace(0.0, 1.0, 300, dtype=np.float32)
    compiled = compile_as_one_kernel(many, x)
    for got, expected in zip(compiled(x), jax.jit(many)(x), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-6)  # sums of numbers of order one
    entry = compiled.as_text().split("ENTRY", 1)[1]
    assert "fusion(" not in entry
    assert entry.count(" call(") == 1


def test_what_cannot_be_one_kernel_is_compiled_in_the_usual_way():
    x = np.array([3.0, 1.0, 2.0], np.float32)
    np.testing.assert_array_equal(compile_as_one_kernel(jnp.sort, x)(x), [1.0, 2.0, 3.0])


def test_seeds_begin_different_streams_and_only_legal_seeds_are_taken():
    streams = start_streams([0, 1, 2**32, None, None], np.random.default_rng(0))
    assert len(np.unique(streams, axis=0)) == 5
    np.testing.assert_array_equal(streams[2], [1, 0])
    for seed in (-1, 2**64):
        with pytest.raises(ValueError, match=str(seed)):
            start_streams([seed], np.random.default_rng(0))
